"""The corrector reports a counter offset that its motion shows."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

from two_counters import CALIBRATION, blocks, motion, watched

from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
from omsm_ros.core.streams.trigger_slips import TWO_DRIVERS_S, CommonTrigger
from omsm_ros.nodes.corrector_node import CorrectionState
from omsm_ros.nodes.diagnostics import ERROR


def reported(slip: int, late: float, tolerance: float = TWO_DRIVERS_S) -> tuple[str, str]:
    """Return what the corrector says of a motion, and the offset it established."""
    trigger = CommonTrigger(stamp_tolerance=tolerance)
    came = blocks(motion("steps"), slip, late=late)
    corrector = Corrector(CALIBRATION, CorrectionOptions(trigger=trigger))
    for axes, distance in came:
        corrector.push_axes(axes)
        corrector.push_distance(distance)
    assert not corrector.pairing.watch.same_stamps
    watch = watched(came, trigger.counter_offset)
    report = CorrectionState().report(corrector, 0.0, 0.0, watch)
    said = report.text if report.level == ERROR else ""
    return said, str(report.values["motion_offset_samples"])


def test_a_slip_masked_by_a_late_link_is_detected_from_the_motion() -> None:
    """Axes three samples ahead, and 3 ms late: their stamps agree, their samples do not."""
    said, offset = reported(3, late=0.0)
    assert offset == "3"
    assert "state counter_offset 3" in said


def test_a_link_that_is_late_is_distinguished_from_a_slip() -> None:
    said, offset = reported(0, late=3e-3)
    assert offset == "0"
    assert "slipped by 3 samples" in said
    assert "equal counts are one trigger: a link is late" in said


def test_nothing_is_said_where_stamps_and_motion_agree() -> None:
    assert reported(0, late=0.0) == ("", "0")
    assert reported(0, late=3e-3, tolerance=3e-3) == ("", "0")
