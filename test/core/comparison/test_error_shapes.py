"""How large is a drift that nobody stated?"""

import numpy as np
import pytest
from soaked import soaked

from omsm_ros.core.comparison.stated_errors import drift, likely_drift

_PLACES, _NOISE = 300, 0.3e-9


def found(size, seed, shapes):
    """Return the drift estimated from one difference with ``shapes`` shapes."""
    rng = np.random.default_rng(seed)
    unit = drift(np.linspace(0, 1, _PLACES), 1.0)[:shapes]
    difference = size * rng.standard_normal(len(unit)) @ unit
    difference += _NOISE * rng.standard_normal(_PLACES)
    none = np.empty((0, _PLACES))
    return likely_drift(difference, none, np.full(_PLACES, _NOISE), unit)


def test_many_shapes_tell_the_size():
    sizes = [found(20e-9, seed, None) for seed in range(40)]
    assert np.median(sizes) == pytest.approx(20e-9, rel=0.15)


@pytest.mark.parametrize("shapes", [2, *soaked(4, None)])
def test_two_of_the_size_hold_what_drifts(shapes):
    """Twice the estimate covers 95 % of drifts of the same size, for any number of shapes."""
    rng = np.random.default_rng(1)
    sizes = np.array([found(20e-9, seed, shapes) for seed in range(300)])
    held = np.abs(20e-9 * rng.standard_normal(300)) < 2 * sizes
    assert 0.92 < np.mean(held) < 0.99
