"""What the motion says of two counters, live: against the truth, or nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.samples.blocks import AxisBlock, DistanceBlock, FloatArray
from omsm_ros.core.samples.slips import TWO_DRIVERS_S, CommonTrigger
from omsm_ros.core.verification.live_offset import LiveOffset
from omsm_ros.nodes.correction_state import CorrectionState
from omsm_ros.nodes.diagnostics import ERROR
from omsm_ros.twin.cell import blocks_of
from omsm_ros.twin.plant import PAPER_STATIC_GAIN, Plant
from omsm_ros.twin.scenario import Scenario, step_test_of

N, BLOCK, PERIOD, NOISE = 8000, 50, 1e-3, 10e-9
G = Plant().dynamics
CALIBRATION = Calibration(
    dynamics=G,
    static_gain=PAPER_STATIC_GAIN,
    sample_period=PERIOD,
    valid_up_to=100.0,
    covariance=np.diag(np.full(len(G.numerator) + len(G.denominator), 1e-24)),
)
LAG = G.low_frequency_delay / PERIOD
Blocks = list[tuple[AxisBlock, DistanceBlock]]


def motion(kind: str) -> FloatArray:
    """Z of a chirp, of uneven steps, of a sine, or at rest [m], (n,)."""
    t = np.arange(N + 2000) * PERIOD
    if kind == "chirp":
        return np.asarray(20e-6 * np.sin(2 * np.pi * (0.5 * t + 0.35 * t**2)))
    if kind == "sine":
        return np.asarray(20e-6 * np.sin(2 * np.pi * t / 0.12))
    if kind == "rest":
        return np.zeros(len(t))
    edges = np.cumsum(np.random.default_rng(2).integers(150, 450, 60))
    window = np.hanning(31) / np.hanning(31).sum()
    return np.convolve(np.searchsorted(edges, t / PERIOD) % 4 * 10e-6, window, "same")


def blocks(z: FloatArray, slip: int, *, late: float = 0.0, followed: float = 0.0) -> Blocks:
    """Both streams: equal counts mean triggers ``slip`` apart, axes are stamped ``late`` [s].

    followed: share of the motion of Z that the surface makes, too, 25 samples later
    """
    random, made = np.random.default_rng(4), []
    still = np.zeros(BLOCK)
    for first in range(500, N, BLOCK):
        k = first + np.arange(BLOCK)
        at = np.arange(len(z))
        seen = np.interp(k + slip - LAG, at, z) - followed * np.interp(k + slip - 25, at, z)
        distance = 50e-6 - PAPER_STATIC_GAIN * seen + random.normal(0.0, NOISE, BLOCK)
        when, stamp = first * PERIOD, {"first_sample": first, "sample_period": PERIOD}
        axes = AxisBlock(
            stamp_ns=round((when + late) * 1e9), x=still, y=still, z=z[k], b=still, c=still, **stamp
        )
        jitter = float(random.normal(0.0, 5e-6))
        made.append(
            (axes, DistanceBlock(stamp_ns=round((when + jitter) * 1e9), distance=distance, **stamp))
        )
    return made


def watched(came: Blocks, in_use: int = 0) -> LiveOffset:
    watch = LiveOffset(CALIBRATION, in_use)
    for i, (axes, distance) in enumerate(came):
        watch.add(axes)
        watch.add(distance)
        if i % 20 == 0:
            watch.judge()
    return watch


@pytest.mark.parametrize("kind", ["chirp", "steps"])
@pytest.mark.parametrize("slip", [-40, -1, 0, 1, 3])
def test_a_motion_before_the_target_tells_the_offset(kind: str, slip: int) -> None:
    found = watched(blocks(motion(kind), slip)).established
    assert found is not None
    assert found.samples == slip
    assert abs(found.fraction) < 0.2


@pytest.mark.parametrize("slip", [0, -4])
def test_the_papers_step_test_tells_it(slip: int) -> None:
    came = [
        (
            replace(axes, first_sample=axes.first_sample + 4 + slip),
            replace(d, first_sample=d.first_sample + 4),
        )
        for axes, d in blocks_of(step_test_of(Scenario(seed=3)))
    ]
    found = watched(came).established
    assert found is not None
    assert found.samples == slip
    assert abs(found.fraction) < 0.02
    assert abs(found.gain / PAPER_STATIC_GAIN - 1) < 1e-3


def test_an_offset_that_is_stated_is_none_any_more() -> None:
    found = watched(blocks(motion("chirp"), 3), in_use=3).established
    assert found is not None
    assert found.samples == 0


@pytest.mark.parametrize(
    ("kind", "followed"),
    [("rest", 0.0), ("sine", 0.0), ("chirp", 0.97), ("steps", 1.3), ("steps", 0.1)],
)
def test_a_motion_that_does_not_tell_establishes_nothing(kind: str, followed: float) -> None:
    assert watched(blocks(motion(kind), 3, followed=followed)).established is None


def test_a_counter_that_begins_anew_has_to_be_established_anew() -> None:
    came = blocks(motion("chirp"), 0)
    watch = watched(came)
    assert watch.established is not None
    watch.add(came[0][1])
    assert watch.established is None


def test_it_is_told_within_two_seconds_of_motion() -> None:
    assert watched(blocks(motion("steps"), 1)[:42]).established is not None


def reported(slip: int, late: float, tolerance: float = TWO_DRIVERS_S) -> tuple[str, str]:
    """Return what the corrector says of a motion, and the offset it established."""
    trigger = CommonTrigger(stamp_tolerance=tolerance)
    came = blocks(motion("steps"), slip, late=late)
    corrector = Corrector(CALIBRATION, CorrectionOptions(trigger=trigger))
    for axes, distance in came:
        corrector.push_axes(axes)
        corrector.push_distance(distance)
    assert not corrector.slips.one_driver
    watch = watched(came, trigger.counter_offset)
    report = CorrectionState().report(corrector, 0.0, 0.0, watch)
    said = report.text if report.level == ERROR else ""
    return said, str(report.values["motion_offset_samples"])


def test_a_slip_that_a_late_link_hides_from_the_stamps_is_told_by_the_motion() -> None:
    """Axes three samples ahead, and 3 ms late: their stamps agree, their samples do not."""
    said, offset = reported(3, late=0.0)
    assert offset == "3"
    assert "state counter_offset 3" in said


def test_a_link_that_is_late_is_told_from_a_slip() -> None:
    said, offset = reported(0, late=3e-3)
    assert offset == "0"
    assert "slipped by 3 samples" in said
    assert "equal counts are one trigger: a link is late" in said


def test_nothing_is_said_where_stamps_and_motion_agree() -> None:
    assert reported(0, late=0.0) == ("", "0")
    assert reported(0, late=3e-3, tolerance=3e-3) == ("", "0")
