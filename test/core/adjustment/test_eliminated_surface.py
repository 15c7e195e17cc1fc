"""The surface eliminated, and the scores of rings: against one least squares of everything."""

from __future__ import annotations

import numpy as np
import pytest

from omsm_ros.core.adjustment.scan_model import (
    DYNAMIC,
    GAIN,
    IntervalRows,
    PolarBasis,
    ScanModel,
    ScanPlacement,
    normal_equations,
    portions,
)
from omsm_ros.core.adjustment.self_calibration import RingScores
from omsm_ros.core.streams.blocks import FloatArray

from .synthetic_scans import coma, scanned

BASIS = PolarBasis(inner=2e-3, outer=10e-3, intervals=4, harmonics=2)
RANDOM = np.random.default_rng(11)
COUNT = 12_000
RADIUS = np.sort(RANDOM.uniform(2e-3, 10e-3, COUNT))[::-1].copy()
ANGLE = RANDOM.uniform(-np.pi, np.pi, COUNT)
X = RANDOM.normal(size=(COUNT, 3)) + np.stack([np.cos(ANGLE), RADIUS / 1e-2, 0 * ANGLE], axis=1)
INTERVAL = BASIS.interval(RADIUS)
ORDER = np.lexsort((np.arange(COUNT), INTERVAL))


def parts(kept: FloatArray | None = None) -> list[IntervalRows]:
    order = ORDER if kept is None else ORDER[kept[ORDER]]
    return list(portions(BASIS, order, INTERVAL, RADIUS, ANGLE))


def terms() -> FloatArray:
    rows = np.zeros((COUNT, BASIS.size))
    for part in parts():
        rows[part.points, BASIS.terms(part.interval)] = part.rows.matrix()
    return rows


B = terms()
SURFACE = RANDOM.normal(size=BASIS.size)
TRUTH = np.array([0.3, -2.0, 1.1])
Y = B @ SURFACE + X @ TRUTH + RANDOM.normal(0, 0.5, COUNT)


def columns(part: IntervalRows) -> tuple[FloatArray, FloatArray]:
    return X[part.points], Y[part.points]


def test_every_point_comes_once_in_its_interval_and_in_time() -> None:
    came = parts()
    assert np.array_equal(np.sort(np.concatenate([p.points for p in came])), np.arange(COUNT))
    for part in came:
        assert np.all(INTERVAL[part.points] == part.interval)
        assert np.all(np.diff(part.points) > 0)
    # Portions are bounded however many points an interval has.
    assert max(len(p.points) for p in came) <= 5000
    assert [p.interval for p in came] == sorted(p.interval for p in came)


def test_parameters_are_those_of_one_least_squares() -> None:
    found = normal_equations(BASIS, iter(parts()), columns)
    both, *_ = np.linalg.lstsq(np.concatenate([B, X], axis=1), Y, rcond=None)
    parameters = np.linalg.solve(found.matrix, found.right)
    assert parameters == pytest.approx(both[BASIS.size :], rel=1e-9)
    np.testing.assert_allclose(B @ found.surface_of(parameters), B @ both[: BASIS.size], atol=1e-8)
    residual = Y - B @ both[: BASIS.size] - X @ parameters
    assert found.misfit(parameters) == pytest.approx(residual @ residual, rel=1e-9)


@pytest.mark.parametrize("parameters", [np.zeros(3), np.array([1.0, 2.0, -3.0])])
def test_misfit_is_that_of_the_best_surface_for_any_parameters(parameters: FloatArray) -> None:
    found = normal_equations(BASIS, iter(parts()), columns)
    left = Y - X @ parameters
    surface, *_ = np.linalg.lstsq(B, left, rcond=None)
    expected = float(np.sum((left - B @ surface) ** 2))
    assert found.misfit(parameters) == pytest.approx(expected, rel=1e-9)
    np.testing.assert_allclose(found.surface_of(parameters), surface, atol=1e-7)


def test_any_surface_may_be_added_to_the_heights() -> None:
    plain = normal_equations(BASIS, iter(parts()), columns)
    other = B @ RANDOM.normal(size=BASIS.size)
    curved = normal_equations(
        BASIS, iter(parts()), lambda part: (X[part.points], Y[part.points] + other[part.points])
    )
    assert curved.right == pytest.approx(plain.right, rel=1e-8)
    assert curved.square == pytest.approx(plain.square, rel=1e-8)


def test_a_ring_that_nobody_saw_has_no_shape_and_harms_nothing() -> None:
    seen = RADIUS > 8e-3
    found = normal_equations(BASIS, iter(parts(seen)), columns)
    both = np.concatenate([B[seen], X[seen]], axis=1)
    expected = np.linalg.lstsq(both, Y[seen], rcond=None)[0]
    parameters = np.linalg.solve(found.matrix, found.right)
    assert parameters == pytest.approx(expected[BASIS.size :], rel=1e-6)
    # Splines of the innermost interval alone, which no point touches.
    assert np.all(np.abs(found.surface_of(parameters)[: 3 * BASIS.waves]) < 1e-9)


def test_a_column_that_is_a_surface_has_no_say() -> None:
    """Eliminate a column that the surface can represent: the parameters do not change."""
    wave = B @ SURFACE

    def with_wave(part: IntervalRows) -> tuple[FloatArray, FloatArray]:
        return np.column_stack([X[part.points], wave[part.points]]), Y[part.points]

    found = normal_equations(BASIS, iter(parts()), with_wave)
    assert found.matrix[3, 3] < 1e-9 * float(wave @ wave)


# -- ring scores

MODEL = ScanModel(
    [scanned(30.0, followed=coma, seed=1), scanned(60.0, followed=coma, seed=2)], harmonics=3
)
PLACE = ScanPlacement(1e-4, np.zeros(2))


def of_model() -> tuple[list[IntervalRows], FloatArray, FloatArray, FloatArray]:
    """Portions, and of all points in their order the terms, columns and heights."""
    came = list(MODEL.portions(PLACE, 1))
    rows = np.zeros((len(MODEL), MODEL.basis.size))
    x, y = np.zeros((len(MODEL), MODEL.size)), np.zeros(len(MODEL))
    flat = np.zeros(MODEL.basis.size)
    for part in came:
        rows[part.points, MODEL.basis.terms(part.interval)] = part.rows.matrix()
        x[part.points], y[part.points] = MODEL.columns(part, PLACE, flat)
    return came, rows, x, y


PARTS, ROWS, COLUMNS, HEIGHTS = of_model()


def gathered(heights: FloatArray, surface: FloatArray | None = None) -> RingScores:
    """Scores of ``heights`` as they are: nothing of a surface, and no parameter, is taken off."""
    basis = MODEL.basis
    seen = RingScores(MODEL, np.zeros((basis.size, MODEL.size)))
    flat = np.zeros(basis.size) if surface is None else surface
    for part in PARTS:
        x, y = COLUMNS[part.points], heights[part.points]
        seen.add(part, x, y, np.zeros(MODEL.size), flat)
    return seen


def rings(radius: FloatArray, count: int) -> FloatArray:
    basis = MODEL.basis
    edges = np.linspace(basis.inner, basis.outer, count + 1)
    return np.clip(np.searchsorted(edges, radius, side="right") - 1, 0, count - 1)


def test_scores_are_sums_over_whole_rings() -> None:
    noise = np.random.default_rng(3).normal(0, 1e-9, len(MODEL))
    seen = gathered(noise)
    radius = np.zeros(len(MODEL))
    for part in PARTS:
        radius[part.points] = MODEL.radius(part)
    count = int(min(MODEL.turns))
    assert 15 <= count <= 16
    ring, score_covariance = rings(radius, count), np.zeros((MODEL.size, MODEL.size))
    for k in range(count):
        score = noise[ring == k] @ COLUMNS[ring == k]
        score_covariance += np.outer(score, score) * count / (count - 1)
    scale = np.sqrt(np.maximum(np.diag(score_covariance), 1e-300))
    found = seen.score_covariance()
    assert np.allclose(
        found / np.outer(scale, scale), score_covariance / np.outer(scale, scale), atol=1e-9
    )
    assert seen.square == pytest.approx(float(noise @ noise), rel=1e-12, abs=0)


def test_what_the_surface_does_is_no_residual() -> None:
    surface = np.random.default_rng(4).normal(0, 1e-6, MODEL.basis.size)
    seen = gathered(ROWS @ surface, surface)
    assert seen.square < 1e-9 * float(np.sum((ROWS @ surface) ** 2))


def test_a_ring_that_is_high_as_a_whole_counts_more_than_scattered_points() -> None:
    """The same residuals, put in order: √n alike are worth far less than √n by chance."""
    size = np.abs(np.random.default_rng(5).normal(0, 1e-9, len(MODEL)))
    scattered = size * np.random.default_rng(6).choice([-1.0, 1.0], len(MODEL))
    column = COLUMNS[:, 0]
    alike = size * np.sign(column)
    chance, ordered = (gathered(h).score_covariance()[0, 0] for h in (scattered, alike))
    assert ordered > 100 * chance


def test_heights_follow_the_four_parameters_as_their_columns_say() -> None:
    surface = np.random.default_rng(7).normal(0, 1e-6, MODEL.basis.size)
    seen = gathered(HEIGHTS, surface)
    mixing = np.random.default_rng(8).normal(size=(4, 4))
    units = np.array([1e-6, 1e-8, 1e-4, 1e-6])
    covariance = units[:, np.newaxis] * (mixing @ mixing.T) * units
    four = COLUMNS[:, :DYNAMIC].copy()
    # ε d = ε (S - H(z)): the surface's own part of it is no longer in the fit.
    four[:, GAIN] += ROWS @ surface
    variance = np.einsum("np,pq,nq->n", four, covariance, four)
    assert seen.followed(covariance) == pytest.approx(np.sqrt(np.mean(variance)), rel=1e-9, abs=0)
    assert seen.followed(0 * covariance) == 0.0


def test_columns_are_the_derivatives_of_the_heights_by_the_parameters() -> None:
    """The model written out once more, differentiated by steps: latency, clocking, shift, tilt."""
    two = scanned(60.0, followed=coma, seed=2)
    surface = np.random.default_rng(9).normal(0, 1e-6, MODEL.basis.size)

    def shape(radius: FloatArray, angle: FloatArray, interval: int) -> FloatArray:
        rows = MODEL.basis.rows(interval, radius, angle)
        return rows.heights(surface[MODEL.basis.terms(interval)])

    own = MODEL.own(1)
    assert len(PARTS) >= 4
    for part in PARTS[2:4]:
        x, _ = MODEL.columns(part, PLACE, surface)
        mine = MODEL.scan[part.points] == 1
        radius, angle = MODEL.radius(part)[mine], MODEL.angle(part)[mine]
        radial, angular = two.radial_rate[0], two.angular_rate[0]

        def seen(
            latency: float,
            clocking: float,
            moved: complex,
            place: complex = radius * np.exp(1j * angle),
            rates: tuple[float, float] = (radial, angular),
            interval: int = part.interval,
        ) -> FloatArray:
            where = place - moved
            r = np.abs(where) - latency * rates[0]
            a = np.angle(where) - latency * rates[1] - clocking
            return shape(r, a, interval)

        at = PLACE.latency
        by = {
            "latency": (seen(at + 1e-7, 0, 0) - seen(at - 1e-7, 0, 0)) / 2e-7,
            "clocking": (seen(at, 1e-6, 0) - seen(at, -1e-6, 0)) / 2e-6,
            "shift_x": (seen(at, 0, 1e-8) - seen(at, 0, -1e-8)) / 2e-8,
            "shift_y": (seen(at, 0, 1e-8j) - seen(at, 0, -1e-8j)) / 2e-8,
            "tilt_x": radius * np.cos(angle),
            "tilt_y": radius * np.sin(angle),
        }
        places = [3, *range(own.start, own.stop)]
        for column, expected in zip(places, by.values(), strict=True):
            got = x[mine, column]
            assert np.allclose(got, expected, rtol=2e-3, atol=2e-3 * np.max(np.abs(expected)))
        assert not np.any(x[~mine, own.start :])


def test_slow_motion_has_the_columns_of_its_own_derivatives() -> None:
    column = {0: "motion_rate", 1: "motion_acceleration", 2: "motion"}
    sign = {0: 1.0, 1: -1.0, 2: -1.0}
    scans = [scanned(30.0, followed=coma, seed=1), scanned(60.0, followed=coma, seed=2)]
    for part in PARTS[:2]:
        for index, name in column.items():
            both = np.concatenate([getattr(s, name) for s in scans])
            radius = np.concatenate([s.radius for s in scans])
            within = (radius >= MODEL.basis.inner) & (radius <= MODEL.basis.outer)
            expected = sign[index] * both[within][part.points]
            assert np.array_equal(COLUMNS[part.points, index], expected)
