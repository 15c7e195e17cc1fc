"""The vote of the singular values."""

import numpy as np
import pytest
from scipy import signal

from omsm_ros.core.fitting.order_estimate import estimate_order

PERIOD = 1e-3


def simulated(poles, noise, seed=1, samples=4000):
    """A random motion, and the deviation from it of a system with these discrete poles."""
    rng = np.random.default_rng(seed)
    motion = np.cumsum(rng.normal(0, 1e-8, samples))
    denominator = np.real(np.poly(poles))
    numerator = np.array([np.sum(denominator)])
    moved = signal.lfilter(numerator, denominator, motion)
    return motion, moved - motion + rng.normal(0, noise, samples)


@pytest.mark.parametrize(
    "poles",
    [
        [0.6],
        [0.9 * np.exp(0.4j), 0.9 * np.exp(-0.4j)],
        [0.5, 0.95 * np.exp(1j), 0.95 * np.exp(-1j)],
    ],
)
def test_the_order_and_the_poles_of_a_clear_system_are_found(poles):
    motion, deviation = simulated(poles, 1e-11)
    vote = estimate_order(motion, deviation, np.ones(len(motion), bool), PERIOD)
    assert vote.order == len(poles)
    expected = np.log(np.asarray(poles, complex)) / PERIOD
    np.testing.assert_allclose(np.sort_complex(vote.poles), np.sort_complex(expected), rtol=0.02)


@pytest.mark.parametrize("seed", range(5))
def test_noise_alone_has_no_states(seed):
    motion, _ = simulated([0.6], 0.0, seed)
    noise = np.random.default_rng(seed + 100).normal(0, 1e-8, len(motion))
    vote = estimate_order(motion, noise, np.ones(len(motion), bool), PERIOD)
    assert vote.order == 0
    assert 0.4 < vote.singular_values[0] < 1.0


def test_too_few_samples_give_an_empty_vote():
    vote = estimate_order(np.arange(20.0), np.arange(20.0), np.ones(20, bool), PERIOD)
    assert vote.order == 0
    assert len(vote.singular_values) == 0


def test_lost_samples_are_left_out():
    motion, deviation = simulated([0.6], 1e-11)
    used = np.ones(len(motion), bool)
    used[::100] = False
    spoiled = np.where(used, deviation, 1.0)
    assert estimate_order(motion, spoiled, used, PERIOD).order == 1
