"""Test free runs of a model over another record against the true system, for every hold."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal
from sections_of_polynomials import from_polynomials

from omsm_ros.core.estimation.parallel_sections import BAND_LIMITED
from omsm_ros.core.estimation.sampled_model import SampledModel, free_run, stationary_output
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.errors import IdentificationError

PERIOD = 0.01
TRUTH = TransferFunction.from_ascending([2.0, 0.05], [1.0, 0.05, 0.02])
TIME = PERIOD * np.arange(2000)
NOISE = 1e-3
B, A, _ = signal.cont2discrete((TRUTH.numerator[::-1], TRUTH.denominator[::-1]), PERIOD)
B = np.ravel(B)


def held(delay=0):
    return model(from_polynomials("zero-order", PERIOD, B, A, delay * PERIOD))


def smooth(truth=TRUTH):
    return model(
        from_polynomials(BAND_LIMITED, PERIOD, truth.numerator, truth.denominator, truth.delay)
    )


def model(sections):
    return SampledModel(sections=sections, valid=[(0.01, 10.0)], working_point=(4.0, 30.0))


def moving(lead=5.0):
    """Return a smooth input; the record starts ``lead`` seconds after it was stationary."""
    # At ten times the rate, because the simulation is linear between samples.
    time = PERIOD / 10 * np.arange(10 * (2000 + round(lead / PERIOD)))
    u = 4.0 + np.sin(2 * np.pi * 0.7 * time) * (1 - np.exp(-time))
    _, y, _ = signal.lsim((TRUTH.numerator[::-1], TRUTH.denominator[::-1]), u - 4.0, time)
    return u[::10][-2000:], y[::10][-2000:] + 30.0


def test_a_record_that_begins_in_motion_is_followed_to_the_noise():
    u, y = moving()
    noisy = y + np.random.default_rng(1).normal(0, NOISE, 2000)
    run = free_run(smooth(), u, noisy)
    assert run.rms == pytest.approx(NOISE, rel=0.05)
    assert np.max(np.abs(run.output - y)) < NOISE
    assert run.explained == pytest.approx(1 - NOISE**2 / np.var(noisy), abs=1e-7)


@pytest.mark.parametrize("delay", [0, 3])
def test_a_held_input_with_its_delay(delay):
    rng = np.random.default_rng(2)
    u = 4.0 + np.repeat(rng.choice([-1.0, 1.0], 400), 5)
    late = np.concatenate([np.zeros(delay), u - 4.0])[:2000]
    y = 30.0 + signal.lfilter(B, A, late)
    assert free_run(held(delay), u, y).rms < 1e-9
    assert free_run(held(delay + 1), u, y).rms > 0.02


def test_the_cut_of_a_held_record_does_not_matter():
    """Cut from a longer record: the first samples answer to inputs that the cut has not."""
    rng = np.random.default_rng(3)
    u = 4.0 + np.repeat(rng.choice([-1.0, 1.0], 400), 5)
    y = 30.0 + signal.lfilter(B, A, np.concatenate([np.zeros(7), u - 4.0])[:2000])
    assert free_run(held(7), u[503:], y[503:]).rms < 1e-9


def test_a_wrong_model_does_not_account_for_the_record():
    u, y = moving()
    run = free_run(smooth(TransferFunction.from_ascending([2.0], [1.0, 0.3])), u, y)
    assert run.explained < 0.9
    assert run.rms**2 == pytest.approx((1 - run.explained) * np.var(y))


def test_what_does_not_count_changes_nothing():
    u, y = moving()
    used = np.ones(2000, bool)
    used[300:320] = False
    spoiled = np.where(used, y, 1e6)
    run = free_run(smooth(), u, spoiled, used)
    assert np.all(np.isnan(run.residual[~used]))
    assert run.rms < 1e-3
    assert np.max(np.abs(run.output - y)) < 1e-3
    assert free_run(smooth(), u, np.where(used, y, np.nan)).rms == pytest.approx(run.rms)


def test_the_steady_output_at_the_mean_of_the_input():
    u, y = moving()
    every = np.ones(2000, bool)
    found = stationary_output(held().sections, u[:, None], y, every)
    assert found == pytest.approx(30.0 + 2.0 * (np.mean(u) - 4.0), abs=2e-2)
    step = np.where(np.arange(2000) < 400, 3.0, 5.0)
    y = 30.0 + signal.lfilter(B, A, step - 3.0)
    found = stationary_output(held().sections, step[:, None], y, every)
    assert found == pytest.approx(30.0 + 2.0 * (np.mean(step) - 3.0), abs=1e-6)


def test_a_constant_on_either_column_is_taken_up():
    rng = np.random.default_rng(4)
    u = 4.0 + np.repeat(rng.choice([-1.0, 1.0], 400), 5)
    y = 30.0 + signal.lfilter(B, A, u - 4.0) + rng.normal(0, 0.01, 2000)
    plain = free_run(held(), u, y)
    for run in (free_run(held(), u, y + 7.0), free_run(held(), u - 2.0, y)):
        np.testing.assert_allclose(run.residual, plain.residual, atol=1e-9)
    assert plain.rms == pytest.approx(0.01, rel=0.05)


def test_two_inputs_are_run_together():
    one = from_polynomials("zero-order", 1.0, np.array([0.0, 0.3]), np.array([1.0, -0.7]), 0.0)
    both = replace(
        one,
        numerators=np.concatenate([one.numerators, 2 * one.numerators]),
        direct=np.concatenate([one.direct, 2 * one.direct]),
        delays=np.array([0.0, 2.0]),
    )
    u = np.random.default_rng(5).normal(size=(600, 2))
    y = signal.lfilter([0.0, 0.3], [1.0, -0.7], u[:, 0])
    y += signal.lfilter([0.0, 0.0, 0.0, 0.6], [1.0, -0.7], u[:, 1])
    two = SampledModel(sections=both, valid=[(0.01, 0.4)] * 2, working_point=(0.0, 0.0, 0.0))
    assert free_run(two, u, y).rms < 1e-10
    with pytest.raises(IdentificationError, match="1 inputs are given, the model has 2"):
        free_run(two, u[:, 0], y)


@pytest.mark.parametrize("samples", [0, 49])
def test_too_short_a_record_is_refused(samples):
    with pytest.raises(IdentificationError, match="at least 50"):
        free_run(held(), np.zeros(samples), np.zeros(samples))


def test_the_least_record_is_enough():
    u, y = moving()
    assert free_run(smooth(), u[:50], y[:50]).rms < 1e-3


@pytest.mark.parametrize("still", ["input", "output"])
def test_of_a_record_that_stands_still_nothing_is_accounted_for(still):
    """A constant output is matched to the last digit by any model and the constant fitted to it."""
    columns = {"inputs": np.sin(TIME), "output": np.sin(TIME)}
    columns["inputs" if still == "input" else "output"] = np.ones(len(TIME))
    with pytest.raises(IdentificationError, match=f"the {still} changes by 0 in all"):
        free_run(held(), **columns)
    with pytest.raises(IdentificationError, match="2 values that are not finite"):
        free_run(held(), np.where(np.arange(2000) < 2, np.nan, TIME), np.sin(TIME))
