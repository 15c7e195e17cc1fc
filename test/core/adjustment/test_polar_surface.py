"""The surface's basis against closed forms and differences."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import BSpline

from omsm_ros.core.adjustment.scan_model import PolarBasis, spline_columns
from omsm_ros.core.streams.blocks import FloatArray

BASIS = PolarBasis(inner=1e-3, outer=13e-3, intervals=6, harmonics=3)


def matrix(radius: FloatArray, angle: FloatArray) -> FloatArray:
    rows = np.zeros((len(radius), BASIS.size))
    interval = BASIS.interval(radius)
    for k in range(BASIS.intervals):
        mine = interval == k
        rows[mine, BASIS.terms(k)] = BASIS.rows(k, radius[mine], angle[mine]).matrix()
    return rows


def points(count: int) -> tuple[FloatArray, FloatArray]:
    random = np.random.default_rng(1)
    return random.uniform(1e-3, 13e-3, count), random.uniform(-np.pi, np.pi, count)


def test_a_cubic_of_radius_times_a_harmonic_is_in_the_basis() -> None:
    radius, angle = points(3000)
    height = (radius / 1e-2) ** 3 * np.cos(2 * angle) + radius / 1e-2 * np.sin(3 * angle) + 0.3
    terms = matrix(radius, angle)
    fitted = terms @ np.linalg.lstsq(terms, height, rcond=None)[0]
    np.testing.assert_allclose(fitted, height, atol=1e-11)


def test_splines_sum_to_one() -> None:
    place = np.linspace(0.0, 5.0, 101)
    np.testing.assert_allclose(spline_columns(place, 5).sum(axis=1), 1.0, rtol=1e-13)
    assert spline_columns(place, 5).shape == (101, 8)


def test_derivatives_are_those_of_the_heights() -> None:
    random = np.random.default_rng(2)
    coefficients = random.normal(size=4 * BASIS.waves)
    radius, angle = random.uniform(5e-3, 7e-3, 50), random.uniform(-3, 3, 50)
    radial, angular = BASIS.rows(2, radius, angle).derivatives(coefficients)

    def height(r: FloatArray, a: FloatArray) -> FloatArray:
        rows = BASIS.rows(2, r, a)
        np.testing.assert_allclose(rows.heights(coefficients), rows.matrix() @ coefficients)
        return rows.heights(coefficients)

    step = 1e-7
    along = (height(radius + step, angle) - height(radius - step, angle)) / (2 * step)
    around = (height(radius, angle + step) - height(radius, angle - step)) / (2 * step)
    np.testing.assert_allclose(radial, along, rtol=1e-5, atol=1e-2)
    np.testing.assert_allclose(angular, around, rtol=1e-5, atol=1e-6)


def test_amplitudes_are_those_of_the_harmonics() -> None:
    radius, angle = points(3000)
    terms = matrix(radius, angle)
    height = 2e-6 * np.cos(2 * angle - 0.4) + 1e-6
    coefficients = np.linalg.lstsq(terms, height, rcond=None)[0]
    assert BASIS.amplitudes(coefficients) == pytest.approx([0.0, 2e-6, 0.0], abs=1e-15)


def test_neighbouring_intervals_meet() -> None:
    edge = np.array([BASIS.inner + 2 * BASIS.width])
    coefficients = np.random.default_rng(3).normal(size=BASIS.size)
    before, after = (
        BASIS.rows(k, edge, np.array([0.7])).heights(coefficients[BASIS.terms(k)]) for k in (1, 2)
    )
    np.testing.assert_allclose(before, after, rtol=1e-12)


def test_the_rim_is_in_the_last_interval() -> None:
    inside, angle = points(3000)
    radius, angle = np.append(inside, [BASIS.inner, BASIS.outer]), np.append(angle, [0.3, 0.4])
    assert BASIS.interval(radius)[-2:].tolist() == [0, BASIS.intervals - 1]
    height = (radius / 1e-2) ** 3
    terms = matrix(radius, angle)
    cubic = np.linalg.lstsq(terms[:-2], height[:-2], rcond=None)[0]
    np.testing.assert_allclose(terms @ cubic, height, atol=1e-9)


@pytest.mark.parametrize("intervals", [1, 4, 9])
def test_splines_are_those_of_scipy(intervals: int) -> None:
    place = np.linspace(0.0, intervals, 60, endpoint=False)
    knots = np.arange(-3.0, intervals + 4.0)
    expected = BSpline.design_matrix(place, knots, 3).toarray()
    np.testing.assert_allclose(spline_columns(place, intervals), expected, atol=1e-14)


def test_a_surface_is_smooth_to_the_second_derivative_at_every_knot() -> None:
    """Differences across a knot go with the third power of the step, as within an interval."""
    coefficients = np.random.default_rng(4).normal(size=BASIS.size)
    step = 1e-3 * BASIS.width
    assert BASIS.intervals > 1
    for k in range(1, BASIS.intervals):
        edge = BASIS.inner + k * BASIS.width
        at = [k - 1, k - 1, k - 1, k, k, k]
        near = edge + step * np.array([-2.5, -1.5, -0.5, 0.5, 1.5, 2.5])
        heights = [
            BASIS.rows(i, np.array([r]), np.array([0.7])).heights(coefficients[BASIS.terms(i)])[0]
            for i, r in zip(at, near, strict=True)
        ]
        third = np.abs(np.diff(heights, 3))
        assert np.max(third) < 1e-8 * np.ptp(coefficients)


def test_terms_are_counted_spline_by_spline() -> None:
    """Six intervals have nine cubic splines, three harmonics seven functions of the angle."""
    assert (BASIS.waves, BASIS.size) == (7, 63)
    assert BASIS.width == pytest.approx(2e-3)
    assert [BASIS.terms(k) for k in (0, 5)] == [slice(0, 28), slice(35, 63)]
    covered = [BASIS.inner + (k + 0.5) * BASIS.width for k in range(6)]
    assert BASIS.interval(np.array(covered)).tolist() == list(range(6))
    # Beyond either rim the nearest interval goes on.
    assert BASIS.interval(np.array([0.0, 1.0])).tolist() == [0, 5]


def turned(coefficients: FloatArray, angle: float) -> FloatArray:
    """Coefficients of the surface turned by ``angle``: cosines and sines of each harmonic mix."""
    shape = coefficients.reshape(-1, BASIS.waves)
    order = angle * np.arange(1, BASIS.harmonics + 1)
    mean, cosines, sines = np.split(shape, [1, BASIS.harmonics + 1], axis=1)
    along = cosines * np.cos(order) - sines * np.sin(order)
    across = cosines * np.sin(order) + sines * np.cos(order)
    return np.concatenate([mean, along, across], axis=1).ravel()


def test_a_turned_surface_is_the_same_elsewhere() -> None:
    coefficients = np.random.default_rng(5).normal(size=BASIS.size)
    radius, angle = points(200)
    there = matrix(radius, angle + 0.9) @ turned(coefficients, 0.9)
    np.testing.assert_allclose(there, matrix(radius, angle) @ coefficients, atol=1e-12)
    assert BASIS.amplitudes(turned(coefficients, 0.9)) == pytest.approx(
        BASIS.amplitudes(coefficients), rel=1e-12
    )


def test_without_harmonics_there_are_rings_alone() -> None:
    rings = PolarBasis(inner=1e-3, outer=13e-3, intervals=6, harmonics=0)
    rows = rings.rows(2, np.array([5.5e-3]), np.array([1.3]))
    assert rows.matrix().shape == (1, 4)
    assert rows.matrix().sum() == pytest.approx(1.0)
    assert rows.derivatives(np.ones(4)) == (pytest.approx(0.0, abs=1e-9), pytest.approx(0.0))
    assert len(rings.amplitudes(np.ones(9))) == 0
