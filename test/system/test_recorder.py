"""Messages published before a recorder ends are in its bag, however it ends."""

import os
import resource
import signal
import time

import numpy as np
import pytest
import rclpy
from omsm_msgs.msg import AxisBlock, Calibration

from omsm_ros.core.streams import blocks
from omsm_ros.io import bags, message_mapping
from omsm_ros.io.bag_repair import repair
from omsm_ros.io.bag_writer import next_free
from omsm_ros.nodes.topics import LATCHED_QOS

SAMPLES = 20


def start_recorder(cell, path):
    cell.processes.start("recorder", path=str(path))
    publisher = cell.publisher("axes", AxisBlock)
    # Messages before both sides have discovered each other may arrive seconds late.
    cell.wait("it hears", lambda: cell.operator.value("recorder", "publishers_of_/omsm/axes") == 1)
    return publisher


def end(cell, *signals):
    for number in signals:
        os.kill(cell.processes.pid("recorder"), number)
    cell.processes.end("recorder", how=signals[-1])


def forget(cell, publisher):
    """Wait until the recorder that has ended is gone, so that it does not pass for the next."""
    cell.wait("its end is known", lambda: publisher.get_subscription_count() == 0)
    cell.operator.destroy_publisher(publisher)
    cell.operator.forget("recorder")


class Source:
    """Publishes blocks of axes, each with the number that follows."""

    def __init__(self, publisher):
        self.published = 0
        self._publisher = publisher
        self._messages = message_mapping.ros_messages()
        self._zeros = {name: np.zeros(SAMPLES) for name in "xyzbc"}

    def publish(self, count, pause=0.0):
        for _ in range(count):
            block = blocks.AxisBlock(
                stamp_ns=time.time_ns(),
                first_sample=SAMPLES * self.published,
                sample_period=1e-3,
                **self._zeros,
            )
            self._publisher.publish(message_mapping.block_message(self._messages, block))
            self.published += 1
            time.sleep(pause)


def numbers_in(path):
    with bags.BagReader(path) as reader:
        return [b.first_sample // SAMPLES for _, b in reader.records(bags.AXES_TOPIC)]


def end_again_and_again(cell, times, signals):
    random = np.random.default_rng(times)
    for trial in range(times):
        path = cell.folder / f"{signals[0].name}-{trial}.mcap"
        publisher = start_recorder(cell, path)
        source = Source(publisher)
        source.publish(int(random.integers(1, 400)), pause=0.001)
        end(cell, *signals)
        assert numbers_in(path) == list(range(source.published))
        forget(cell, publisher)


def test_ctrl_c_below_launch_twice(cell):
    end_again_and_again(cell, 2, (signal.SIGINT, signal.SIGINT))


@pytest.mark.soak
@pytest.mark.timeout(0)
def test_ctrl_c_below_launch_fifty_times(cell):
    end_again_and_again(cell, 50, (signal.SIGINT, signal.SIGINT))


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_other_signals(cell, number):
    # Below nohup, which nodes would inherit, they ignore SIGHUP as they should.
    before = signal.signal(number, signal.SIG_DFL)
    try:
        end_again_and_again(cell, 1, (number,))
    finally:
        signal.signal(number, before)


def test_killed_at_any_moment_all_but_the_last_second_is_there(cell):
    path = cell.folder / "killed.mcap"
    source = Source(start_recorder(cell, path))
    source.publish(200, pause=0.002)
    seen = cell.settle("recorder", "/omsm/axes")
    time.sleep(0.7)  # 1.5 s since the last message
    source.publish(100)
    end(cell, signal.SIGKILL)
    try:
        numbers = numbers_in(path)
    except bags.BagError:
        numbers = numbers_in(repair(path).path)
    assert seen == 200
    assert numbers == list(range(len(numbers)))
    assert len(numbers) >= seen


def test_a_bag_that_exists_is_refused(cell):
    path = cell.folder / "precious.mcap"
    path.write_bytes(b"precious")
    cell.processes.start("recorder", path=str(path))
    with pytest.raises(Exception, match=r"exit code 2.*exists and is not overwritten"):
        cell.wait("it to end", lambda: False)
    cell.processes._running.clear()
    assert path.read_bytes() == b"precious"


def test_a_restarted_recorder_writes_a_new_bag_next_to_the_old_one(cell):
    path = cell.folder / "scan.mcap"
    path.write_bytes(b"precious")
    cell.processes.start("recorder", path=str(path), numbered=True)
    cell.wait("it", lambda: cell.operator.text("recorder", "lifecycle") == "active")
    end(cell, signal.SIGINT)
    assert path.read_bytes() == b"precious"
    assert numbers_in(cell.folder / "scan.2.mcap") == []
    assert next_free(path) == cell.folder / "scan.3.mcap"


def test_at_the_limit_of_size_the_recorder_ends_and_says_so(cell):
    path = cell.folder / "limited.mcap"
    source = Source(start_recorder(cell, path))
    source.publish(50)
    cell.wait("them on the disk", lambda: path.stat().st_size > 50 * SAMPLES * 8)
    cell.settle("recorder", "/omsm/axes")
    limit = path.stat().st_size + 5000
    resource.prlimit(cell.processes.pid("recorder"), resource.RLIMIT_FSIZE, (limit, limit))
    source.publish(50)
    with pytest.raises(Exception, match=r"exit code 2.*File too large.*holds the first \d+ mess"):
        cell.wait("it to end", lambda: False)
    cell.processes._running.clear()
    assert numbers_in(path) == list(range(50))


def test_the_calibration_is_recorded_and_its_durability(cell, true_calibration):
    path = cell.folder / "with.mcap"
    publisher = cell.operator.create_publisher(Calibration, "/omsm/calibration", LATCHED_QOS)
    publisher.publish(
        message_mapping.calibration_message(message_mapping.ros_messages(), true_calibration, 7)
    )
    # The recorder starts later, and gets it.
    start_recorder(cell, path)
    cell.wait("it recorded", lambda: cell.operator.value("recorder", "/omsm/calibration") == 1)
    end(cell, signal.SIGINT)
    with bags.BagReader(path) as reader:
        ((_, found),) = reader.records(bags.CALIBRATION_TOPIC)
    assert found.id == true_calibration.id
    rclpy.spin_once(cell.operator, timeout_sec=0)
