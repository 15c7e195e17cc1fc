"""Roots in second-order sections against scipy's own, and against the product of the roots."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

from omsm_ros.core.lti.discretisation import bilinear, second_order_sections
from omsm_ros.core.lti.transfer_function import TransferFunction

BACKWARD = np.exp(-1j * np.array([0.01, 0.3, 1.1, 2.0, 3.1]))


def product(roots: np.ndarray) -> np.ndarray:
    return np.prod(1 - np.multiply.outer(BACKWARD, np.asarray(roots)), axis=1)


def response(sections: np.ndarray) -> np.ndarray:
    value = np.ones(len(BACKWARD), complex)
    for section in sections:
        value *= np.polynomial.polynomial.polyval(BACKWARD, section[:3])
        value /= np.polynomial.polynomial.polyval(BACKWARD, section[3:])
    return value


def roots(largest: float, most: int) -> st.SearchStrategy[np.ndarray]:
    pair = st.builds(
        lambda r, a: [r * np.exp(1j * a), r * np.exp(-1j * a)],
        st.floats(0.1, largest),
        st.floats(0.1, 3.0),
    )
    single = st.floats(-largest, largest).map(lambda r: [complex(r)])
    return st.lists(pair | single, max_size=most).map(
        lambda parts: np.array([r for part in parts for r in part], complex)
    )


@settings(max_examples=100)
@given(zeros=roots(3.0, 6), poles=roots(0.98, 6), gain=st.floats(0.001, 5) | st.floats(-5, -0.001))
def test_sections_multiply_to_the_ratio_of_the_roots(
    zeros: np.ndarray, poles: np.ndarray, gain: float
) -> None:
    sections = second_order_sections(zeros, poles, gain)
    expected = gain * product(zeros) / product(poles)
    assert np.allclose(response(sections), expected, rtol=1e-9, atol=1e-12 * abs(gain))
    assert np.all(sections[:, 3] == 1.0)


def test_the_pole_nearest_to_the_circle_comes_last_with_the_zeros_nearest_to_it() -> None:
    zeros, poles, gain = signal.ellip(6, 0.5, 60, 0.2, output="zpk")
    ours = second_order_sections(zeros, poles, gain)
    theirs = signal.zpk2sos(zeros, poles, gain)
    assert np.allclose(ours, theirs, rtol=1e-10, atol=1e-13)


def test_a_gain_alone_is_one_section() -> None:
    sections = second_order_sections(np.empty(0), np.empty(0), 0.5)
    assert np.array_equal(sections, [[0.5, 0, 0, 1, 0, 0]])


@pytest.mark.parametrize("zeros", [[], [-30.0], [-5 + 20j, -5 - 20j]])
def test_the_bilinear_transform_is_that_of_scipy(zeros: list[complex]) -> None:
    poles, lines = [-10 + 200j, -10 - 200j, -90.0], np.array([0.0, 3.0, 31.0, 220.0])
    numerator, denominator = (
        np.real(np.atleast_1d(np.poly(roots)))[::-1] for roots in (zeros, poles)
    )
    dynamics = TransferFunction.from_ascending(numerator, denominator)
    digital = signal.bilinear_zpk(zeros, poles, 1.0, 1e3)
    theirs = signal.freqz_zpk(*digital, 2 * np.pi * lines * 1e-3)[1]
    ours = bilinear(dynamics, 1e-3).response(lines)
    np.testing.assert_allclose(ours, theirs, rtol=1e-10)
