"""Parts of a step test that contradict each other, made to do so by known amounts."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.recorded import record_from_arrays
from omsm_ros.core.calibration.certificate import RESERVATION
from omsm_ros.core.estimation.model_order import fit
from omsm_ros.core.estimation.model_structure import ScaledStructure
from omsm_ros.core.estimation.preparation import prepare
from omsm_ros.core.identification.checks import consistency
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.identification.response_uncertainty import contrast_covariance
from omsm_ros.core.kinematics.trajectories import StepPlan
from omsm_ros.core.lti.frequency_response import low_frequency_delay_uncertainty
from omsm_ros.core.lti.transfer_function import Structure
from omsm_ros.core.model_errors.residual_diagnostics import (
    HALVES,
    SIZES,
    UP_DOWN,
    ResidualDiagnostics,
    contrasts,
    differ,
)

PERIOD, LAG, NOISE = 1e-3, 0.7e-3, 5e-9
SMALL, LARGE = 3e-6, 9.8e-6
HEIGHTS = (LARGE, SMALL, -LARGE, LARGE, -SMALL, -LARGE, LARGE, SMALL, -SMALL, -LARGE)
RISE, DWELL = 20e-3, 0.4
EVERY = {UP_DOWN, HALVES, SIZES}


def stepped(lags, gains=None, heights=HEIGHTS, seed=1):
    """A test whose edges answer ``lags`` (k,) [s] late and ``gains`` (k,) high."""
    starts = tuple(DWELL * (k + 1) for k in range(len(heights)))
    duration = DWELL * (len(heights) + 1)
    time = np.arange(round(duration / PERIOD)) * PERIOD
    z = StepPlan(starts, heights, RISE, duration).z(time)
    gains = np.ones(len(heights)) if gains is None else gains
    late = tuple(np.add(starts, lags))
    seen = StepPlan(late, tuple(np.multiply(heights, gains)), RISE, duration).z(time)
    random = np.random.default_rng(seed)
    z = z + random.normal(0, 0.3e-9, len(z))
    return record_from_arrays(PERIOD, z, -seen + random.normal(0, NOISE, len(z)))


def survey_of(record):
    prepared = prepare(record, "encoder")
    late = fit(prepared.problem, Structure(0, 0, True), [np.array([0.1])])
    return ResidualDiagnostics(prepared.problem, late, prepared.steps)


def found(record):
    return {contrast.parts: contrast for contrast in contrasts(survey_of(record))}


def alike(lag=LAG):
    return np.full(len(HEIGHTS), lag)


def test_parts_that_agree_differ_by_chance_only():
    values = [c.p for seed in range(12) for c in found(stepped(alike(), seed=seed)).values()]
    assert len(values) == 36
    assert min(values) > 1e-4
    assert np.mean(np.array(values) < 0.5) == pytest.approx(0.5, abs=0.25)


FIRST = {
    UP_DOWN: np.array(HEIGHTS) > 0,
    SIZES: np.abs(HEIGHTS) < 5e-6,
    HALVES: np.arange(len(HEIGHTS)) < len(HEIGHTS) / 2,
}


@pytest.mark.parametrize("parts", sorted(EVERY))
def test_a_lag_that_differs_is_found_by_its_size_and_name(parts):
    apart = 20e-6
    contrast = found(stepped(LAG + np.where(FIRST[parts], apart, 0.0)))[parts]
    assert differ(contrast)
    assert contrast.lag_difference_s == pytest.approx(
        apart, abs=3 * contrast.lag_difference_uncertainty_s
    )
    assert contrast.lag_difference_uncertainty_s < 0.2 * apart


def test_a_gain_that_grows_with_the_step_is_found():
    gains = 1 + 2e-3 * FIRST[SIZES]
    contrast = found(stepped(alike(), gains))[SIZES]
    assert differ(contrast)
    assert contrast.gain_difference == pytest.approx(
        2e-3, abs=3 * contrast.gain_difference_uncertainty
    )


@pytest.mark.parametrize(
    ("heights", "parts"),
    [
        ((LARGE,) * 4, set()),
        ((LARGE, LARGE, -LARGE, -LARGE), {UP_DOWN}),
        ((LARGE, -LARGE), set()),
        ((LARGE, -LARGE, SMALL, -SMALL), EVERY),
    ],
)
def test_only_parts_that_the_test_has_are_compared(heights, parts):
    """Steps all up and then all down have one contrast, not two; few steps have none."""
    record = stepped(np.full(len(heights), LAG), heights=heights)
    named = set(found(record))
    assert named == parts if len(set(heights)) > 1 else named <= {HALVES}


def test_the_band_holds_the_difference():
    diagnostics = survey_of(stepped(LAG + np.where(FIRST[SIZES], 20e-6, 0.0)))
    compared, dynamics = contrasts(diagnostics), diagnostics.fitted.dynamics
    covariance = contrast_covariance(compared, dynamics)
    assert low_frequency_delay_uncertainty(dynamics, covariance) >= 19e-6
    (said,) = consistency(SimpleNamespace(contrasts=compared))
    assert said.severity == RESERVATION
    assert "small steps and large differ by" in str(said)
    assert "by chance" in str(said)


def test_a_clean_test_is_neither_widened_nor_reserved():
    diagnostics = survey_of(stepped(alike()))
    compared = contrasts(diagnostics)
    assert {contrast.parts for contrast in compared} == EVERY
    assert not np.any(contrast_covariance(compared, diagnostics.fitted.dynamics))
    assert not list(consistency(SimpleNamespace(contrasts=compared)))


def test_the_certificate_states_every_comparison():
    certificate = identify(stepped(alike())).calibration.certificate
    assert {entry.parts for entry in certificate.consistency} == EVERY
    assert certificate.limits["consistency_p_least"] == 1e-4


def test_what_rang_before_the_record_is_no_part_of_the_answer_to_the_motion():
    """Decays that are over when the comparison begins may have any size before."""
    diagnostics = survey_of(stepped(alike()))
    problem = replace(diagnostics.problem, fits_initial_condition=True)
    structure = Structure(2, 1, False)
    start = ScaledStructure(structure, problem.rate).nonlinear_of(
        np.array([-20.0 + 0j, -30.0]), 0.0
    )
    fitted = fit(problem, structure, [start])
    ringing = np.concatenate([fitted.driven[:2], 1e6 * np.ones(2)])
    huge = ResidualDiagnostics(problem, replace(fitted, driven=ringing), diagnostics.steps)
    quiet = ResidualDiagnostics(problem, fitted, diagnostics.steps)
    (expected, columns) = (
        family.part(0, len(family.parameters))
        for family in (quiet.model_errors.creep(), huge.model_errors.creep())
    )
    assert columns == pytest.approx(expected, rel=1e-9, abs=1e-15)
