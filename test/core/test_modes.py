"""Uncertainties of frequency and damping agree with drawing coefficients at random."""

from __future__ import annotations

import numpy as np
import pytest

from omsm_ros.core.calibration import Calibration
from omsm_ros.core.modes import known_modes
from omsm_ros.core.transfer_function import TransferFunction

PAIR_HZ, DAMPING, REAL_HZ = 120.0, 0.2, 900.0


@pytest.fixture
def calibration():
    omega, rate = 2 * np.pi * PAIR_HZ, 2 * np.pi * REAL_HZ
    denominator = np.polynomial.polynomial.polymul(
        [1.0, 2 * DAMPING / omega, 1 / omega**2], [1.0, 1 / rate]
    )
    dynamics = TransferFunction([1.0, 1e-4], denominator)
    # Correlated, as those of a fit are, and small enough to be linear.
    random = np.random.default_rng(3)
    root = 1e-3 * denominator[1:, np.newaxis] * random.normal(size=(3, 3))
    covariance = np.zeros((6, 6))
    covariance[2:5, 2:5] = root @ root.T
    covariance[2:5, 2:5] = 0.5 * (covariance[2:5, 2:5] + covariance[2:5, 2:5].T)
    return Calibration(
        dynamics=dynamics,
        static_gain=1.0,
        sample_period=1e-3,
        valid_up_to=100.0,
        covariance=covariance,
    )


def test_values_are_those_of_the_transfer_function(calibration):
    pair, real = known_modes(calibration)
    assert (pair.frequency, pair.damping) == pytest.approx((PAIR_HZ, DAMPING))
    assert (real.frequency, real.damping) == pytest.approx((REAL_HZ, 1.0))
    modes = calibration.dynamics.modes()
    assert [m.frequency for m in modes] == pytest.approx([pair.frequency, real.frequency])


def test_uncertainties_are_the_scatter_of_drawn_coefficients(calibration):
    random = np.random.default_rng(4)
    block = calibration.covariance[2:5, 2:5]
    drawn = random.multivariate_normal(calibration.dynamics.denominator[1:], block, size=4000)
    modes = [TransferFunction([1.0], np.r_[1.0, row]).modes() for row in drawn]
    pair, real = known_modes(calibration)
    for known, index in ((pair, 0), (real, 1)):
        scatter = np.std([m[index].frequency for m in modes])
        assert known.frequency_uncertainty == pytest.approx(scatter, rel=0.05)
    scatter = np.std([m[0].damping for m in modes])
    assert pair.damping_uncertainty == pytest.approx(scatter, rel=0.05)
    assert real.damping_uncertainty == 0.0


def test_without_poles_there_are_no_modes(true_calibration):
    still = Calibration(
        dynamics=TransferFunction([1.0], [1.0], 1e-4),
        static_gain=1.0,
        sample_period=1e-3,
        valid_up_to=100.0,
        covariance=np.zeros((2, 2)),
    )
    assert known_modes(still) == ()
    exact = known_modes(true_calibration)
    assert len(exact) == len(true_calibration.dynamics.modes())
    assert {mode.frequency_uncertainty for mode in exact} == {0.0}
