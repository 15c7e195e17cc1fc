"""The gate before a scan, against closed forms for sines and the paper's path."""

from __future__ import annotations

import numpy as np
import pytest

from omsm_ros.core.correction.predict import FASTEST, dynamic_error, predict_error
from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.dynamics.transfer_function import TransferFunction
from omsm_ros.core.machine.trajectories import Chirp, Spiral
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


def sine(frequency: float, amplitude: float = 0.5e-3) -> np.ndarray:
    return amplitude * np.sin(2 * np.pi * frequency * TIME)


def test_error_of_a_sine_is_its_velocity_times_the_lag() -> None:
    found = predict_error(late_probe(), sine(1.0), PERIOD)
    speed = 2 * np.pi * 0.5e-3
    assert found.peak_to_valley == pytest.approx(2 * speed * LAG, rel=1e-4)
    assert found.rms == pytest.approx(speed * LAG / np.sqrt(2), rel=1e-3)


def test_residual_of_a_sine_is_its_velocity_times_the_lags_uncertainty() -> None:
    found = predict_error(late_probe(lag_uncertainty=2e-6), sine(1.0), PERIOD)
    assert found.residual == pytest.approx(2 * np.pi * 0.5e-3 * 2e-6 / np.sqrt(2), rel=1e-3)


def test_speed_factor_takes_the_residual_to_the_budget() -> None:
    found = predict_error(late_probe(lag_uncertainty=2e-6), sine(1.0), PERIOD, budget=50e-9)
    assert found.speed_factor == pytest.approx(25e-9 / found.residual, rel=1e-3)
    faster = predict_error(
        late_probe(lag_uncertainty=2e-6), sine(found.speed_factor * 0.999), PERIOD, budget=50e-9
    )
    assert faster.safe
    too_fast = predict_error(
        late_probe(lag_uncertainty=2e-6), sine(found.speed_factor * 1.002), PERIOD, budget=50e-9
    )
    assert not too_fast.safe


def test_motion_beyond_the_trusted_band_counts_as_uncorrected() -> None:
    z = sine(1.0) + sine(30.0, amplitude=1e-6)
    found = predict_error(late_probe(1e-9, valid_up_to=20.0), z, PERIOD)
    assert found.residual == pytest.approx(2 * np.pi * 30 * 1e-6 * LAG / np.sqrt(2), rel=1e-3)
    slow, fast = (2 * np.pi * 0.5e-3) ** 2, (2 * np.pi * 30e-6) ** 2
    assert found.outside_band_fraction == pytest.approx(fast / (slow + fast), rel=1e-3)
    within = predict_error(late_probe(1e-9, valid_up_to=40.0), z, PERIOD)
    assert within.outside_band_fraction < 1e-9
    assert within.residual < 0.01 * found.residual


def test_the_papers_scan_is_off_by_1_23_micrometres() -> None:
    spiral = Spiral(PAPER_MIRROR, 12.7e-3, feed_per_turn=0.1e-3, spindle_speed=30.0)
    # The outermost turns, where the motion is largest.
    z = spiral.positions(np.arange(20_000) * PERIOD).z
    found = predict_error(paper(), z, PERIOD)
    assert found.peak_to_valley == pytest.approx(1.23e-6, abs=0.01e-6)


def test_the_papers_chirp_is_off_by_0_262_micrometres() -> None:
    z = Chirp().positions(np.arange(25_000) * PERIOD).z
    error = dynamic_error(PAPER_EQ_12.normalised(), z, PERIOD)
    assert np.sqrt(np.mean(error**2)) == pytest.approx(0.262e-6, abs=0.001e-6)


def test_a_machine_at_rest_is_safe_at_any_speed() -> None:
    found = predict_error(late_probe(), np.full(5000, 1e-3), PERIOD)
    assert found.safe
    assert found.speed_factor == FASTEST
    assert found.outside_band_fraction == 0.0
    assert found.peak_to_valley < 1e-15


def test_a_hopeless_calibration_has_no_safe_speed() -> None:
    found = predict_error(late_probe(lag_uncertainty=1.0), sine(1.0), PERIOD)
    assert not found.safe
    assert found.speed_factor == 0.0
    assert "no speed" in found.message


def test_message_tells_error_residual_and_advice() -> None:
    message = predict_error(late_probe(2e-6), sine(1.0), PERIOD).message
    assert "1885 nm peak to valley" in message
    assert "within 8.9 nm (k = 2)" in message
    assert "up to 5.63 times as fast" in message


@pytest.mark.parametrize("budget", [0.0, -1e-9, np.nan, np.inf])
def test_a_senseless_budget_is_named(budget: float) -> None:
    with pytest.raises(ConfigurationError, match="budget"):
        predict_error(late_probe(), sine(1.0), PERIOD, budget)


def test_a_motion_shorter_than_the_filter_is_refused() -> None:
    slow = TransferFunction(np.ones(1), np.array([1.0, 0.5]))
    with pytest.raises(DataError, match="to settle"):
        dynamic_error(slow, np.zeros(100), PERIOD)
