"""Parseval, the power of a line, and the exactness of the uneven Fourier sum."""

import numpy as np
import pytest
from scipy.signal.windows import blackmanharris

from omsm_ros.core.ripple.coordinates import fourier_sum
from omsm_ros.core.ripple.density import density, evenly, smoothed
from omsm_ros.errors import DataError


@pytest.mark.parametrize("count", [1000, 1001])
def test_parseval_holds(count):
    values = np.random.default_rng(1).normal(0, 3.0, count)
    spectrum = density(values, 1e-3)
    window = blackmanharris(count, sym=False)
    weighted = np.sum((window * values) ** 2) / np.sum(window**2)
    assert np.sum(spectrum.density) * spectrum.step == pytest.approx(weighted, rel=1e-12)


def test_a_line_has_half_its_amplitude_squared():
    time = np.arange(10_000) * 1e-3
    spectrum = density(5e-9 * np.sin(2 * np.pi * 123.4 * time), 1e-3)
    assert spectrum.power(122.0, 125.0) == pytest.approx(12.5e-18, rel=1e-3, abs=0)
    assert spectrum.power(200.0, 500.0) < 1e-7 * 12.5e-18


def test_white_noise_has_its_variance_over_half_the_rate():
    spectrum = density(np.random.default_rng(2).normal(0, 1.0, 100_000), 1e-3)
    _, level = smoothed(spectrum, 10)
    assert level[-1] == pytest.approx(1.0 / 500.0, rel=0.05)


def test_millimetres_mask_no_nanometre():
    time = np.arange(20_000) * 1e-3
    large = 1e-3 * np.sin(2 * np.pi * 0.5 * time)
    spectrum = density(large + 1e-9 * np.sin(2 * np.pi * 80 * time), 1e-3)
    assert spectrum.power(79.0, 81.0) == pytest.approx(0.5e-18, rel=0.05, abs=0)


def test_too_few_values_are_refused():
    with pytest.raises(DataError, match="15 values"):
        density(np.zeros(15), 1.0)


def test_values_are_laid_evenly():
    np.testing.assert_allclose(evenly(np.array([0.0, 1, 3]), np.array([0.0, 2, 6]), 0.5)[-1], 6.0)


def test_the_uneven_fourier_sum_is_the_sum():
    rng = np.random.default_rng(3)
    place = np.sort(rng.uniform(2.0, 9.0, 700))
    values = rng.normal(size=700)
    spacing, count = 0.5 / 7.0, 300
    found = fourier_sum(place, values, spacing, count)
    k = np.arange(count)
    direct = np.exp(-2j * np.pi * spacing * np.outer(k, place)) @ values
    np.testing.assert_allclose(found, direct, atol=1e-6 * np.sum(abs(values)))
