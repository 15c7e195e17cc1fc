"""The offset of two counters from the motion: against the truth, or refused."""

from __future__ import annotations

import numpy as np
import pytest

from omsm_ros.core.correction.counter_offset import counter_offset
from omsm_ros.errors import DataError

N, NOISE = 6000, 10e-9


def steps(seed: int, n: int = N) -> np.ndarray:
    """Z in S-shaped steps of 10 µm at uneven times."""
    random = np.random.default_rng(seed)
    edges = np.cumsum(random.integers(150, 450, 40))
    places = np.searchsorted(edges, np.arange(n + 4000)) % 4 * 10e-6
    window = np.hanning(31)
    return np.convolve(places, window / window.sum(), "same")[2000 : 2000 + n + 1000]


def streams(
    offset: int, seed: int = 0, lag: float = 0.0, gain: float = 0.99
) -> tuple[np.ndarray, np.ndarray]:
    """Z and distance at equal counts, which mean triggers ``offset`` apart."""
    truth = steps(seed)
    at = 500 + np.arange(N)
    z = truth[at]
    sampled = np.interp(at + offset - lag, np.arange(len(truth)), truth)
    noise = np.random.default_rng(seed + 1).normal(0, NOISE, N)
    return z, 50e-6 - gain * sampled + 1e-12 * at + noise


ALL = np.ones(N, np.bool_)


@pytest.mark.parametrize("offset", [-300, -1, 0, 1, 2, 77, 300])
@pytest.mark.parametrize("seed", range(2))
def test_the_offset_is_found(offset: int, seed: int) -> None:
    found = counter_offset(*streams(offset, seed), ALL, most=300)
    assert found.samples == offset
    assert abs(found.fraction) < 0.05
    assert found.uncertainty < 0.15


def test_a_known_lag_is_taken_off_and_dropouts_do_no_harm() -> None:
    ok = np.random.default_rng(4).random(N) > 0.2
    z, d = streams(12, lag=0.34)
    found = counter_offset(z, np.where(ok, d, np.nan), ok, most=50, lag=0.34, lag_uncertainty=0.01)
    assert found.samples == 12
    assert abs(found.fraction) < 3 * found.uncertainty + 0.02


def test_the_fraction_is_as_uncertain_as_it_says() -> None:
    off = []
    for seed in range(12):
        found = counter_offset(*streams(3, seed), ALL, most=20, lag_uncertainty=0.0)
        off.append(found.fraction / found.uncertainty)
    assert 0.3 < np.sqrt(np.mean(np.square(off))) < 2.5


@pytest.mark.parametrize(
    ("z", "distance", "said"),
    [
        (np.zeros(N), streams(0)[1], "several offsets"),
        (np.sin(np.arange(N) / 20) * 1e-5, -np.sin(np.arange(N) / 20) * 1e-5, "several offsets"),
        (steps(0)[:N], np.random.default_rng(0).normal(0, NOISE, N), "several offsets"),
        (steps(0)[:N], -0.3 * steps(0)[:N], "answers to Z with 0.3"),
        (*streams(2, lag=0.5), "no whole number"),
        (steps(0)[:100], steps(0)[:100], "do not determine"),
    ],
    ids=["at rest", "repeats itself", "not a fixed target", "followed", "between", "short"],
)
def test_a_motion_that_does_not_say_is_refused(
    z: np.ndarray, distance: np.ndarray, said: str
) -> None:
    noise = np.random.default_rng(9).normal(0, NOISE, len(z))
    with pytest.raises(DataError, match=said):
        counter_offset(z, distance + noise, np.ones(len(z), np.bool_), most=200)
