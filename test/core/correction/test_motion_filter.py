"""The filter over the axes: runs, interruptions, and what it delays."""

from __future__ import annotations

import numpy as np
import pytest

from omsm_ros.core.correction.motion_filter import MotionFilter, MotionFilters
from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.samples.accounts import Reason
from omsm_ros.core.samples.pairing import Run
from omsm_ros.twin.plant import Plant

G = Plant().dynamics
CALIBRATION = Calibration(
    dynamics=G,
    static_gain=1.0,
    sample_period=1e-3,
    valid_up_to=100.0,
    covariance=np.zeros((7, 7)),
)
X, Y, B, C, MOVED, ERROR, DYNAMICS, TIMING = range(8)
SPEED = np.array([2e-3, -1e-3, 3e-3, 0.01, 3.0])


def uniform(first: int, length: int, session: int = 0) -> Run:
    """Axes x, y, z, b, c, each at a constant speed."""
    time = (first + np.arange(length)) * 1e-3
    values = SPEED[:, np.newaxis] * time
    return Run(session, first, 0, 1e6, np.zeros(length, np.uint8), values)


def new(**lags: float) -> MotionFilter:
    return MotionFilter(MotionFilters.of(CALIBRATION, 1e-3, **lags))


def settling() -> int:
    return MotionFilters.of(CALIBRATION, 1e-3).settling_samples()


def test_a_uniform_motion_comes_out_late_by_the_lag_from_the_first_sample() -> None:
    (run,) = new().push(uniform(0, 200))
    lag = SPEED[2] * G.low_frequency_delay
    # The settling samples too: uniform motion is what the start assumes.
    assert np.allclose(run.values[ERROR], lag, rtol=1e-6)
    assert np.array_equal(run.reasons[: settling()], np.full(settling(), Reason.SETTLING))
    assert not run.reasons[settling() :].any()


def test_axes_pass_unless_the_lag_is_latency() -> None:
    (run,) = new().push(uniform(0, 100))
    assert np.array_equal(run.values[[X, Y, B, C]], uniform(0, 100).values[[0, 1, 3, 4]])
    (late,) = new(lateral_lag=0.4e-3).push(uniform(0, 100))
    shift = SPEED[[0, 1, 3, 4]] * 0.4e-3
    delayed = run.values[[X, Y, B, C]] - shift[:, np.newaxis]
    assert np.allclose(late.values[[X, Y, B, C]], delayed, rtol=0, atol=1e-12)


def test_timing_is_the_speed_times_the_uncertainty_of_the_lag() -> None:
    (run,) = new(lateral_lag_uncertainty=2e-6).push(uniform(0, 100))
    assert np.allclose(np.sqrt(run.values[TIMING]), 2e-6 * SPEED[2], rtol=1e-6)
    assert not run.values[DYNAMICS].any()


def test_too_few_samples_wait_and_are_settling_at_the_end() -> None:
    motion = new()
    assert motion.push(uniform(0, 5)) == []
    assert motion.pending == 5
    (run,) = motion.end()
    assert motion.pending == 0
    assert np.all(run.reasons == Reason.SETTLING)


@pytest.mark.parametrize(
    ("first", "session"), [(101, 0), (100, 1)], ids=["a gap", "another session"]
)
def test_an_interruption_settles_again(first: int, session: int) -> None:
    motion = new()
    motion.push(uniform(0, 100))
    (run,) = motion.push(uniform(first, 100, session))
    assert np.count_nonzero(run.reasons == Reason.SETTLING) == settling()


def test_an_axis_that_is_no_number_splits_the_run() -> None:
    broken = uniform(0, 300)
    broken.values[4, 100:103] = np.nan
    runs = new().push(broken)
    assert [(r.first, len(r)) for r in runs] == [(0, 100), (100, 3), (103, 197)]
    assert np.all(runs[1].reasons == Reason.INVALID)
    assert np.count_nonzero(runs[2].reasons == Reason.SETTLING) == settling()
    assert np.all(np.isfinite(runs[2].values))


def test_settling_covers_the_lateral_delay_too() -> None:
    filters = MotionFilters.of(CALIBRATION, 1e-3, lateral_lag=80e-3)
    assert filters.settling_samples() > 80
