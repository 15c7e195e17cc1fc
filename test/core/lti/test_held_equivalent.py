"""G(s) from H(z), against scipy's way from G(s) to H(z)."""

import numpy as np
import pytest
from scipy import signal

from omsm_ros.core.estimation.sampled_fit import zero_order_hold_equivalent
from omsm_ros.core.lti.transfer_function import TransferFunction

PERIOD = 0.05
SYSTEMS = {
    "lag": TransferFunction.from_ascending([2.0], [1.0, 0.3]),
    "mode": TransferFunction.from_ascending([1.0, 0.02], [1.0, 0.05, 0.04]),
    "not low-pass": TransferFunction.from_ascending([0.0, 0.3, 0.1], [1.0, 0.5, 0.06]),
    "three poles": TransferFunction.from_ascending(
        [-3.0, 0.2], np.polynomial.polynomial.polymul([1.0, 0.05, 0.04], [1.0, 0.7])
    ),
}
METHODS = {"zero-order": "zoh", "first-order": "foh"}


def sampled(g, hold):
    """H(z) of G(s) by matrix exponentials, ascending in z⁻¹."""
    up, down, _ = signal.cont2discrete(
        (g.numerator[::-1], g.denominator[::-1]), PERIOD, METHODS[hold]
    )
    up = np.concatenate([np.zeros(len(down) - up.shape[-1]), np.ravel(up)])
    return up, down


@pytest.mark.parametrize("hold", METHODS)
@pytest.mark.parametrize("name", SYSTEMS)
def test_there_and_back(name, hold):
    g = SYSTEMS[name]
    found = zero_order_hold_equivalent(*sampled(g, hold), PERIOD, hold)
    lines = np.array([0.01, 0.1, 1.0, 5.0])
    np.testing.assert_allclose(found.response(lines), g.response(lines), rtol=1e-7)


def test_the_two_holds_differ():
    b, a = sampled(SYSTEMS["mode"], "zero-order")
    lines = np.array([3.0])
    by_hold = [zero_order_hold_equivalent(b, a, PERIOD, hold).response(lines) for hold in METHODS]
    assert abs(by_hold[0] / by_hold[1] - 1)[0] > 0.05


@pytest.mark.parametrize(
    "denominator",
    [[1.0, 0.5], [1.0, -1.0], [1.0, 0.0], [1.0, -1.0, 0.25]],
    ids=["alternating", "integrator", "delay", "double pole"],
)
def test_what_no_continuous_system_makes_has_no_equivalent(denominator):
    b = np.ones(len(denominator))
    assert zero_order_hold_equivalent(b, np.array(denominator), PERIOD, "zero-order") is None


def test_a_gain_is_a_gain():
    found = zero_order_hold_equivalent(np.array([3.0]), np.ones(1), PERIOD, "zero-order")
    assert found.response([1.0]) == pytest.approx(3.0)
