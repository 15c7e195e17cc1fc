"""A gain that is open above a hundredth of a hertz costs its share of the travel, not more."""

from dataclasses import replace

import numpy as np
import pytest
from certified import certified_by

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
from omsm_ros.core.correction.predict import predict_error, residual_variances
from omsm_ros.core.correction.uncertainty import ErrorSources
from omsm_ros.core.kinematics.limits import MachineLimits
from omsm_ros.core.kinematics.scan_path import ScanPath
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.streams.blocks import AxisBlock, DistanceBlock
from omsm_ros.messages import sentence

PERIOD, OPEN, VALID_FROM = 1e-3, 1e-4, 0.015
AMPLITUDE = 0.5e-3
TIME = np.arange(120_000) * PERIOD
# The lag is mechanical: no term of its own here.
OPTIONS = CorrectionOptions(probe_latency=0.0, sources=ErrorSources())


LAG_NOISE = 1e-6


def with_noise(scale: float = 1.0) -> Calibration:
    """The gain may be undetected, and the lag is known to a microsecond."""
    noise = np.diag([0.0, 0.0, LAG_NOISE**2])
    known = calibration()
    certificate = {
        "noise_covariance": (scale * noise).ravel().tolist(),
        "could_hide": [
            {
                "family": "creep",
                "parameter": 10.5,
                "size": 0.0,
                "uncertainty": 0.0,
                "carried": 0.0,
                "effect_on_scan_m": 1e-9,
            }
        ],
        "plateau_s": 0.5,
    }
    return replace(
        known,
        covariance=known.covariance + noise,
        certificate=certified_by({**certificate}, known.certificate),
    )


def corrected(known: Calibration, z: np.ndarray) -> Corrector:
    """In blocks, for a queue of minutes is not kept."""
    corrector = Corrector(known, OPTIONS)
    for first in range(0, len(z), 5000):
        part = z[first : first + 5000]
        zero = np.zeros(len(part))
        place = {"stamp_ns": first * 10**6, "first_sample": first, "sample_period": PERIOD}
        corrector.push_axes(AxisBlock(**place, x=zero, y=zero, z=part, b=zero, c=zero))
        corrector.push_distance(DistanceBlock(**place, distance=-part))
        corrector.take()
    corrector.finish()
    return corrector


def test_noise_and_undetected_error_are_two_terms_of_the_budget():
    z = AMPLITUDE * np.sin(2 * np.pi * 1.0 * TIME)
    budget = corrected(with_noise(), z).budget
    assert budget["dynamics"] == pytest.approx(
        LAG_NOISE * 2 * np.pi * AMPLITUDE / np.sqrt(2), rel=0.02
    )
    assert budget["undetected_model_error"] == pytest.approx(
        OPEN * AMPLITUDE / np.sqrt(2), rel=0.03
    )
    total = corrected(
        replace(with_noise(), certificate=certified_by({"valid_from": VALID_FROM})), z
    ).budget
    assert total["undetected_model_error"] == 0.0
    assert total["dynamics"] == pytest.approx(
        np.hypot(budget["dynamics"], budget["undetected_model_error"]), rel=0.02
    )


def test_noise_that_exceeds_the_covariance_divides_nothing():
    """A certificate whose parts contradict the whole is not believed."""
    known = with_noise(scale=4.0)
    assert not np.any(known.undetected_error_covariance)
    assert np.any(with_noise().undetected_error_covariance)


def test_the_prediction_states_the_undetected_error_and_the_dwell_that_would_reveal_it():
    z = AMPLITUDE * np.sin(2 * np.pi * 1.0 * TIME)
    unlimited = MachineLimits(
        servo_frequency=None, probe_range=None, spindle_speed_rpm=None, motion_frequency=None
    )
    path = ScanPath(z=z, sample_period=PERIOD)
    found = predict_error(with_noise(), path, 50e-9, unlimited)
    assert found.residual_undetected == pytest.approx(OPEN * AMPLITUDE, rel=0.05)
    assert found.residual == pytest.approx(found.residual_undetected, rel=0.01)
    assert "cannot detect, mostly slow relaxation (creep) of 10.5 s" in found.message
    # 100 nm against 50 nm: four times as long.
    assert "dwells of 2.1 s or more (omsm plan steps --dwell 2.1)" in found.message


def calibration() -> Calibration:
    covariance = np.zeros((3, 3))
    covariance[0, 0] = OPEN**2
    return Calibration(
        dynamics=TransferFunction(np.ones(1), np.array([1.0, 3e-4])),
        static_gain=1.0,
        sample_period=PERIOD,
        valid_up_to=60.0,
        covariance=covariance,
        certificate=certified_by({"verdict": "accepted", "valid_from": VALID_FROM}),
    )


@pytest.mark.parametrize("phase", [0.0, 1.0, 2.5, 4.0])
def test_uncertainty_of_a_sine_is_the_open_share_of_its_swing(phase):
    """For any speed and curvature at the first sample."""
    z = AMPLITUDE * np.sin(2 * np.pi * 1.0 * TIME + phase)
    # In blocks, for a queue of minutes is not kept.
    corrector, found = Corrector(calibration(), OPTIONS), []
    for first in range(0, len(z), 5000):
        part = z[first : first + 5000]
        zero = np.zeros(len(part))
        place = {"stamp_ns": first * 10**6, "first_sample": first, "sample_period": PERIOD}
        corrector.push_axes(AxisBlock(**place, x=zero, y=zero, z=part, b=zero, c=zero))
        corrector.push_distance(DistanceBlock(**place, distance=-part))
        found.append(corrector.take())
    found.append(corrector.finish())
    uncertainty = np.concatenate([points.uncertainty for points in found if points is not None])
    # The swing about its mean, once the start is forgotten.
    assert np.max(uncertainty[-10_000:]) == pytest.approx(OPEN * AMPLITUDE, rel=0.02)
    # Before that the mean is not known; the travel since the first sample is its bound.
    assert np.max(uncertainty) <= OPEN * 2 * AMPLITUDE * 1.01


def test_the_prediction_says_the_same():
    z = AMPLITUDE * np.sin(2 * np.pi * 1.0 * TIME)
    residual = np.sqrt(np.sum(residual_variances(calibration(), PERIOD, z), axis=0))
    assert np.max(residual[-10_000:]) == pytest.approx(OPEN * AMPLITUDE, rel=0.02)


def test_a_dwell_of_minutes_is_one_that_the_command_takes():
    text = sentence("correction.dwell", {"dwell": 130.0})
    assert text == "calibrate with dwells of 130 s or more (omsm plan steps --dwell 130)"
