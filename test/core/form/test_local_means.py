"""Against noise and waves whose size is known."""

import numpy as np
import pytest

from omsm_ros.core.form.part_figures import LocalMeans, closest_means

RANDOM = np.random.default_rng(3)
X, Y = RANDOM.uniform(-1.0, 1.0, (2, 12_000))


def test_means_keep_what_is_the_same_everywhere_and_average_noise():
    means = LocalMeans.of(X, Y, 12.0)
    np.testing.assert_allclose(means(np.full(len(X), 3.0)), 3.0, rtol=1e-12)
    values, more = RANDOM.normal(size=(2, len(X)))
    np.testing.assert_allclose(means(values + 2 * more), means(values) + 2 * means(more), atol=1e-9)
    # A Gaussian of cutoff c passes π / (2 ln 2 c²) of the variance of white noise: a point a step.
    assert np.var(means(values)) == pytest.approx(np.pi / (2 * np.log(2) * 144), rel=0.35)


@pytest.mark.parametrize("noise", [0.02, 0.2, 1.0])
@pytest.mark.parametrize("length", [0.15, 0.6])
def test_the_error_that_is_expected_is_the_error(noise, length):
    wave = np.sin(2 * np.pi * X / length) * np.cos(2 * np.pi * Y / length)
    values = wave + noise * RANDOM.normal(size=len(X))
    found = closest_means(X, Y, values, noise)
    means = found.means(values)
    # Its expectation is known to the chance of a mean of n squares of the noise.
    chance = 3 * noise**2 * np.sqrt(2 / len(X))
    assert found.error == pytest.approx(np.mean((means - wave) ** 2), rel=0.1, abs=chance)
    drawn = noise * RANDOM.normal(size=len(X))
    left = np.mean((drawn - found.means(drawn)) ** 2)
    assert found.rest * noise**2 == pytest.approx(left, rel=0.1)


def test_noise_alone_is_averaged_widest_and_a_clean_map_least():
    noise = RANDOM.normal(size=len(X))
    broad, fine = closest_means(X, Y, noise, 1.0), closest_means(X, Y, np.sin(30 * X), 1e-6)
    assert broad.error < 0.01
    assert broad.means.along_x[20, 20 + 8] > fine.means.along_x[20, 20 + 8]


def test_of_a_line_of_points():
    values = np.sin(3 * X) + 0.1 * RANDOM.normal(size=len(X))
    found = closest_means(X, np.zeros(len(X)), values, 0.1)
    assert np.std(found.means(values) - np.sin(3 * X)) < 0.05
