"""The topic ``calibration`` tells the one in force, in whatever order nodes are started again."""

import signal
from dataclasses import replace

import pytest
from omsm_msgs.msg import Calibration as CalibrationMessage
from omsm_msgs.srv import LoadCalibration

from omsm_ros.io.calibration_file import load_calibration, save_calibration
from omsm_ros.nodes.topics import LATCHED_BY_MANY_QOS, LATCHED_QOS


class Listener:
    """A late subscriber, which gets the latched messages."""

    def __init__(self, cell):
        self._cell, self._heard = cell, {}
        self._subscription = cell.operator.create_subscription(
            CalibrationMessage, "/omsm/calibration", self._on_message, LATCHED_BY_MANY_QOS
        )

    def _on_message(self, message):
        stamp = message.header.stamp
        self._heard[stamp.sec * 10**9 + stamp.nanosec] = message.id

    def hears_only(self, calibration):
        self._cell.wait("what is in force", lambda: calibration.id in self._heard.values())
        self._cell.settle("corrector", "clouds_published")
        assert set(self._heard.values()) == {calibration.id}


@pytest.fixture
def two(cell, true_calibration):
    """Two calibrations, in files of their own outside the calibrator's folder."""
    made = [replace(true_calibration, settings={"number": k}) for k in range(2)]
    for k, calibration in enumerate(made):
        save_calibration(cell.folder / f"{k}.json", calibration)
    return made


def start_calibrator(cell):
    cell.processes.start("calibrator", output=str(cell.folder / "kept" / "cal.json"))


def load(cell, k):
    path = str(cell.folder / f"{k}.json")
    return cell.call(LoadCalibration, "corrector/load_calibration", path=path)


def until(cell, node, calibration):
    cell.wait(
        f"{node} to have it", lambda: cell.operator.text(node, "calibration") == calibration.id
    )


def again(cell, node, start):
    """Kill a node, start it anew, and wait until the new one has spoken."""
    cell.processes.end(node, how=signal.SIGKILL)
    cell.operator.forget(node)
    start()


@pytest.mark.soak
def test_through_restarts_in_any_order(cell, two):
    first, second = two
    start_calibrator(cell)
    cell.processes.start("corrector")
    assert load(cell, 0).success
    until(cell, "calibrator", first)
    assert load(cell, 1).success
    until(cell, "calibrator", second)
    Listener(cell).hears_only(second)
    link = cell.folder / "kept" / "cal.json"
    assert link.is_symlink()
    assert load_calibration(link).id == second.id
    assert len(list(link.parent.glob("cal.*.json"))) == 2

    again(cell, "corrector", lambda: cell.processes.start("corrector"))
    until(cell, "corrector", second)
    again(cell, "calibrator", lambda: start_calibrator(cell))
    until(cell, "calibrator", second)
    Listener(cell).hears_only(second)

    cell.processes.end("calibrator", how=signal.SIGKILL)
    again(cell, "corrector", lambda: cell.processes.start("corrector"))
    start_calibrator(cell)
    until(cell, "corrector", second)
    Listener(cell).hears_only(second)


@pytest.mark.soak
def test_what_the_corrector_refuses_is_not_in_force(cell, two):
    first, foreign = two
    cell.processes.start("corrector", settings='{"number": 0}')
    assert load(cell, 0).success
    start_calibrator(cell)
    until(cell, "calibrator", first)
    other = cell.operator.create_publisher(CalibrationMessage, "/omsm/calibration", LATCHED_QOS)
    from omsm_ros.io import message_mapping

    now = cell.operator.get_clock().now().nanoseconds
    message = message_mapping.calibration_message(message_mapping.ros_messages(), foreign, now)
    cell.wait("two listeners", lambda: other.get_subscription_count() >= 2)
    other.publish(message)
    cell.wait("the refusal", lambda: "refused" in cell.operator.text("corrector", "message"))
    assert cell.operator.text("corrector", "calibration") == first.id
    cell.operator.destroy_publisher(other)
    until(cell, "calibrator", first)
    Listener(cell).hears_only(first)


def test_a_second_calibrator_does_not_take_the_first_ones_file_for_its_own(cell):
    output = str(cell.folder / "cal.json")
    cell.processes.start("calibrator", output=output)
    cell.wait("it", lambda: cell.operator.text("calibrator", "lifecycle") == "active")
    cell.processes.start("calibrator", "-r", "__ns:=/cell2", label="second", output=output)
    with pytest.raises(Exception, match=r"second ended with exit code 2.*cal.json' is in use"):
        cell.wait("the end of the second", lambda: False)
    cell.processes._running.pop("second")
