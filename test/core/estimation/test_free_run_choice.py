"""Test the choice of order of sampled models, on simulated systems and measured records."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import io, signal

from omsm_ros.core.estimation import sampled_choice
from omsm_ros.core.estimation.model_order import MAX_POLES
from omsm_ros.core.estimation.sampled_choice import SampledCandidate, choose_sampled
from omsm_ros.errors import IdentificationError

DATA = Path(__file__).resolve().parents[4] / "shared" / "data" / "daisy"


def held_system(noise=0.0, samples=600, delay=0, seed=1):
    """A second-order system sampled behind a hold, from a state that is not rest."""
    rng = np.random.default_rng(seed)
    a, b, c, _, _ = signal.cont2discrete(
        tuple(np.array(m, float) for m in ([[0, 1], [-30, -1.5]], [[0], [30]], [[1, 0]], [[0]])),
        0.1,
        "zoh",
    )
    u = np.repeat(rng.choice([-1.0, 1.0], samples // 4), 4)
    late = np.concatenate([np.full(delay, u[0]), u])[:samples]
    state, y = np.array([1.0, -2.0]), np.empty(samples)
    for k in range(samples):
        y[k] = (c @ state)[0]
        state = a @ state + b[:, 0] * late[k]
    return u, y + rng.normal(0, noise or 1e-15, samples)


def first_half(samples):
    return np.arange(samples) < samples // 2


def output_of(choice, y, used):
    chosen = choice.chosen
    return chosen.problem.free_run(chosen.fit) + np.mean(y[used])


def test_a_free_run_is_exact_without_noise_whatever_the_initial_state():
    u, y = held_system()
    used = first_half(600)
    found = choose_sampled(u, y, used, 0.1, order=2)
    np.testing.assert_allclose(output_of(found, y, used), y, atol=1e-4)


def test_the_delay_is_found():
    u, y = held_system(noise=0.01, delay=3)
    used = first_half(600)
    found = choose_sampled(u, y, used, 0.1, order=2, max_delay=5)
    assert found.delay in (2, 3, 4)  # a numerator has room for a sample more or less
    assert np.std((output_of(found, y, used) - y)[~used]) < 0.02


def test_the_order_is_chosen_near_the_truth():
    u, y = held_system(noise=0.02)
    used = first_half(600)
    found = choose_sampled(u, y, used, 0.1)
    assert 2 <= found.chosen.order <= 4
    assert found.chosen is found.free
    assert np.std((output_of(found, y, used) - y)[~used]) < 0.03


def test_a_requested_order_is_reported_with_the_free_choice():
    u, y = held_system(noise=0.02)
    found = choose_sampled(u, y, first_half(600), 0.1, order=7)
    assert found.chosen.order == 7
    assert 2 <= found.free.order <= 4


@pytest.mark.soak
def test_twenty_poles_may_be_asked_for():
    rng = np.random.default_rng(4)
    angles = np.linspace(0.2, 2.8, 10)
    poles = np.concatenate([0.97 * np.exp(1j * s * angles) for s in (1, -1)])
    u = rng.normal(size=1600)
    clean = signal.lfilter([0.0, 1.0], np.poly(poles).real, u)
    y = clean + 0.01 * np.std(clean) * rng.normal(size=1600)
    used = first_half(1600)
    found = choose_sampled(u, y, used, 1.0, order=MAX_POLES)
    missed = np.std((output_of(found, y, used) - y)[~used])
    assert missed < 0.015 * np.std(clean)


def integrating_system(samples, noise, seed):
    """Ball on a beam: position from angle through two integrators, held near 0 by a hand.

    Its free run amplifies any error of the initial velocity by the length of the run.
    """
    rng = np.random.default_rng(seed)
    period, position, speed = 0.1, 0.0, 0.0
    u, y = np.empty(samples), np.empty(samples)
    wanted = signal.lfilter([0.02], [1, -0.98], rng.normal(0, 1, samples))
    for k in range(samples):
        y[k] = position
        u[k] = 0.25 * (wanted[k] - position) - 0.35 * speed
        position += period * speed + 0.5 * period**2 * 7 * u[k]
        speed += period * 7 * u[k]
    return u, y + noise * np.std(y) * rng.normal(size=samples)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_an_integrating_plant_does_not_drift_away(seed):
    u, y = integrating_system(600, 0.02, seed)
    used = first_half(600)
    found = choose_sampled(u, y, used, 0.1)
    assert np.var((y - output_of(found, y, used))[~used]) < 0.1 * np.var(y[~used])


@pytest.mark.parametrize(("gain", "order"), [(0.3, 1), (0.7, 2)])
def test_a_pole_more_is_taken_for_half_a_standard_error(gain, order):
    """Errors over seven parts; with a pole more they fall by ``gain`` standard errors."""
    rng = np.random.default_rng(8)
    differs = rng.normal(size=7)
    differs -= np.mean(differs) + gain * np.std(differs, ddof=1) / np.sqrt(7)
    small, large = (
        SampledCandidate(None, None, n, False, 10.0 + more) for n, more in ((1, 0.0), (2, differs))
    )
    small = replace(small, held_out=np.full(7, 10.0))
    assert sampled_choice.simplest_undominated([small, large]).order == order


def test_what_no_model_predicts_is_given_none():
    rng = np.random.default_rng(5)
    u, y = rng.normal(size=400), np.cumsum(rng.normal(size=400))
    assert choose_sampled(u, y, first_half(400), 1.0, max_delay=2).chosen.order == 0


def test_a_gap_is_bridged():
    u, y = held_system(noise=0.02)
    used = (np.arange(600) < 200) | (np.arange(600) >= 300)
    found = choose_sampled(u, np.where(used, y, np.nan), used, 0.1)
    assert np.std((output_of(found, y, used) - y)[~used]) < 0.03


@pytest.mark.parametrize(
    ("samples", "order", "says"),
    [(17, 1, "at least 18 are needed"), (100, 21, "expected 0"), (100, 12, "lower order")],
)
def test_what_cannot_be_is_refused(samples, order, says):
    u, y = held_system(samples=200)
    with pytest.raises(IdentificationError, match=says):
        choose_sampled(u, y, np.arange(200) < samples, 1.0, order=order)


def test_what_is_not_finite_is_refused():
    ones = np.arange(200.0)
    with pytest.raises(IdentificationError, match="finite"):
        choose_sampled(np.where(ones > 5, ones, np.nan), ones, ones >= 0, 1.0)


def test_an_input_that_never_moves_is_refused():
    with pytest.raises(IdentificationError, match="never changes"):
        choose_sampled(np.ones(200), np.arange(200.0), np.ones(200, bool), 1.0)


@pytest.mark.skipif(not DATA.is_dir(), reason=f"measured data are not at {DATA}")
@pytest.mark.parametrize(
    ("name", "bar"),
    # The best of ten subspace methods, each at the order that is best for it here.
    [("robotArm", 99.79), ("hairdryer", 99.29), ("ballbeam", 54.0)],
)
def test_measured_data_are_predicted_over_the_half_not_fitted(name, bar):
    (values,) = (v for k, v in io.loadmat(DATA / f"{name}.mat").items() if not k.startswith("_"))
    u, y = values[:, 0].astype(float), values[:, 1].astype(float)
    used = first_half(len(y))
    found = choose_sampled(u, y, used, 1.0, max_delay=3)
    missed = np.var((y - output_of(found, y, used))[~used]) / np.var(y[~used])
    assert 100 * (1 - missed) > bar
