"""Errors of unknown form and drifts as sums of shapes: their covariance in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from omsm_ros.core.comparison.stated_errors import (
    AT_ONCE,
    ESTIMATED,
    STATED,
    ComparedMeasurement,
    MeasurementErrors,
    drift,
    drift_size,
    likely_drift,
    unknown_form,
)
from omsm_ros.core.surface.measured_points import MeasuredPoints

RNG = np.random.default_rng(4)
X, Y = RNG.uniform(-5e-3, 5e-3, (2, 200))
SIZE = RNG.uniform(1e-9, 5e-9, 200)
ORDER = np.linspace(0, 1, 101)


def covariance(shapes):
    return shapes.T @ shapes


@pytest.mark.parametrize("length", [2e-3, 5e-3, 50e-3])
def test_an_unknown_form_falls_with_the_distance_as_a_gaussian(length):
    distance = np.hypot(X[:, None] - X, Y[:, None] - Y)
    expected = np.outer(SIZE, SIZE) * np.exp(-(distance**2) / (2 * length**2))
    found = covariance(unknown_form(X, Y, SIZE, length))
    # Half a per cent of the variance is left out, and scaled back on the diagonal.
    np.testing.assert_allclose(np.sqrt(np.diag(found)), SIZE, rtol=1e-9)
    assert np.abs(found - expected).max() < 0.03 * SIZE.max() ** 2


def test_over_a_long_length_all_heights_are_off_alike():
    shapes = unknown_form(X, Y, np.full(200, 3e-9), 10.0)
    assert shapes.shape == (1, 200)
    np.testing.assert_allclose(np.abs(shapes), np.full((1, 200), 3e-9), rtol=1e-5)


GRID_X, GRID_Y = (v.ravel() for v in np.meshgrid(*[np.linspace(-5e-3, 5e-3, 60)] * 2))


@pytest.mark.parametrize("length", [5e-3, 2.5e-3, 1e-3, 0.6e-3])
def test_over_a_map_row_by_row_no_place_is_better_known_than_another(length):
    """The mean over the map has the variance of the mean of the covariance."""
    shapes = unknown_form(GRID_X, GRID_Y, np.full(3600, 2e-9), length)
    np.testing.assert_allclose(np.linalg.norm(shapes, axis=0), np.full(3600, 2e-9), rtol=1e-9)
    x, y = GRID_X[::7], GRID_Y[::7]
    square = (GRID_X[:, None] - x) ** 2 + (GRID_Y[:, None] - y) ** 2
    expected = 2e-9 * np.sqrt(np.mean(np.exp(-square / (2 * length**2))))
    assert np.linalg.norm(shapes.mean(axis=1)) == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize("length", [1e-4, 1e-6])
@pytest.mark.parametrize(("x", "y"), [(GRID_X, GRID_Y), (X, Y)])
def test_an_error_of_short_length_is_never_lost(x, y, length):
    """A correlation length below the distance of the 400 nodes is raised to it."""
    shapes = unknown_form(x, y, np.full(len(x), 2e-9), length)
    np.testing.assert_allclose(np.linalg.norm(shapes, axis=0), np.full(len(x), 2e-9), rtol=1e-9)
    assert np.linalg.norm(shapes.mean(axis=1)) > 2e-9 / np.sqrt(len(x))


def test_places_that_are_all_one_are_off_alike():
    shapes = unknown_form(np.zeros(5), np.zeros(5), np.full(5, 1e-9), 1e-3)
    np.testing.assert_allclose(shapes.T @ shapes, np.full((5, 5), 1e-18))


def test_an_unknown_form_knows_no_frame_no_unit_and_scales_with_its_size():
    usual = covariance(unknown_form(X, Y, SIZE, 3e-3))
    c, s = np.cos(0.8), np.sin(0.8)
    elsewhere = unknown_form(c * X - s * Y + 1e-2, s * X + c * Y, SIZE, 3e-3)
    np.testing.assert_allclose(covariance(elsewhere), usual, atol=1e-6 * usual.max())
    in_millimetres = unknown_form(1e3 * X, 1e3 * Y, 7 * SIZE, 3.0)
    np.testing.assert_allclose(covariance(in_millimetres), 49 * usual, atol=1e-5 * usual.max())


def test_carried_from_few_places_to_many_the_variance_is_full():
    x, y = RNG.uniform(-5e-3, 5e-3, (2, 3000))
    size = np.full(3000, 2e-9)
    shapes = unknown_form(x, y, size, 2.5e-3)
    assert len(shapes) < 60
    np.testing.assert_allclose(np.linalg.norm(shapes, axis=0), size, rtol=1e-9)
    near = np.argsort(np.hypot(x - x[0], y - y[0]))[:50]
    distance = np.hypot(x[near] - x[0], y[near] - y[0])
    expected = 4e-18 * np.exp(-(distance**2) / (2 * 2.5e-3**2))
    np.testing.assert_allclose(shapes[:, near].T @ shapes[:, 0], expected, atol=0.05 * 4e-18)


def test_nothing_uncertain_and_nowhere_have_no_shape():
    assert unknown_form(X, Y, np.zeros(200), 1e-3).shape == (0, 200)
    assert unknown_form(X[:0], Y[:0], SIZE[:0], 1e-3).shape == (0, 0)


def test_where_a_height_is_certain_all_shapes_are_zero():
    size = np.where(np.arange(200) < 50, 0.0, 1e-9)
    shapes = unknown_form(X, Y, size, 2e-3)
    assert not np.any(shapes[:, :50])
    assert np.all(np.any(shapes[:, 50:], axis=0))


# Drift.


def test_a_drift_is_a_random_walk_of_its_size_at_the_end():
    """Its covariance is size² min(s, t)."""
    found = covariance(drift(ORDER, 20e-9))
    expected = 400e-18 * np.minimum(ORDER[:, None], ORDER)
    assert np.abs(found - expected).max() < 0.02 * 400e-18
    np.testing.assert_allclose(covariance(drift(ORDER, 60e-9)), 9 * found, rtol=1e-9)


def test_a_drift_knows_the_time_and_not_the_order_of_the_places():
    mixed = RNG.permutation(101)
    np.testing.assert_allclose(drift(ORDER[mixed], 1e-9), drift(ORDER, 1e-9)[:, mixed], atol=1e-18)


def test_a_drift_of_which_the_difference_shows_nothing_is_smaller_than_its_noise():
    shapes = drift(ORDER, 1.0)
    none = np.empty((0, 101))
    noise = np.full(101, 1e-9)
    still = likely_drift(np.zeros(101), none, noise, shapes)
    assert still < 1e-9
    walked = likely_drift(30e-9 * shapes[0] + 10e-9 * shapes[1], none, noise, shapes)
    assert walked > 10 * still


@pytest.mark.parametrize("scale", [0.1, 10.0])
def test_a_difference_that_is_larger_throughout_tells_a_drift_as_much_larger(scale):
    rng = np.random.default_rng(1)
    shapes = drift(ORDER, 1.0)
    walk = 20e-9 * rng.standard_normal(len(shapes)) @ shapes + rng.normal(0, 1e-9, 101)
    none, noise = np.empty((0, 101)), np.full(101, 1e-9)
    usual = likely_drift(walk, none, noise, shapes)
    other = likely_drift(scale * walk, none, scale * noise, shapes)
    assert other == pytest.approx(scale * usual, rel=0.03)


def test_what_another_error_explains_is_no_drift():
    shapes = drift(ORDER, 1.0)
    walk = 40e-9 * shapes[0]
    noise = np.full(101, 1e-9)
    alone = likely_drift(walk, np.empty((0, 101)), noise, shapes)
    adjacent = likely_drift(walk, 40e-9 * shapes[:1], noise, shapes)
    assert adjacent < 0.2 * alone


def test_the_largest_of_a_drift_is_where_its_shapes_add_up_to_most():
    rows = np.array([[1e-9, 3e-9, 0.0], [2e-9, 4e-9, 0.0]])
    shapes = {"drift": rows[:1], "drift of the probe": rows[1:], "other": 1e-6 * np.ones((1, 3))}
    errors = MeasurementErrors(shapes, np.zeros(3), np.zeros(3))
    assert drift_size(errors) == pytest.approx(5e-9)
    assert drift_size(None) == 0.0
    assert drift_size(MeasurementErrors({"other": rows}, np.zeros(3), np.zeros(3))) == 0.0
    assert (
        drift_size(MeasurementErrors({"drift": np.empty((0, 3))}, np.zeros(3), np.zeros(3))) == 0.0
    )


# Origin of the errors.


class Known:
    """Fields of one source."""

    aligned = ()

    def __init__(self, *names):
        self.names = names


def measurement(sample, **known):
    points = MeasuredPoints(x=X, y=Y, height=0 * X, sample=sample)
    return ComparedMeasurement(name="a", points=points, **known)


@pytest.mark.parametrize(
    ("known", "says"),
    [
        ({}, ESTIMATED),
        ({"drift": 0.0}, STATED),
        ({"drift": 5e-9}, STATED),
        ({"fields": Known("probe_latency")}, ESTIMATED),
        ({"fields": Known("probe_latency", "drift_walk")}, STATED),
    ],
)
def test_a_drift_is_stated_or_in_the_fields_or_estimated(known, says):
    assert measurement(np.arange(200), **known).drift_from == says
    # A map has no time to drift in.
    assert measurement(None, **known).drift_from == AT_ONCE


def test_a_scan_lasts_from_its_first_sample_to_its_last():
    assert measurement(np.arange(200)[::-1] * 5 + 70).duration == 995
    assert measurement(None).duration == 1.0
    assert measurement(np.full(200, 7)).duration == 1.0
