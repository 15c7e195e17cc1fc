"""An hour at 1 kHz with a fault each minute: all samples are counted, memory does not grow."""

import itertools
import os
import signal
import struct
import time
from pathlib import Path

import numpy as np
import pytest
import rclpy
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from omsm_msgs.srv import Identify, LoadCalibration, PredictError
from std_srvs.srv import Trigger
from system.broken_wire import BrokenWire

from omsm_ros.io import bags
from omsm_ros.io.bag_writer import BagWriter
from omsm_ros.io.calibration_file import save_calibration
from omsm_ros.twin.cell import blocks_of

pytestmark = [pytest.mark.soak, pytest.mark.timeout(0)]

MINUTES = float(os.environ.get("OMSM_SOAK_MINUTES", "60"))
FAULT_PERIOD_S = float(os.environ.get("OMSM_SOAK_FAULT_PERIOD", "60"))
START_RADIUS_M = 9e-3
FEED_PER_TURN_M = START_RADIUS_M / (30 * MINUTES)  # 30 turns a minute
SAMPLES = round(MINUTES * 60_000)
DEVICE_PORT = 17_000 + os.getpid() % 1000
NODES = ("confocal_driver", "corrector", "calibrator", "recorder")
MOST_GROWTH = 0.01
LONGEST_FAULT_S = 3.0
LONGEST_DELAY_S = 8.0  # of a listener that was stopped, and asks again each 3 s for what it missed
READING_PERIOD_S = 5.0


def held_bytes(pid):
    """Memory that a process holds: its own, and that of the middleware's segments.

    Pages of libraries are the system's, which fetches and drops them as it likes.
    """
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    sizes = dict(line.split(":", 1) for line in lines)
    return 1024 * sum(int(sizes[name].split()[0]) for name in ("RssAnon", "RssShmem"))


class Hour:
    """A cell behind a wire that breaks, and what is done to it."""

    def __init__(self, cell, wire, calibration, step_test):
        self.cell, self.wire = cell, wire
        self.steps = cell.folder / "steps.mcap"
        with BagWriter(self.steps, (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)) as bag:
            for axes, distance in blocks_of(step_test):
                bag.write_block(axes)
                bag.write_block(distance)
        self.calibration_file = cell.folder / "cal.json"
        save_calibration(self.calibration_file, calibration)
        self.bags, self.readings = [], []
        self.looked = time.monotonic()
        self.restart = {
            "confocal_driver": lambda: cell.start_driver(port=f"tcp://127.0.0.1:{wire.port}"),
            # Another calibration would begin another account.
            "corrector": lambda: cell.processes.start(
                "corrector", calibration=str(self.calibration_file), follow_calibrator=False
            ),
            # Less than it has room for would be memory that grows as it should.
            "calibrator": lambda: cell.processes.start(
                "calibrator", output=str(cell.folder / "kept.json"), buffer_samples=100_000
            ),
            "recorder": self._start_recorder,
        }

    def _start_recorder(self):
        self.bags.append(self.cell.folder / f"scan-{len(self.bags)}.mcap")
        self.cell.processes.start("recorder", path=str(self.bags[-1]))

    def start(self):
        self.cell.start_emulator(
            link=f"tcp://127.0.0.1:{DEVICE_PORT}",
            time_lapse=1.0,
            start_radius=START_RADIUS_M,
            feed_per_turn=FEED_PER_TURN_M,
        )
        self.cell.wait("the device", lambda: self._state("cell_emulator") == "active")
        for start in self.restart.values():
            start()
        value = self.cell.operator.value
        self.cell.wait(
            "the nodes",
            lambda: (
                value("confocal_driver", "axes_subscribers") >= 3
                and value("confocal_driver", "confocal_subscribers") >= 3
                and value("confocal_driver", "connections") >= 1
            ),
        )
        assert self.cell.call(Trigger, "cell_emulator/scan").success

    def _state(self, node):
        return self.cell.operator.text(node, "lifecycle")

    @property
    def played(self):
        return self.cell.operator.value("cell_emulator", "samples_played")

    def pass_by(self, seconds):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            rclpy.spin_once(self.cell.operator, timeout_sec=0.1)
            self.cell.processes.check()
            if time.monotonic() - self.looked > READING_PERIOD_S:
                self.looked = time.monotonic()
                self.readings.append((self.played, memory(self)))

    # Faults.

    def network_gone(self):
        self.wire.vanish()
        self.pass_by(3.0)
        self.wire.come_back()

    def connection_cut(self):
        self.wire.cut()

    def noise_on_the_wire(self):
        self.wire.disturb(bytes(range(256)) * 2)

    def stopped(self, node):
        os.kill(self.cell.processes.pid(node), signal.SIGSTOP)
        self.pass_by(2.0)
        os.kill(self.cell.processes.pid(node), signal.SIGCONT)

    def deactivated(self, node):
        for step in (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_ACTIVATE):
            asked = Transition(id=step)
            assert self.cell.call(ChangeState, f"{node}/change_state", transition=asked).success
            self.pass_by(1.0)

    def foolish_requests(self):
        for kind, name, fields in (
            (LoadCalibration, "corrector/load_calibration", {"path": "/dev/zero"}),
            (PredictError, "corrector/predict_error", {"z": [0.0] * 50, "sample_period": 1e300}),
            (Identify, "calibrator/identify", {"order": 99}),
            (Identify, "calibrator/identify", {"duration": 1.0}),
        ):
            assert self.cell.call(kind, name, **fields).message

    def identified(self):
        """Identify a bag: no fault, but the largest work of a node."""
        assert self.cell.call(Identify, "calibrator/identify", bag=str(self.steps)).success

    def killed(self, node):
        self.cell.processes.end(node, how=signal.SIGKILL)
        self.cell.operator.forget(node)
        self.restart[node]()
        begin = time.monotonic()
        self.cell.wait(f"the new {node}", lambda: self._state(node) == "active")
        print(f"{node} is back after {time.monotonic() - begin:.1f} s")

    def faults(self):
        """Return faults that may happen at any time, and those that restart a node."""
        lasting = [self.network_gone, self.connection_cut, self.noise_on_the_wire]
        lasting += [lambda n=node: self.stopped(n) for node in NODES]
        lasting += [lambda: self.deactivated("confocal_driver"), self.foolish_requests]
        lasting.append(self.identified)
        killed = [lambda n=node: self.killed(n) for node in NODES if node != "corrector"]
        return lasting, killed


def test_an_hour_with_a_fault_every_minute(cell, true_calibration, step_test):
    with BrokenWire(DEVICE_PORT) as wire:
        hour = Hour(cell, wire, true_calibration, step_test)
        hour.start()
        lasting, killed = hour.faults()
        both = itertools.chain.from_iterable(zip(itertools.cycle(killed), itertools.cycle(lasting)))
        # Memory is that of one life, in which queues have filled and each fault was met once: nodes
        # are killed for a third of the time, then they live on.
        round_of_all = round(len(lasting) * (FAULT_PERIOD_S + LONGEST_FAULT_S) * 1000)
        strike(hour, both, SAMPLES // 2 - round_of_all)
        strike(hour, itertools.cycle(lasting), SAMPLES - round(FAULT_PERIOD_S * 1000))
        cell.operator.wait_until("the end", lambda: hour.played >= SAMPLES, lambda: hour.played)
        growth = {node: growth_of(hour.readings, node) for node in NODES}
        print(f"memory growth in the second half {growth}")
        the_account_is_closed(cell)
        cell.processes.end("recorder")
        assert sum(map(recorded_samples, hour.bags)) > 0.9 * SAMPLES
        delays = [longest_delay_s(bag) for bag in hour.bags]
        print(f"clouds reached the recorders after at most {delays} s")
        assert max(delays) < LONGEST_DELAY_S
        assert max(growth.values()) < MOST_GROWTH, growth


def growth_of(readings, node):
    """By how much the memory of a node grew in the second half, as a share of what it held.

    Work needs memory for a while and gives it back, so means of thirds of that half are compared,
    each as long as all faults take; what grows steadily does so by two thirds of it between them.
    """
    thirds = [[], [], []]
    for played, held in readings:
        if (place := played / SAMPLES) >= 0.5:
            thirds[min(int(6 * place) - 3, 2)].append(held[node])
    first, _, last = map(np.mean, thirds)
    return 1.5 * (last - first) / first


def strike(hour, faults, until):
    """Let faults occur until ``until`` samples are played."""
    for fault in faults:
        if hour.played >= until:
            break
        hour.pass_by(FAULT_PERIOD_S)
        fault()
        print(hour.played, memory(hour), flush=True)


def memory(hour):
    return {node: held_bytes(hour.cell.processes.pid(node)) for node in NODES}


def the_account_is_closed(cell):
    for stream in ("axes", "distance"):
        cell.settle("corrector", f"{stream}_received")
        received = cell.closed_account(stream)
        missing = cell.operator.value("corrector", f"missing_{stream}")
        corrected = cell.operator.value("corrector", f"{stream}_corrected")
        print(f"{stream}: {received} received, {corrected} corrected, {missing} missing")
        assert received + missing == SAMPLES
        assert corrected > 0.9 * SAMPLES
    assert cell.operator.value("corrector", "slip_samples") == 0
    for node in NODES:
        assert cell.operator.value(node, "defects") == 0, cell.operator.text(node, "message")


def recorded_samples(path):
    """Samples of axes in a bag; one of a recorder that was killed has no index."""
    with bags.BagReader(path) as reader:
        return sum(len(block) for _, block in reader.records(bags.AXES_TOPIC))


def longest_delay_s(path):
    """How long a cloud was on its way to the recorder, at most: it is older than its stamp."""
    delays = [0.0]
    with bags.BagReader(path) as reader:
        for _, recorded_ns, cdr in reader.messages([bags.POINTS_TOPIC], None, None):
            sec, nanosec = struct.unpack_from("<iI", cdr, 4)
            delays.append(1e-9 * (recorded_ns - nanosec) - sec)
    return max(delays)
