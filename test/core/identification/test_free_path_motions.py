"""Motions that never rest identify too, and are trusted no further than they go."""

import numpy as np
import pytest
from soaked import soaked

from benchmarks.free_path import Multisine
from benchmarks.recorded import record_from_arrays
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.kinematics.trajectories import Chirp
from omsm_ros.core.lti.frequency_response import response_band
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.streams.motion_record import assemble
from omsm_ros.core.surface.nominal import Flat
from omsm_ros.errors import IdentificationError, StepTestError
from omsm_ros.twin.cell import Cell, record
from omsm_ros.twin.plant import PAPER_STATIC_GAIN, Plant

OMEGA = 2 * np.pi * 60
LIGHT_MODE = Plant(TransferFunction.from_ascending([1.0], [1.0, 0.04 / OMEGA, OMEGA**-2]))
# Starts and ends in full swing.
FROM_THE_MIDDLE = slice(7321, 21_117)
WHOLE = slice(None)


def identified(motion, plant, part, seed):
    made = record(Cell(plant=plant, seed=seed), motion, Flat())
    whole = assemble([made.axes], [made.distance])
    return identify(
        record_from_arrays(whole.sample_period, whole.z[part], whole.distance[part])
    ).calibration


@pytest.mark.soak
@pytest.mark.parametrize(
    ("motion", "plant", "part", "reaches"),
    [
        (Chirp(), Plant(), WHOLE, 15.0),
        (Chirp(), LIGHT_MODE, WHOLE, 15.0),
        (Chirp(), LIGHT_MODE, FROM_THE_MIDDLE, 12.7),
        (Chirp(end_frequency=50.0, peak_to_peak=20e-6), LIGHT_MODE, FROM_THE_MIDDLE, 42.0),
        (Multisine(), Plant(), WHOLE, 14.9),
        (Multisine(), LIGHT_MODE, WHOLE, 14.9),
    ],
)
@pytest.mark.parametrize("seed", [3, 4])
def test_the_truth_lies_in_the_band_as_far_as_the_motion_goes(motion, plant, part, reaches, seed):
    calibration = identified(motion, plant, part, seed)
    assert calibration.valid_up_to < 1.3 * reaches
    if calibration.certificate.verdict == "rejected":
        # A motion cut out of full swing, or without a slow part, does not tell creep from gain.
        assert "drift or creep" in str(calibration.certificate.reasons[0])
        assert part == FROM_THE_MIDDLE or isinstance(motion, Multisine)
    elif isinstance(motion, Chirp):
        assert calibration.valid_up_to > 0.9 * reaches
    frequency = np.geomspace(0.5, reaches, 20)
    found, truth = (g.response(frequency) for g in (calibration.dynamics, plant.dynamics))
    error = np.log(found / truth)
    # The narrower band is the scatter of repeated tests, without undetected model errors.
    band = response_band(calibration.dynamics, calibration.noise_covariance, frequency)
    assert np.max(np.abs(error.real) / band.gain) < 3.5
    assert np.max(np.abs(error.imag) / band.phase) < 3.5


@pytest.mark.parametrize(("frequency", "plant"), [(5.0, Plant()), *soaked((5.0, LIGHT_MODE))])
@pytest.mark.parametrize(
    "seed", [1, pytest.param(2, marks=pytest.mark.soak), pytest.param(3, marks=pytest.mark.soak)]
)
def test_one_frequency_does_not_tell_gain_from_dynamics(frequency, plant, seed):
    """Gain and phase at one frequency are two numbers; static gain, lag and curvature are three."""
    sine = Multisine(frequencies=(frequency,), amplitude=20e-6)
    certificate = identified(sine, plant, WHOLE, seed).certificate
    assert certificate.verdict == "rejected"
    assert "does not separate the static gain from the dynamics" in str(certificate.reasons[0])


@pytest.mark.soak
def test_a_second_frequency_tells_them_apart():
    sines = Multisine(frequencies=(2.0, 9.0), amplitude=15e-6)
    calibration = identified(sines, LIGHT_MODE, WHOLE, 1)
    # In 20 s without a stationary segment, drift and creep may still be part of the gain.
    assert all("drift or creep" in reason for reason in first_reasons(calibration))
    assert calibration.static_gain == pytest.approx(PAPER_STATIC_GAIN, abs=1e-4)


@pytest.mark.parametrize("seed", [0, *soaked(*range(1, 6))])
def test_an_even_ramp_may_be_drift(seed):
    rng = np.random.default_rng(seed)
    z = rng.normal(2e-9 * np.arange(20_000), 4e-10)
    ramp = record_from_arrays(1e-3, z, rng.normal(-z, 1e-8))
    assert any(
        reason in refusal(ramp) for reason in ("moves in both directions", "static gain from the")
    )


@pytest.mark.parametrize("lost", [slice(35, 85), slice(0)])
def test_too_little_left_between_the_ends_is_said(lost):
    z = 20e-6 * np.sin(2 * np.pi * 15e-3 * np.arange(120 if lost.start else 60))
    distance = np.random.default_rng(0).normal(-z, 1e-8)
    distance[lost] = np.nan
    with pytest.raises(StepTestError, match="can be compared"):
        identify(record_from_arrays(1e-3, z, distance))


def first_reasons(calibration):
    """The first reason against it, if there is any."""
    return [str(reason) for reason in calibration.certificate.reasons[:1]]


def refusal(record):
    """Why nothing was identified."""
    try:
        certificate = identify(record).calibration.certificate
    except IdentificationError as error:
        return str(error)
    return str(certificate.reasons[0])


def test_what_the_motion_cannot_show_at_all_is_unknown_and_the_calibration_can_be_written():
    """A relaxation of a minute is taken for drift in half a sweep."""
    made = identified(Chirp(), Plant(), slice(12_500, None), 3)
    assert made.certificate.verdict == "rejected"
    assert made.certificate.undetected.terms[0].missed is None
    assert len(made.id) == 64  # of its content as strict JSON
