"""Test the variance of the rounding error that all readings of a plateau share."""

from dataclasses import replace

import numpy as np
import pytest
from soaked import soaked

from benchmarks.recorded import record_from_arrays
from benchmarks.step_test import StepTest
from omsm_ros.core.estimation.model_order import fit
from omsm_ros.core.estimation.noise import (
    correct_errors_in_variables,
    plateau_variance,
    plateaus,
    reading_step,
)
from omsm_ros.core.estimation.preparation import prepare
from omsm_ros.core.estimation.steps import find_steps
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.lti.frequency_response import response_band
from omsm_ros.core.lti.transfer_function import Structure

PERIOD, STEP_M, LAG_S = 1e-3, 50e-9, 0.34e-3
RNG = np.random.default_rng(5)


@pytest.mark.parametrize(
    ("readings", "expected"),
    [
        (np.round(RNG.normal(0, 40e-9, 3000) / STEP_M) * STEP_M, STEP_M),
        (RNG.normal(0, 40e-9, 3000), 0.0),
        (np.zeros(3000), 0.0),
        # Levels, but of no common step.
        (np.tile([0.0, 1e-9, 1.7e-9, 5.31e-9], 500), 0.0),
    ],
)
def test_the_step_of_readings(readings, expected):
    assert reading_step(readings) == pytest.approx(expected)


@pytest.mark.parametrize("noise", [0.1, 0.2, 0.3])
def test_what_a_plateau_shares_against_many_plateaus(noise):
    """Mean error of rounding, at positions anywhere in a step."""
    plateau = np.repeat(np.arange(3000), 400)
    position = RNG.uniform(-0.5, 0.5, 3000)[plateau]
    readings = np.round(position + RNG.normal(0, noise, len(plateau)))
    mean = np.bincount(plateau, readings - position) / 400
    found = plateau_variance(readings, plateau, 1.0)
    # The scatter of the mean of 400 readings remains too.
    own = (noise**2 + 1 / 12) / 400
    # The tolerance is wider where small noise cannot be separated from rounding.
    assert 0.9 * (np.var(mean) - own) < found < 3 * np.var(mean)


def test_noise_of_a_step_leaves_nothing():
    plateau = np.repeat(np.arange(100), 400)
    readings = np.round(RNG.uniform(-0.5, 0.5, 100)[plateau] + RNG.normal(0, 1, len(plateau)))
    assert plateau_variance(readings, plateau, 1.0) == 0.0
    assert plateau_variance(readings, plateau, 0.0) == 0.0


def recorded(seed):
    """A probe of 50 nm steps and a nanometre of noise, before a machine that lags."""
    test, rng = StepTest(dwell=1.0), np.random.default_rng(seed)
    time = np.arange(0.0, test.duration, PERIOD)
    # No multiple of the probe's step.
    height, start = 0.983 + rng.uniform(0, 0.01), rng.uniform(0, STEP_M)
    z = height * test.positions(time).z + rng.normal(0, 0.3e-9, len(time))
    seen = start + height * test.positions(time - LAG_S).z + rng.normal(0, 1e-9, len(time))
    return record_from_arrays(PERIOD, z, -np.round(seen / STEP_M) * STEP_M)


def test_plateaus_are_counted_between_edges():
    record = recorded(1)
    steps = find_steps(record.z, PERIOD)
    plateau = plateaus(steps, record.ok)
    assert np.max(plateau) == len(steps.edges)
    assert np.all((plateau == -1) == steps.moving)


@pytest.mark.parametrize("seed", [1, *soaked(2, 3)])
def test_coarse_readings_are_accepted_with_a_band_that_holds_the_truth(seed):
    found = identify(recorded(seed)).calibration
    # Rounding is an error periodic in the travel, and may be found as one beside the response.
    assert str(found.certificate.verdict).startswith("accepted")
    lines = np.array([1.0, 5.0, 15.0])
    off = np.abs(np.log(found.dynamics.response(lines)) + 2j * np.pi * lines * LAG_S)
    band = response_band(found.dynamics, found.covariance, lines)
    assert np.all(off < 3 * np.hypot(band.gain, band.phase))
    # The noise of readings that hardly change is that of rounding, not of the rests.
    assert found.certificate.residual.noise_m > 0.5 * STEP_M / np.sqrt(12)


@pytest.mark.parametrize("seed", range(3))
def test_readings_of_an_axis_that_never_change_on_a_plateau_are_not_averaged(seed):
    """Where they do change, at the first counts of an edge, it moves: averaged, by 0.8 counts."""
    test, rng, count = StepTest(), np.random.default_rng(seed), 10e-9
    time = np.arange(0.0, test.duration, PERIOD)
    jitter = rng.normal(0, 0.05 * count, len(time))
    z = np.round((1.0204 * test.positions(time).z + jitter) / count + 0.3) * count
    seen = test.positions(time - LAG_S).z + rng.normal(0, 10e-9, len(time))
    prepared = prepare(record_from_arrays(PERIOD, z, -seen), "encoder")
    problem = replace(prepared.problem, noise=0.05 * count)
    assert problem.input_shared > 0.9 * count**2 / 12
    lag = fit(problem, Structure(1, 0, False), [np.zeros(1)])
    found = correct_errors_in_variables(problem, lag, prepared.steps.edges)
    moved = 0.0 if found is None else np.max(np.abs(found.input - problem.input))
    assert moved < 0.3 * count
