"""The fit beside form: bases by quadrature, sums by loops, the estimate by dense algebra."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import linalg

from omsm_ros.core.registration.form_model import (
    GROUP,
    LEAST_LIMIT_M,
    FormBasis,
    FormNormalEquations,
    best_matching_sum,
    estimate,
    outlier_limit,
)
from omsm_ros.core.registration.pose_parameters import (
    OpenUncertainty,
    PoseParameters,
    root_of,
    shares_of,
    typical_range,
)
from omsm_ros.core.surface.aperture import Aperture
from omsm_ros.core.surface.zernike_terms import terms_up_to, zernike_values
from omsm_ros.errors import DataError

RNG = np.random.default_rng(6)
RADIUS = 8e-3
DISC = Aperture(RADIUS)
LINE = np.linspace(-RADIUS, RADIUS, 121)
ALL_X, ALL_Y = (v.ravel() for v in np.meshgrid(LINE, LINE))


def region(kind):
    """Even places of a disc, a ring, a strip or a square."""
    reach = np.hypot(ALL_X, ALL_Y) / RADIUS
    kept = {
        "disc": reach <= 1,
        "ring": (reach <= 1) & (reach > 0.6),
        "strip": np.abs(ALL_Y) < 0.2 * RADIUS,
        "square": np.maximum(np.abs(ALL_X), np.abs(ALL_Y)) < 0.6 * RADIUS,
    }[kind]
    return ALL_X[kept], ALL_Y[kept]


def over(kind):
    x, y = region(kind)
    return FormBasis.over(x, y, np.ones(len(x)), DISC), x, y


@pytest.mark.parametrize("kind", ["ring", "strip", "square"])
def test_a_basis_is_orthonormal_over_its_region_and_knows_no_plane(kind):
    basis, x, y = over(kind)
    columns = basis.columns(x, y)
    gram = columns @ columns.T / len(x)
    sizes = np.sqrt(np.diag(gram))
    np.testing.assert_allclose(gram / np.outer(sizes, sizes), np.eye(len(basis)), atol=1e-3)
    planes = np.stack([np.ones_like(x), x / RADIUS, y / RADIUS])
    np.testing.assert_allclose(columns @ planes.T / len(x), 0, atol=1e-3)
    assert basis.group.min() == 2
    assert basis.group.max() <= 9


def test_on_a_disc_they_are_zernikes_of_rms_one_and_rotational_ones_somewhat_higher():
    """Rotational terms have twice the mean square of others that are as high at the rim."""
    basis, x, y = over("disc")
    terms = terms_up_to(8, 2)
    made = zernike_values(x / RADIUS, y / RADIUS, terms)
    assert len(basis) == len(terms)
    sizes = np.sqrt(np.mean(basis.columns(x, y) ** 2, axis=1))
    np.testing.assert_allclose(sizes**2, [1.0 if m else 1.5 for _, m in terms], rtol=1e-9)
    every = zernike_values(x / RADIUS, y / RADIUS, terms_up_to(8))
    expected = np.linalg.qr(every.T)[0].T[3:]
    for column, term, by_qr in zip(basis.columns(x, y), made, expected, strict=True):
        assert abs(np.corrcoef(column, by_qr)[0, 1]) == pytest.approx(1.0)
        # The places are few, so that Zernike's terms themselves have products of up to 0.03.
        assert abs(np.corrcoef(column, term)[0, 1]) > 0.99


def test_symmetric_terms_from_the_fourth_order_on_are_rings_of_their_own():
    basis, _, _ = over("disc")
    expected = [9 if m == 0 and n > 2 else n for n, m in terms_up_to(8, 2)]
    assert basis.group.tolist() == expected


@pytest.mark.parametrize("kind", ["disc", "strip"])
def test_a_basis_spans_every_polynomial_of_the_orders_it_is_of(kind):
    """With the planes: a cubic is met by the orders to 3 of it, whatever the region."""
    basis, x, y = over(kind)
    u, v = x / RADIUS, y / RADIUS
    cubic = 2 * u**3 - u * v * v + 0.3 * u * v + v * v
    low = np.concatenate([np.stack([np.ones_like(u), u, v]), basis.columns(x, y)[basis.group <= 3]])
    left = cubic - low.T @ np.linalg.lstsq(low.T, cubic, rcond=None)[0]
    assert np.abs(left).max() < 1e-3 * np.abs(cubic).max()


def test_points_at_one_place_show_no_form():
    nowhere = np.full(300, 1e-3)
    with pytest.raises(DataError, match="few places to show any form; measure across the part"):
        FormBasis.over(nowhere, nowhere, np.ones(300), DISC)


# Sums.


def test_sums_are_those_of_a_loop_over_points_and_groups():
    columns, systematic = RNG.normal(size=(4, 300)), RNG.normal(size=(2, 300))
    deviation, residual = RNG.normal(size=(2, 300))
    sums = FormNormalEquations(4, 2)
    sums.add(columns, deviation, systematic, residual)
    expected, scores = np.zeros((4, 7)), np.zeros(4)
    for k in range(300):
        row = np.concatenate([columns[:, k], deviation[k : k + 1], systematic[:, k]])
        expected += np.outer(columns[:, k], row)
    for start in range(0, 300, GROUP):
        part = slice(start, start + GROUP)
        scores += np.array([sum(c[part] * residual[part]) for c in columns]) ** 2
    np.testing.assert_allclose(sums.gram, expected)
    np.testing.assert_allclose(sums.scores, scores)
    assert sums.points == 300
    assert sums.square == pytest.approx(sum(r * r for r in residual))
    assert sums.total == pytest.approx(sum(d * d for d in deviation))


def test_whole_groups_may_come_one_by_one():
    columns, deviation, residual = RNG.normal(size=(3, 4 * GROUP)), *RNG.normal(size=(2, 4 * GROUP))
    none = np.empty((0, 4 * GROUP))
    whole, parts = FormNormalEquations(3, 0), FormNormalEquations(3, 0)
    whole.add(columns, deviation, none, residual)
    for k in range(4):
        part = slice(k * GROUP, (k + 1) * GROUP)
        parts.add(columns[:, part], deviation[part], none[:, part], residual[part])
    parts.add(columns[:, :0], deviation[:0], none[:, :0], residual[:0])
    for name in ("gram", "scores", "points", "square", "total"):
        np.testing.assert_allclose(getattr(parts, name), getattr(whole, name))


# The estimate.


GROUPS = np.array([2, 2, 2, 3, 3, 3, 3])
BROAD = (np.zeros(2), np.full(2, 1e3))


def problem(form, step, noise=1e-9, points=2000, seed=1):
    """Two pose parameters with seven terms of form, one of which looks like the first parameter."""
    rng = np.random.default_rng(seed)
    z = rng.normal(size=(7, points))
    j = np.stack([z[0] + 0.05 * rng.normal(size=points), rng.normal(size=points)])
    columns = np.concatenate([j, z])
    data = step @ j + form @ z + noise * rng.normal(size=points)
    return columns @ columns.T, columns @ data, float(np.mean(data**2))


def solved(gram, moments, largest, noise=1e-9, expected=BROAD):
    return estimate(gram, moments, noise**2, largest, GROUPS, expected)


def test_the_estimate_is_that_of_dense_algebra_with_the_sizes_that_it_found():
    """Solve ``(AᵀA/σ² + diag(1/s²))⁻¹ Aᵀd/σ²`` directly, with the sizes as priors."""
    form = 1e-8 * RNG.normal(size=7)
    gram, moments, largest = problem(form, np.array([3e-8, -2e-8]))
    found = solved(gram, moments, largest)
    prior = np.concatenate([np.full(2, 1e-6), 1 / found.sizes**2])
    covariance = linalg.inv(gram / found.noise + np.diag(prior))
    both = np.concatenate([found.step, found.form])
    np.testing.assert_allclose(both, covariance @ moments / found.noise, rtol=1e-6)
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-5, atol=1e-26)


def test_within_its_covariance_the_truth_is_found():
    """Standard scores of all estimates for fifty parts with 10 nm of form in each term."""
    scores = []
    for seed in range(50):
        rng = np.random.default_rng(seed)
        form, step = 1e-8 * rng.normal(size=7), 1e-7 * rng.normal(size=2)
        found = solved(*problem(form, step, seed=seed))
        truth = np.concatenate([step, form])
        spread = np.sqrt(np.diag(found.covariance))
        scores.append((np.concatenate([found.step, found.form]) - truth) / spread)
    assert 0.4 < np.sqrt(np.mean(np.square(scores))) < 1.1


def test_lower_orders_may_have_no_less_form_than_higher():
    form = np.array([0, 0, 0, 5e-8, -5e-8, 5e-8, 5e-8])
    found = solved(*problem(form, np.zeros(2)))
    assert np.all(found.sizes[:3] >= found.sizes[3:].max() * (1 - 1e-9))
    assert found.sizes[3] > 4e-8


def test_in_another_unit_of_a_freedom_its_step_is_as_many_times_larger():
    gram, moments, largest = problem(1e-8 * np.ones(7), np.array([3e-8, -2e-8]))
    unit = np.array([1e6, 1e-3, *np.ones(7)])
    usual = solved(gram, moments, largest)
    other = solved(
        gram * np.outer(unit, unit), moments * unit, largest,
        expected=(np.zeros(2), BROAD[1] / unit[:2]),
    )  # fmt: skip
    np.testing.assert_allclose(other.step * unit[:2], usual.step, rtol=1e-6)
    np.testing.assert_allclose(other.form, usual.form, rtol=1e-6)
    assert other.length == pytest.approx(usual.length, rel=1e-6)


def test_a_freedom_that_may_be_off_by_nothing_goes_back_to_where_parts_sit():
    """Where it stands at 5 nm, and parts at zero to a picometre: a step of −5 nm."""
    gram, moments, largest = problem(1e-9 * np.ones(7), np.zeros(2))
    at = np.array([5e-9, 0.0])
    found = solved(gram, moments, largest, expected=(at, np.array([1e-15, 1e3])))
    assert found.step[0] == pytest.approx(-5e-9, rel=1e-3)


def test_noise_of_one_point_widens_the_covariance_with_its_square():
    gram, moments, largest = problem(1e-8 * np.ones(7), np.zeros(2), noise=1e-8)
    one, two = (solved(gram, moments, largest, noise=n).covariance[1, 1] for n in (1e-8, 2e-8))
    assert two / one == pytest.approx(4.0, rel=0.1)


# Dust, and steps.


def test_a_sum_of_columns_is_found_whatever_a_few_specks_do():
    columns = np.stack([np.ones(2000), np.linspace(-1, 1, 2000), np.linspace(-1, 1, 2000) ** 2])
    columns[2] *= 1e6
    truth = np.array([1e-7, -2e-7, 3e-13])
    deviation = truth @ columns + 1e-9 * RNG.normal(size=2000)
    clean, residual, *_ = best_matching_sum(columns, deviation)
    limit = outlier_limit(residual)
    np.testing.assert_allclose(clean, truth, rtol=0.02)
    assert limit == pytest.approx(5e-9, rel=0.15)
    dusty = deviation.copy()
    dusty[::100] += 1e-5
    found, residual, *_ = best_matching_sum(columns, dusty)
    limit = outlier_limit(residual)
    np.testing.assert_allclose(found, clean, rtol=0.01)
    assert limit < 1e-8


def test_columns_that_are_nearly_alike_do_not_follow_a_speck():
    """They differ at one point only, where multiples a million times the form would fit dust."""
    x = np.linspace(-1, 1, 2000)
    columns = np.stack([x**2, x**2 + 1e-3 * (x == x[-1])])
    deviation = 1e-7 * x**2 + 1e-9 * RNG.normal(size=2000)
    deviation[-1] += 1e-5
    found, residual, *_ = best_matching_sum(columns, deviation)
    limit = outlier_limit(residual)
    assert abs(deviation[-1] - (found @ columns)[-1]) > 100 * limit
    np.testing.assert_allclose(found @ columns[:, 500], 1e-7 * x[500] ** 2, rtol=0.02)


def test_without_specks_it_is_the_least_squares_of_numpy():
    columns = RNG.normal(size=(3, 500))
    deviation = RNG.uniform(-1, 1, 500)
    found, *_ = best_matching_sum(columns, deviation)
    expected = np.linalg.lstsq(columns.T, deviation, rcond=None)[0]
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_a_column_of_nothing_takes_no_part():
    columns = np.stack([np.ones(100), np.zeros(100)])
    found, residual, *_ = best_matching_sum(columns, np.full(100, 3e-9))
    limit = outlier_limit(residual)
    np.testing.assert_allclose(found, [3e-9, 0.0])
    assert limit == LEAST_LIMIT_M


def test_what_more_than_one_point_of_twenty_does_is_no_dust():
    residual = 1e-9 * RNG.normal(size=10_000)
    assert outlier_limit(residual) == pytest.approx(5e-9, rel=0.05)
    steps = np.where(np.arange(10_000) % 10 == 0, 1e-6, residual)
    assert outlier_limit(steps) > 1e-6
    few = np.where(np.arange(10_000) % 50 == 0, 1e-6, residual)
    assert outlier_limit(few) < 6e-9
    assert outlier_limit(np.zeros(100)) == LEAST_LIMIT_M


def test_pose_parameters_that_are_nearly_alike_are_solved_to_the_last_digit():
    """Two moves whose effects differ by a part in a million: the step changes nothing it fits.

    A second solution, of what the first leaves, is far below its uncertainty in every direction.
    """
    basis, x, y = over("disc")
    z = basis.columns(x, y)
    moves = np.stack([np.ones_like(x), x / RADIUS, x / RADIUS + 1e-6 * (x / RADIUS) ** 3])
    deviation = 1e-6 * (moves[1] - moves[2] / 2) + 20e-9 * z[3] + 1e-9 * RNG.normal(size=len(x))
    columns = np.concatenate([moves, z])
    prior = np.zeros(3), np.full(3, 1e-3)

    def solved(data):
        given = columns @ columns.T, columns @ data, 1e-18, float(np.mean(data**2))
        return estimate(*given, basis.group, prior)

    first = solved(deviation)
    left = deviation - np.concatenate([first.step, first.form]) @ columns
    assert np.std(left) < 1.05e-9
    again = np.linalg.solve(
        columns @ columns.T / 1e-18 + np.diag([1e6] * 3 + [*first.sizes**-2.0]),
        columns @ left / 1e-18 - np.append(first.step * 1e6, first.form / first.sizes**2),
    )
    assert first._replace(step=again[:3]).length < 1e-2


# The budget.


def random_covariance(count):
    units = np.diag(np.array([1e-9, 1e3, 1.0, 1e-4])[:count])
    mixed = units @ RNG.normal(size=(count, count))
    return mixed @ mixed.T


def test_rows_of_a_root_make_up_the_covariance_in_any_units():
    covariance = random_covariance(4)
    rows = root_of(covariance)
    scale = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(
        rows.T @ rows / np.outer(scale, scale), covariance / np.outer(scale, scale), atol=1e-12
    )


def test_shares_of_rows_make_up_another_covariance():
    rows, other = root_of(random_covariance(4)), random_covariance(4)
    amounts = shares_of(rows, other)
    scale = np.sqrt(np.diag(other))
    made = rows.T @ amounts @ rows
    np.testing.assert_allclose(
        made / np.outer(scale, scale), other / np.outer(scale, scale), atol=1e-6
    )
    # The shares of its own covariance are one.
    own = rows.T @ rows
    np.testing.assert_allclose(shares_of(rows, own), np.eye(4), atol=1e-6)


def test_uncertainties_of_a_freedom_add_up_from_where_they_come():
    covariance = np.diag([9e-18, 16e-12])
    moved = np.array([[4e-9, 0.0, 1e-9], [0.0, 2e-6, 0.0]])
    correlated_moves = {
        "clocking": {"x": np.array([3e-9, 4e-9]), "tip": np.zeros(2), "y": np.ones(2)}
    }
    found = OpenUncertainty(correlated_moves, np.array([[4e-10]]))
    by_source = found.by_source(("x", "tip"), covariance, ("slide", "gain", "slide"), moved)
    np.testing.assert_allclose(by_source["noise and form"], [3e-9, 4e-6])
    np.testing.assert_allclose(by_source["slide"], [np.sqrt(17) * 1e-9, 0.0])
    np.testing.assert_allclose(by_source["gain"], [0.0, 2e-6])
    np.testing.assert_allclose(by_source["clocking"], [5e-9, 0.0])
    dofs = PoseParameters(("x", "tip"), {"clocking": "why"}, {"y": "why"})
    spread = found.spread(dofs, by_source)
    assert spread["x"] == pytest.approx(np.sqrt(9 + 17 + 25) * 1e-9)
    assert spread["tip"] == pytest.approx(np.sqrt(20) * 1e-6)
    assert spread["y"] == pytest.approx(np.sqrt(4e-10 + 2))
    assert spread["clocking"] == typical_range("clocking")
