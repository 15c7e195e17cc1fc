"""The gate before a scan, against closed forms for sines and the paper's path."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from linear_segments import through
from scipy import interpolate
from soaked import soaked

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.correction.predict import (
    Prediction,
    dynamic_error,
    largest_residual,
    predict_error,
)
from omsm_ros.core.kinematics.limits import FASTEST, MachineLimits
from omsm_ros.core.kinematics.scan_path import ScanPath
from omsm_ros.core.kinematics.trajectories import Chirp, Spiral
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.errors import ConfigurationError, DataError
from omsm_ros.twin.plant import PAPER_EQ_12

PERIOD = 1e-3
TIME = np.arange(40_000) * PERIOD
LAG = 0.3e-3


def late_probe(lag_uncertainty: float = 1e-6, valid_up_to: float = 100.0) -> Calibration:
    """A probe that is late and nothing else."""
    covariance = np.zeros((3, 3))
    covariance[2, 2] = lag_uncertainty**2
    return Calibration(
        dynamics=TransferFunction(np.ones(1), np.array([1.0, 1e-6]), LAG - 1e-6),
        static_gain=1.0,
        sample_period=PERIOD,
        valid_up_to=valid_up_to,
        covariance=covariance,
    )


def paper() -> Calibration:
    g = PAPER_EQ_12.normalised()
    p = len(g.numerator) + len(g.denominator)
    return Calibration(
        dynamics=g,
        static_gain=1.0,
        sample_period=PERIOD,
        valid_up_to=100.0,
        covariance=np.zeros((p, p)),
    )


UNLIMITED = MachineLimits(
    servo_frequency=None, probe_range=None, spindle_speed_rpm=None, motion_frequency=None
)


def predicted(calibration: Calibration, z: np.ndarray, budget: float = 50e-9) -> Prediction:
    """Return the prediction without limits of the machine."""
    return predict_error(calibration, ScanPath(z=z, sample_period=PERIOD), budget, UNLIMITED)


def sine(frequency: float, amplitude: float = 0.5e-3) -> np.ndarray:
    return amplitude * np.sin(2 * np.pi * frequency * TIME)


def test_error_of_a_sine_is_its_velocity_times_the_lag() -> None:
    found = predicted(late_probe(), sine(1.0))
    speed = 2 * np.pi * 0.5e-3
    assert found.peak_to_valley == pytest.approx(2 * speed * LAG, rel=1e-4)
    assert found.rms == pytest.approx(speed * LAG / np.sqrt(2), rel=1e-3)


def test_residual_of_a_sine_is_its_velocity_times_the_lags_uncertainty() -> None:
    found = predicted(late_probe(lag_uncertainty=2e-6), sine(1.0))
    # The bound is that of the fastest place, not the mean over the path.
    assert found.residual == pytest.approx(2 * np.pi * 0.5e-3 * 2e-6, rel=1e-3)


def test_speed_factor_takes_the_residual_to_the_budget() -> None:
    found = predicted(late_probe(lag_uncertainty=2e-6), sine(1.0), budget=50e-9)
    assert found.speed_factor == pytest.approx(25e-9 / found.residual, rel=1e-3)
    faster = predicted(late_probe(lag_uncertainty=2e-6), sine(found.speed_factor * 0.999))
    assert faster.safe
    too_fast = predicted(late_probe(lag_uncertainty=2e-6), sine(found.speed_factor * 1.002))
    assert not too_fast.safe


def test_motion_beyond_the_trusted_band_counts_as_uncorrected() -> None:
    z = sine(1.0) + sine(30.0, amplitude=1e-6)
    found = predicted(late_probe(1e-9, valid_up_to=20.0), z)
    lost = abs(1 - late_probe().dynamics.response([30.0])[0])
    assert found.residual == pytest.approx(1e-6 * lost / np.sqrt(2), rel=0.01)
    slow, fast = (2 * np.pi * 0.5e-3) ** 2, (2 * np.pi * 30e-6) ** 2
    assert found.outside_band_fraction == pytest.approx(fast / (slow + fast), rel=1e-3)
    within = predicted(late_probe(1e-9, valid_up_to=40.0), z)
    assert within.outside_band_fraction < 1e-9
    assert within.residual < 0.02 * found.residual


def test_the_papers_scan_is_off_by_1_23_micrometres() -> None:
    spiral = Spiral(PAPER_MIRROR, 12.7e-3, feed_per_turn=0.1e-3, spindle_speed=30.0)
    # The outermost turns, where the motion is largest.
    z = spiral.positions(np.arange(20_000) * PERIOD).z
    found = predicted(paper(), z)
    assert found.peak_to_valley == pytest.approx(1.23e-6, abs=0.01e-6)


def test_the_papers_chirp_is_off_by_0_262_micrometres() -> None:
    z = Chirp().positions(np.arange(25_000) * PERIOD).z
    error = dynamic_error(PAPER_EQ_12.normalised(), z, PERIOD)
    assert np.sqrt(np.mean(error**2)) == pytest.approx(0.262e-6, abs=0.001e-6)


def test_a_machine_at_rest_is_safe_at_any_speed() -> None:
    found = predicted(late_probe(), np.full(5000, 1e-3))
    assert found.safe
    assert found.speed_factor == FASTEST
    assert found.outside_band_fraction == 0.0
    assert found.peak_to_valley < 1e-15


def test_a_hopeless_calibration_has_no_safe_speed() -> None:
    found = predicted(late_probe(lag_uncertainty=1.0), sine(1.0))
    assert not found.safe
    assert found.speed_factor == 0.0
    assert "no speed" in found.message


def test_message_tells_error_residual_and_advice() -> None:
    message = predicted(late_probe(2e-6), sine(1.0)).message
    assert "1.88 µm peak to valley" in message
    assert "after correction 12.6 nm (k = 2, largest on the path), within the budget" in message
    assert "maximum speed: 3.97 × this motion, limited by dynamics" in message


@pytest.mark.parametrize("budget", [0.0, -1e-9, np.nan, np.inf])
def test_a_senseless_budget_is_named(budget: float) -> None:
    with pytest.raises(ConfigurationError, match="budget"):
        predicted(late_probe(), sine(1.0), budget)


def test_a_motion_shorter_than_the_filter_is_refused() -> None:
    slow = TransferFunction(np.ones(1), np.array([1.0, 0.5]))
    with pytest.raises(DataError, match="to settle"):
        dynamic_error(slow, np.zeros(100), PERIOD)


def turn(seconds: float) -> np.ndarray:
    return np.arange(round(seconds / PERIOD)) * PERIOD


def raster() -> np.ndarray:
    """To and fro over a slope, with smooth turns."""
    return 0.2e-3 * np.arcsin(0.98 * np.sin(2 * np.pi * 0.7 * turn(20.0)))


def constant_surface_speed() -> np.ndarray:
    """A saddle whose turns take less time the nearer they are to the centre."""
    radius = np.sqrt(np.maximum(1 - turn(60.0) / 61.0, 0.02))
    angle = np.cumsum(2 * np.pi * 0.5 / radius) * PERIOD
    return 0.3e-3 * radius**2 * np.cos(2 * angle)


def spiral() -> np.ndarray:
    path = Spiral(PAPER_MIRROR, 12.7e-3, feed_per_turn=1e-3, spindle_speed=30.0)
    return path.positions(turn(25.0)).z


@pytest.mark.parametrize("path", [spiral, *soaked(raster, constant_surface_speed)])
def test_error_of_a_path_is_that_of_an_independent_simulation(path) -> None:
    """(1 - G) z by scipy's solver of the differential equation, the input piecewise cubic."""
    z = path()
    g = paper().dynamics
    fine = 8
    time = np.arange((len(z) - 1) * fine + 1) * PERIOD / fine
    dense = interpolate.CubicSpline(np.arange(len(z)) * PERIOD, z)(time)
    late = through(g.numerator[::-1], g.denominator[::-1], dense, PERIOD / fine)[::fine] + dense[0]
    found = predict_error(paper(), ScanPath(z=z, sample_period=PERIOD))
    settled = slice(200, None)
    assert found.peak_to_valley == pytest.approx(np.ptp((z - late)[settled]), rel=0.02)
    assert found.rms == pytest.approx(np.std((z - late)[settled]), rel=0.02)


@pytest.mark.parametrize("path", [spiral, raster, constant_surface_speed])
def test_residual_is_the_error_of_a_wrong_calibration(path) -> None:
    """One standard deviation too late, the correction is off by what was foretold."""
    z, off = path(), 2e-6
    calibration = late_probe(lag_uncertainty=off)
    wrong = replace(calibration.dynamics, delay=calibration.dynamics.delay + off)
    difference = dynamic_error(wrong, z, PERIOD) - dynamic_error(calibration.dynamics, z, PERIOD)
    stated = largest_residual(calibration, PERIOD, z)
    assert stated == pytest.approx(np.max(np.abs(difference)), rel=0.02)


@pytest.mark.parametrize("path", [spiral, raster, constant_surface_speed])
def test_a_speed_called_safe_stays_within_the_budget(path) -> None:
    """The same path, sampled in less time, keeps its budget, and little faster breaks it."""
    calibration, z = late_probe(lag_uncertainty=1e-6), path()
    factor = predicted(calibration, z).speed_factor
    assert 1 < factor < FASTEST
    for speed, safe in ((0.98 * factor, True), (1.05 * factor, False)):
        assert (largest_residual(calibration, PERIOD / speed, z) < 25e-9) == safe


def test_the_limit_that_binds_is_the_headline() -> None:
    slow_servo = MachineLimits(servo_frequency=50.0, motion_frequency=None)
    z = spiral()
    found = predict_error(late_probe(1e-9), ScanPath(z=z, sample_period=PERIOD), limits=slow_servo)
    assert found.binding == "probe range against following error"
    assert f"limited by {found.binding}" in found.message
    assert found.speed_factor == min(limit.speed_factor for limit in found.limits)
    assert "spindle speed" in found.not_evaluated
    assert "Z jerk" in found.not_evaluated
