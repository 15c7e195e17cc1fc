import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal

from omsm_ros.core.lti.modes import known_modes
from omsm_ros.core.lti.transfer_function import TransferFunction, ascending_roots
from omsm_ros.errors import DataError

TWO_POLES = TransferFunction.from_ascending([2.0], [1.0, 2 * 0.1 / 300, 1 / 300**2])


def test_response_agrees_with_scipy():
    plant = TransferFunction.from_ascending(
        [1.26e12, -3.07e8, 1.29e5], [1.27e12, 1.22e8, 5.17e4, 1]
    )
    frequency = np.geomspace(0.1, 5e3, 200)
    _, expected = signal.freqs(
        plant.numerator[::-1], plant.denominator[::-1], 2 * np.pi * frequency
    )
    np.testing.assert_allclose(plant.response(frequency), expected, rtol=1e-12)


def test_a_delay_turns_the_phase_only():
    late = TransferFunction([1.0], [1.0], delay=2e-3)
    assert late.response(50.0) == pytest.approx(np.exp(-2j * np.pi * 50 * 2e-3))
    assert late.low_frequency_delay == 2e-3


def test_mode_of_a_resonator():
    (mode,) = known_modes(TWO_POLES)
    assert (mode.frequency, mode.damping) == pytest.approx((300 / (2 * np.pi), 0.1))
    assert TWO_POLES.dc_gain == 2.0
    assert TWO_POLES.normalised().dc_gain == 1.0
    assert TWO_POLES.low_frequency_delay == pytest.approx(2 * 0.1 / 300)


@pytest.mark.parametrize("scale", [1.0, -0.7])
def test_the_low_frequency_delay_is_the_slope_of_the_phase(scale):
    """With a zero, a pole and a delay, whatever the gain."""
    g = TransferFunction([scale, -2e-3 * scale], [1.0, 5e-3, 1e-6], 1e-3)
    frequency, gain = 1e-4, g.response([1e-4])[0] / g.dc_gain
    slope = -np.angle(gain) / (2 * np.pi * frequency)
    assert g.low_frequency_delay == pytest.approx(slope, rel=1e-6)
    assert g.low_frequency_delay == pytest.approx(8e-3)


def test_a_pole_on_or_beyond_the_border_is_not_stable():
    assert not TransferFunction([1.0], [1.0, -2.0]).is_stable  # at 0.5 rad/s
    resonator = TransferFunction.from_ascending([1.0], [1.0, 0.0, 1e-4])
    assert not resonator.is_stable


def test_stability_is_that_of_the_poles():
    assert TWO_POLES.is_stable
    assert not TransferFunction([1.0], [1.0, -0.1]).is_stable
    assert TransferFunction([1.0], [1.0]).is_stable


roots = st.lists(
    st.floats(10.0, 1e5), min_size=1, max_size=5, unique_by=lambda r: round(np.log(r), 1)
)


@given(roots)
def test_roots_of_badly_scaled_polynomials(magnitudes):
    expected = -np.sort(magnitudes)
    coefficients = np.polynomial.polynomial.polyfromroots(expected)
    found = np.sort(ascending_roots(coefficients / coefficients[0]).real)[::-1]
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_a_root_at_zero_is_found():
    found = ascending_roots(np.array([0.0, 1.0, 1e-4]))
    np.testing.assert_allclose(np.sort(found.real), [-1e4, 0.0], atol=1e-9)


@pytest.mark.parametrize(
    ("numerator", "denominator", "delay", "named"),
    [
        ([1.0, np.nan], [1.0, 1.0], 0.0, "numerator"),
        ([1.0], [[1.0]], 0.0, "denominator"),
        ([1.0], [2.0, 1.0], 0.0, r"denominator\[0\]"),
        ([1.0, 1.0], [1.0], 0.0, "improper"),
        ([1.0], [1.0, 1e-3, 0.0], 0.0, "last coefficient"),
        ([1.0], [1.0], -1e-3, "delay"),
        ([1.0], [1.0], np.inf, "delay"),
        ([], [1.0], 0.0, "numerator"),
    ],
)
def test_nonsense_is_refused_by_name(numerator, denominator, delay, named):
    with pytest.raises(DataError, match=named):
        TransferFunction(numerator, denominator, delay)


def test_zero_static_gain_cannot_be_normalised():
    with pytest.raises(DataError, match="normalised"):
        TransferFunction([0.0, 1.0], [1.0, 1.0]).normalised()


def test_coefficients_cannot_be_changed_afterwards():
    with pytest.raises(ValueError, match="read-only"):
        TWO_POLES.numerator[0] = 3.0
