"""Test the poles proposed by the linear methods against known systems."""

import numpy as np
import pytest
from scipy import signal

from omsm_ros.core.estimation.sampled_fit import DiscreteStarts

POLES = np.array([0.9 * np.exp(0.5j), 0.9 * np.exp(-0.5j)])
A, B = np.poly(POLES).real, np.array([0.0, 1.0, 0.5])
LIGHT = np.concatenate(
    [0.995 * np.exp(1j * np.array(f) * s) for f in ([0.3, 1.1],) for s in (1, -1)]
)


def starts(poles=POLES, noise=0.0, colour=0.0, samples=2000, order=6, lost=()):
    rng = np.random.default_rng(2)
    u = rng.normal(size=samples)
    clean = signal.lfilter(B, np.poly(poles).real, u)
    y = clean + noise * np.std(clean) * signal.lfilter(
        [1.0], [1.0, -colour], rng.normal(size=samples)
    )
    used = np.ones(samples, bool)
    used[list(lost)] = False
    return DiscreteStarts(u, np.where(used, y, np.nan), used, order)


def distance(found, truth=POLES):
    """Return the largest distance of a true pole from the nearest one found."""
    return max(np.min(np.abs(found - p)) for p in truth)


def test_without_noise_every_method_finds_the_poles():
    found = starts().poles(2)
    assert len(found) == 4
    assert max(distance(poles) for poles in found) < 1e-3


def test_lost_samples_touch_no_regressor():
    found = starts(lost=range(500, 520)).poles(2)
    assert min(distance(poles) for poles in found) < 1e-3


def test_noise_biases_arx_and_not_what_iterates():
    every = starts(noise=0.3)
    arx, instruments, iterated, _ = every.poles(2)
    assert distance(arx) > 0.05
    assert distance(instruments) < 0.05
    assert distance(iterated) < 0.02


def test_coloured_noise_too():
    arx, instruments, *_ = starts(noise=0.1, colour=0.95).poles(2)
    assert distance(instruments) < 0.3 * distance(arx)


def test_a_subspace_finds_two_light_modes_at_once():
    *_, subspace = starts(LIGHT, noise=0.05, samples=4000).poles(4)
    assert distance(subspace, LIGHT) < 5e-3


@pytest.mark.parametrize("samples", [40, 80])
def test_a_short_record_has_no_subspace(samples):
    assert len(starts(samples=samples).poles(2)) == 3


def test_conjugates_are_included():
    proposals = starts(noise=0.1).poles(5)
    assert len(proposals) >= 3
    for poles in proposals:
        assert len(poles) == 5
        np.testing.assert_allclose(np.sort_complex(poles), np.sort_complex(poles.conj()), atol=1e-9)
