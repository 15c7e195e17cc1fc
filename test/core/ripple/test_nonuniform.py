"""The uneven Fourier sum against plain sums, the even transform, and what holds of any."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from omsm_ros.core.ripple.coordinates import fourier_sum


def summed(place, values, spacing, count):
    return np.array(
        [np.sum(values * np.exp(-2j * np.pi * k * spacing * place)) for k in range(count)]
    )


def uneven(count, low, high, seed=1):
    rng = np.random.default_rng(seed)
    place = rng.uniform(low, high, count)
    return np.concatenate([[low, high], place]), rng.normal(size=count + 2)


@settings(max_examples=40)
@given(
    st.integers(1, 60),
    st.integers(1, 70),
    st.floats(-50.0, 50.0),
    st.floats(0.01, 30.0),
    st.floats(0.05, 1.0),
)
def test_it_is_the_sum_wherever_it_begins_and_in_any_order(samples, count, low, width, part):
    place, values = uneven(samples, low, low + width)
    spacing = part / width
    found = fourier_sum(place, values, spacing, count)
    assert found.shape == (count,)
    allowed = 3e-7 * np.sum(abs(values))
    np.testing.assert_allclose(found, summed(place, values, spacing, count), atol=allowed)


def test_on_an_even_grid_it_is_the_fast_transform():
    values = np.random.default_rng(2).normal(size=500)
    found = fourier_sum(np.arange(500) * 0.2, values, 1 / 100.0, 251)
    np.testing.assert_allclose(found, np.fft.rfft(values), atol=1e-6 * np.sum(abs(values)))


def test_it_is_linear_and_its_first_is_the_sum():
    place, one = uneven(300, 0.0, 7.0)
    other = np.cos(place)
    both = fourier_sum(place, 2 * one - 3 * other, 0.1, 50)
    parts = 2 * fourier_sum(place, one, 0.1, 50) - 3 * fourier_sum(place, other, 0.1, 50)
    np.testing.assert_allclose(both, parts, atol=1e-9)
    assert both[0] == pytest.approx(np.sum(2 * one - 3 * other), abs=1e-4)


def test_a_shift_turns_its_phases_and_a_motion_turned_about_conjugates_it():
    place, values = uneven(200, -3.0, 4.0)
    k = np.arange(80)
    plain = fourier_sum(place, values, 0.12, 80)
    scale = 1e-6 * np.sum(abs(values))
    shifted = fourier_sum(place + 100.0, values, 0.12, 80)
    np.testing.assert_allclose(shifted, plain * np.exp(-2j * np.pi * k * 0.12 * 100), atol=scale)
    np.testing.assert_allclose(fourier_sum(-place, values, 0.12, 80), plain.conj(), atol=scale)


def test_micrometres_or_metres_make_no_difference():
    place, values = uneven(200, 0.0, 2e-3)
    metres = fourier_sum(place, values, 400.0, 60)
    micrometres = fourier_sum(1e6 * place, values, 400e-6, 60)
    np.testing.assert_allclose(metres, micrometres, atol=1e-9 * np.sum(abs(values)))


def test_one_strong_line_leaves_nothing_a_millionth_of_it_elsewhere():
    """The error is of the largest line; it hides no line a hundred thousandth as strong."""
    place, _ = uneven(4000, 0.0, 1.0, seed=5)
    found = fourier_sum(place, np.cos(2 * np.pi * 40 * place), 0.5, 200)
    direct = summed(place, np.cos(2 * np.pi * 40 * place), 0.5, 200)
    assert np.max(abs(found - direct)) < 3e-7 * np.max(abs(direct))
