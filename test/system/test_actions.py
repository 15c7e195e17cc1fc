"""Actions state progress, and a cancelled goal ends its computation."""

import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

from action_msgs.msg import GoalStatus
from omsm_msgs.action import Identify, PredictError, Scan
from rclpy.action import ActionClient

from omsm_ros.io import bags
from omsm_ros.io.bag_writer import BagWriter
from omsm_ros.twin.cell import blocks_of


@pytest.fixture
def bag(tmp_path, step_test):
    path = tmp_path / "steps.mcap"
    with BagWriter(path, (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)) as writer:
        for axes, distance in blocks_of(step_test):
            writer.write_block(axes)
            writer.write_block(distance)
    return path


def children(pid):
    """Processes that a process has started."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            words = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(words[1]) == pid:
            found.append(int(stat.parent.name))
    return found


class Client:
    """Sends one goal, and keeps its feedback."""

    def __init__(self, cell, kind, name, **fields):
        self.cell, self.feedback = cell, []
        self.client = ActionClient(cell.operator, kind, f"/omsm/{name}")
        cell.wait(name, self.client.server_is_ready)
        asked = self.client.send_goal_async(
            kind.Goal(**fields), feedback_callback=lambda m: self.feedback.append(m.feedback)
        )
        cell.wait("the goal", asked.done)
        self.handle = asked.result()
        assert self.handle.accepted
        self._result = self.handle.get_result_async()

    def cancel(self):
        self.cell.wait("cancel", self.handle.cancel_goal_async().done)

    def result(self):
        self.cell.wait("the result", self._result.done)
        return self._result.result()

    def close(self):
        self.client.destroy()


def workers_of(pid):
    """Processes that compute for a node."""
    return [child for child in children(pid) if b"spawn_main" in _command(child)]


def test_identify_states_its_progress_and_ends_when_cancelled(cell, bag):
    output = cell.folder / "cal.json"
    cell.processes.start("calibrator", output=str(output))
    node = cell.processes.pid("calibrator")
    first = Client(cell, Identify, "calibrator/identify", bag=str(bag))
    waiting = Client(cell, Identify, "calibrator/identify", bag=str(bag))
    waiting.cancel()
    assert waiting.result().status == GoalStatus.STATUS_CANCELED
    cell.wait("an order", lambda: any(f.order for f in first.feedback))
    assert workers_of(node)
    began = time.monotonic()
    first.cancel()
    answer = first.result()
    assert answer.status == GoalStatus.STATUS_CANCELED
    assert "cancelled" in answer.result.message
    cell.wait("the end of its process", lambda: not workers_of(node))
    assert time.monotonic() - began < 5.0
    assert not output.exists()

    whole = Client(cell, Identify, "calibrator/identify", bag=str(bag))
    answer = whole.result()
    assert answer.status == GoalStatus.STATUS_SUCCEEDED, answer.result.message
    stages = list(dict.fromkeys(f.stage for f in whole.feedback))
    assert stages == ["reading", "steps", "order", "uncertainty"]  # it waited for none
    assert {f.stage for f in waiting.feedback} <= {"waiting"}
    certificate = answer.result.certificate
    assert whole.feedback[-1].steps == certificate.edges > 10
    assert len({f.order for f in whole.feedback}) > 2
    assert max(f.evaluations for f in whole.feedback) > 20
    assert certificate.id == answer.result.calibration.id
    assert certificate.residual_rms > 0

    last = Client(cell, Identify, "calibrator/identify", bag=str(bag))
    cell.wait("an order", lambda: any(f.order for f in last.feedback))
    busy = workers_of(node)
    assert busy
    cell.processes.end("calibrator")
    cell.wait("its process", lambda: not any(b"spawn_main" in _command(pid) for pid in busy))
    for client in (first, waiting, whole, last):
        client.close()


def _command(pid):
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""


def test_a_scan_is_played_or_stopped(cell):
    cell.start_emulator(time_lapse=50.0, start_radius=12.7e-3)
    cell.start_driver()
    goal = Client(cell, Scan, "cell_emulator/scan", motion="step_test")
    answer = goal.result()
    assert answer.status == GoalStatus.STATUS_SUCCEEDED, answer.result.message
    assert answer.result.samples == goal.feedback[-1].samples
    goal.close()
    goal = Client(cell, Scan, "cell_emulator/scan", motion="verifying_scan")
    cell.wait("a sample", lambda: any(f.played for f in goal.feedback))
    goal.cancel()
    answer = goal.result()
    assert answer.status == GoalStatus.STATUS_CANCELED
    assert 0 < answer.result.samples < goal.feedback[-1].samples
    goal.close()
    goal = Client(cell, Scan, "cell_emulator/scan", motion="x" * 10_000)
    answer = goal.result()
    assert answer.status == GoalStatus.STATUS_ABORTED
    assert "step_test" in answer.result.message
    goal.close()


def test_an_error_is_predicted_as_by_the_service(cell, true_calibration):
    from omsm_ros.io.calibration_file import save_calibration

    path = cell.folder / "cal.json"
    save_calibration(path, true_calibration)
    cell.processes.start("corrector", calibration=str(path))
    time_s = np.arange(4000) * 1e-3
    motion = {"z": 1e-3 * np.sin(2 * np.pi * 2 * time_s), "sample_period": 1e-3}
    goal = Client(cell, PredictError, "corrector/predict_error", **motion)
    answer = goal.result()
    assert answer.status == GoalStatus.STATUS_SUCCEEDED, answer.result.message
    # (1 - G) z of a sine, by the response at 2 Hz.
    s = 2j * np.pi * 2
    dynamics = true_calibration.dynamics
    top, below = (np.polynomial.polynomial.polyval(s, c) for c in (
        dynamics.numerator, dynamics.denominator,
    ))  # fmt: skip
    error = 1e-3 * abs(1 - top / below * np.exp(-s * dynamics.delay))
    assert answer.result.peak_to_valley == pytest.approx(2 * error, rel=0.02)
    goal.close()
    goal = Client(cell, PredictError, "corrector/predict_error", bag="/no/such/bag")
    answer = goal.result()
    assert answer.status == GoalStatus.STATUS_ABORTED
    assert np.isnan(answer.result.rms)
    goal.close()
