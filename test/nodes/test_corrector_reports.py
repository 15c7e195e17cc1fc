"""The corrector reports its counts: nothing yet, silence, refusals, losses, waiting."""

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

from two_counters import CALIBRATION, PERIOD

from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
from omsm_ros.core.streams.blocks import AxisBlock, DistanceBlock
from omsm_ros.nodes.corrector_node import CorrectionState
from omsm_ros.nodes.diagnostics import ERROR, OK, STALE, WARN

BLOCK = 100


def blocks(first):
    still = np.zeros(BLOCK)
    both = {"stamp_ns": round(first * PERIOD * 1e9), "first_sample": first, "sample_period": PERIOD}
    axes = AxisBlock(x=still, y=still, z=still, b=still, c=still, **both)
    return axes, DistanceBlock(distance=np.full(BLOCK, 50e-6), **both)


def heard(state, first, now, streams=("axes", "distance"), period=PERIOD):
    for stream in streams:
        state.heard(stream, first, BLOCK, period, now)


def flowing(seconds, corrector=None):
    """Return a state after ``seconds`` of both streams, and the time."""
    state = CorrectionState()
    for i in range(round(seconds / (BLOCK * PERIOD))):
        heard(state, i * BLOCK, i * BLOCK * PERIOD)
        if corrector is not None:
            axes, distance = blocks(i * BLOCK)
            corrector.push_axes(axes)
            corrector.push_distance(distance)
    now = seconds
    state.report(corrector, 0.0, 0.0)
    state.report(corrector, now, 0.0)
    return state, now


def test_before_anything_came_each_stream_is_missed_by_name():
    report = CorrectionState().report(None, 0.0, 0.0)
    assert report.level == STALE
    assert "no sample of axes yet" in report.text
    assert "no sample of distance yet" in report.text
    assert "no calibration: nothing is published" in report.text
    assert report.values["clouds_published"] == 0


def test_samples_without_a_calibration_are_counted_as_such():
    state, now = flowing(2.0)
    state.uncalibrated["axes"] += 1700
    report = state.report(None, now, 0.0)
    assert report.level == WARN
    assert report.text == "no calibration: nothing is published"
    assert report.values["axes_uncalibrated"] == 1700
    assert report.values["distance_uncalibrated"] == 0
    assert "latency_median_ms" not in report.values


def test_with_a_calibration_and_samples_it_is_correcting():
    corrector = Corrector(CALIBRATION, CorrectionOptions())
    state, now = flowing(2.0, corrector)
    state.published = 7
    report = state.report(corrector, now, 0.0)
    assert (report.level, report.text) == (OK, "correcting")
    assert report.values["clouds_published"] == 7
    received = corrector.account.as_dict()["axes"]["received"]
    assert received == 2000 == report.values["axes_received"]
    counted = sum(
        report.values[f"axes_{name}"] for name in corrector.account.as_dict()["axes"]["counted"]
    )
    assert report.values["axes_corrected"] + counted <= received
    assert report.values["slip_samples"] == 0


def test_the_rate_is_that_of_the_samples_and_the_first_trigger_is_kept():
    state = CorrectionState()
    heard(state, 4200, 0.0)
    state.report(None, 0.0, 0.0)
    for i in range(1, 21):
        heard(state, 4200 + i * BLOCK, i * 0.1)
    report = state.report(None, 2.0, 0.0)
    assert report.values["rate_hz_axes"] == pytest.approx(1000.0)
    assert report.values["begins_at_axes"] == 4200


@pytest.mark.parametrize(
    ("period", "waited", "reported"), [(1e-3, 1.9, False), (1e-3, 2.5, True), (1.0, 4.5, False)]
)
def test_silence_is_reported_after_two_seconds_or_five_samples(period, waited, reported):
    state = CorrectionState()
    heard(state, 0, 0.0, period=period)
    state.report(None, 0.0, 0.0)
    report = state.report(None, waited, 0.0)
    assert ("no sample of axes for" in report.text) == reported


def test_one_stream_may_be_silent_alone():
    state = CorrectionState()
    heard(state, 0, 0.0)
    state.report(None, 0.0, 0.0)
    for i in range(1, 8):
        heard(state, i * BLOCK, float(i), streams=("axes",))
        report = state.report(None, float(i), 0.0)
    assert "no sample of distance for 7 s" in report.text
    assert "axes for" not in report.text


def test_a_motion_pauses_when_no_block_came_for_a_second_or_three_blocks():
    state = CorrectionState()
    state.heard("axes", 0, 100, 1e-3, now=10.0)
    assert not state.has_paused(10.9)
    assert state.has_paused(11.1)
    state.heard("axes", 100, 100, 1e-2, now=10.0)  # blocks of a second
    assert not state.has_paused(12.9)
    assert state.has_paused(13.1)


def corrected(seconds=2.0):
    corrector = Corrector(CALIBRATION, CorrectionOptions())
    return corrector, *flowing(seconds, corrector)


def test_a_stream_of_which_every_block_is_refused_cannot_be_corrected():
    corrector = Corrector(CALIBRATION, CorrectionOptions())
    state = CorrectionState()
    for i in range(20):
        heard(state, i * BLOCK, i * 0.1)
        state.refused["distance"] += BLOCK
    state.refusal = "sample period is 0 s"
    report = state.report(corrector, 2.0, 0.0)
    assert report.level == ERROR
    assert "every block of distance is refused: sample period is 0 s" in report.text
    assert "of axes is refused" not in report.text
    assert report.values["distance_refused"] == 2000


def test_some_refused_blocks_are_a_warning_that_passes():
    corrector, state, now = corrected()
    state.refused["axes"] += 30
    report = state.report(corrector, now, 0.0)
    assert report.level == WARN
    assert "just now: 30 samples of axes refused" in report.text
    for later in range(2, 16):  # they go on coming
        heard(state, 2000 + later * BLOCK, now + later)
        report = state.report(corrector, now + later, 0.0)
    assert "refused" not in report.text
    assert report.values["axes_refused"] == 30


def test_missing_samples_are_reported_with_their_number():
    corrector, state, now = corrected()
    for first in (2500, 2600, 2700):  # 500 triggers were lost on the way
        axes, distance = blocks(first)
        corrector.push_axes(axes)
        corrector.push_distance(distance)
        heard(state, first, now)
    report = state.report(corrector, now, 0.0)
    assert report.level == WARN
    assert report.text.startswith("just now: ")
    assert "missing 500" in report.text
    assert report.values["missing_axes"] == 500


@pytest.mark.parametrize("stream", ["axes", "distance"])
def test_a_stream_without_a_valid_sample_is_a_warning_with_its_reason(stream):
    corrector, state = Corrector(CALIBRATION, CorrectionOptions()), CorrectionState()
    for first in range(0, 2000, BLOCK):
        axes, distance = blocks(first)
        (axes.z if stream == "axes" else distance.distance)[:] = np.nan
        corrector.push_axes(axes)
        corrector.push_distance(distance)
        heard(state, first, first * PERIOD)
    report = state.report(corrector, 2.0, 0.0)
    assert report.level == WARN
    invalid = report.values["distance_invalid"]
    assert f"nothing to correct: {invalid} samples invalid just now: the probe" in report.text


def test_the_oldest_of_what_was_taken_tells_how_late_it_was():
    corrector, state, now = corrected()
    for arrived in (5_000_000_000, 3_000_000_000, 6_000_000_000):
        state.arrived(arrived)
    state.done(6_500_000_000)
    report = state.report(corrector, now, 0.0)
    assert report.values["latency_max_ms"] == 3500.0
    assert "falls behind: samples waited 3.5 s" in report.text
    state.done(9_000_000_000)  # nothing had arrived
    heard(state, 2000, now)
    report = state.report(corrector, now, 0.0)
    assert report.values["latency_max_ms"] == 3500.0
    assert "falls behind" not in report.text  # since the last report nobody waited


def test_counts_go_on_where_a_new_calibration_begins_a_new_correction():
    first, state, now = corrected()
    before = state.report(first, now, 0.0).values["axes_received"]
    first.finish()
    state.keep(first.account)
    second = Corrector(CALIBRATION, CorrectionOptions())
    assert state.report(second, now, 0.0).values["axes_received"] == before > 0
    for block in blocks(2000):
        (second.push_axes if isinstance(block, AxisBlock) else second.push_distance)(block)
    second.finish()
    values = state.report(second, now, 0.0).values
    assert values["axes_received"] == before + BLOCK
    account = state.account(second)
    for stream in (account.axes, account.distance):
        counted = stream.corrected + stream.pending + sum(stream.counted.values())
        assert counted == stream.received == before + BLOCK
