"""The nodes concerned report the present state on /diagnostics."""

import os
import signal
import time

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from omsm_msgs.msg import AxisBlock, DistanceBlock
from std_srvs.srv import Trigger
from system.broken_wire import BrokenWire

from omsm_ros.instruments.emulator_factory import emulated
from omsm_ros.io import message_mapping
from omsm_ros.io.calibration_file import save_calibration

OK, WARN, ERROR, STALE = (
    str(level[0])
    for level in (
        DiagnosticStatus.OK,
        DiagnosticStatus.WARN,
        DiagnosticStatus.ERROR,
        DiagnosticStatus.STALE,
    )
)
SCALES = emulated("six_channel").driver


def until(cell, node, level, words=""):
    cell.wait(
        f"{node} to say {words!r} at level {level}",
        lambda: (
            cell.operator.text(node, "level") == level
            and words in cell.operator.text(node, "message")
        ),
    )


def test_a_gap_is_reported_while_recent_and_then_only_counted(
    cell, true_calibration, small_scan_blocks
):
    """Starved, correcting, a gap, every block refused: each a level of its own, and each ends."""
    path = cell.folder / "cal.json"
    save_calibration(path, true_calibration)
    cell.processes.start("corrector", calibration=str(path))
    until(cell, "corrector", STALE, "no sample of axes yet")
    axes, distance = cell.publisher("axes", AxisBlock), cell.publisher("confocal", DistanceBlock)
    messages = message_mapping.ros_messages()

    def send(pair, period=None):
        made = (
            message_mapping.block_message(messages, pair[0]),
            message_mapping.block_message(messages, pair[1]),
        )
        for publisher, message in zip((axes, distance), made, strict=True):
            message.sample_period = period or message.sample_period
            publisher.publish(message)

    pairs = iter(small_scan_blocks)
    cell.operator.create_timer(0.1, lambda: send(next(pairs)))
    until(cell, "corrector", OK, "correcting")
    lost = sum(len(next(pairs)[0]) for _ in range(7))
    until(cell, "corrector", WARN, f"axes missing {lost}")
    until(cell, "corrector", WARN, f"distance missing {lost}")
    until(cell, "corrector", OK, "correcting")
    assert cell.operator.value("corrector", "missing_axes") == lost
    assert cell.operator.value("corrector", "missing_distance") == lost
    pairs = iter(())
    cell.operator.destroy_timer(next(cell.operator.timers))
    until(cell, "corrector", STALE, "no sample of axes for")


def test_two_of_a_kind_are_reported_by_both(cell):
    for label in ("corrector", "second"):
        cell.processes.start("corrector", "-r", f"__node:={label}", label=label)
    for node in ("corrector", "second"):
        cell.wait(
            f"{node} to notice",
            lambda node=node: "2 nodes publish /omsm/points" in cell.operator.text(node, "message"),
        )
    cell.processes.end("second")
    cell.wait("peace", lambda: "2 nodes publish" not in cell.operator.text("corrector", "message"))


def test_a_second_emulator_is_refused_and_the_first_keeps_its_port(cell):
    cell.start_emulator()
    cell.wait("the first", lambda: cell.operator.text("cell_emulator", "message"))
    cell.processes.start("cell_emulator", label="second", link=cell.link)
    assert cell.processes._running["second"].wait(30) == 2
    assert "in use by another process" in (cell.folder / "log" / "second.log").read_text()
    del cell.processes._running["second"]
    cell.start_driver()
    until(cell, "confocal_driver", STALE, "no sample has come yet")
    # Killed, it holds the port no longer.
    cell.processes.end("cell_emulator", how=signal.SIGKILL)
    until(cell, "confocal_driver", ERROR)
    cell.start_emulator()
    until(cell, "confocal_driver", STALE)


@pytest.mark.soak
def test_simulated_time_that_nobody_tells_is_reported(cell):
    cell.processes.start("calibrator", use_sim_time=True, output=str(cell.folder / "cal.json"))
    until(cell, "calibrator", WARN, "no node publishes /clock")


def test_two_cells_side_by_side(cell, true_calibration):
    """Each measures its own motion, and neither hears a sample of the other."""
    path = cell.folder / "cal.json"
    save_calibration(path, true_calibration)
    cells = {"/omsm": 10_000, "/hall/cell2": 8_000}
    for namespace, samples in cells.items():
        link = str(cell.folder / namespace.strip("/").replace("/", "_"))
        given = {
            "cell_emulator": {"link": link, "time_lapse": 20.0, "start_radius": samples * 5e-8},
            "confocal_driver": {"port": link, **SCALES},
            "corrector": {"calibration": str(path)},
        }
        for node, parameters in given.items():
            label = f"{namespace}{node}".replace("/", "_")
            cell.processes.start(node, "-r", f"__ns:={namespace}", label=label, **parameters)

    def name(namespace, node):
        return f"{namespace}/{node}".removeprefix("/omsm/")

    for namespace in cells:
        cell.wait(
            f"the driver of {namespace}",
            lambda n=namespace: (
                cell.operator.value(name(n, "confocal_driver"), "axes_subscribers") == 1
                and cell.operator.value(name(n, "confocal_driver"), "connections") == 1
            ),
        )
    for namespace in cells:
        service = f"{namespace}/cell_emulator/scan"
        assert cell.operator.ask(Trigger, service, Trigger.Request()).success
    for namespace, samples in cells.items():
        cell.wait(
            f"all of {namespace}",
            lambda n=namespace, s=samples: (
                cell.operator.value(name(n, "corrector"), "distance_received") >= s
            ),
        )
        assert cell.settle(name(namespace, "corrector"), "axes_received") == samples


@pytest.mark.soak
def test_a_device_that_vanishes_is_stale_then_connected_anew_and_its_gap_counted(
    cell, true_calibration
):
    """Both ends of the connection stay up, and nothing passes."""
    device_port = 18_000 + os.getpid() % 1000
    with BrokenWire(device_port) as wire:
        cell.start_correcting(
            true_calibration,
            link=f"tcp://127.0.0.1:{device_port}",
            time_lapse=1.0,
            driver={"port": f"tcp://127.0.0.1:{wire.port}"},
        )
        assert cell.call(Trigger, "cell_emulator/scan").success
        value = cell.operator.value
        cell.wait("samples", lambda: value("corrector", "axes_received") > 1000)
        wire.vanish()
        until(cell, "confocal_driver", STALE, "no sample for")
        cell.wait("a new connection", lambda: value("confocal_driver", "renewals") >= 1)
        before = value("corrector", "axes_received")
        wire.come_back()
        back = time.monotonic()
        cell.wait("samples", lambda: value("corrector", "axes_received") > before)
        assert time.monotonic() - back < 2.0 + 5.0
        cell.wait(
            "the gap, the same at both",
            lambda: value("confocal_driver", "lost") == value("corrector", "missing_axes") > 1500,
        )
