"""E_n of differences that are made, against least squares of scipy and χ² in closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from omsm_ros.core.comparison.agreement import (
    COVERAGE_FACTOR,
    TERMS,
    MeasurementErrors,
    figures_of,
    judge,
    peak_to_valley,
    robust_peak_to_valley,
    root_mean_square,
    shapes_of_difference,
)
from omsm_ros.core.comparison.matching import Matched
from omsm_ros.core.comparison.resampling import LocalHeights
from omsm_ros.core.surface.height_grid import HeightGrid
from omsm_ros.core.surface.zernike_terms import zernike_values

RNG = np.random.default_rng(8)
SIDE, RADIUS = 25, 5e-3
LINE = np.linspace(-RADIUS, RADIUS, SIDE)
ALL_X, ALL_Y = (v.ravel() for v in np.meshgrid(LINE, LINE))
INSIDE = np.hypot(ALL_X, ALL_Y) <= RADIUS * (1 + 1e-9)
X, Y = ALL_X[INSIDE], ALL_Y[INSIDE]
COUNT = len(X)
SEATED = {"piston": np.ones(COUNT), "tip": Y, "tilt": -X}
VALUES = zernike_values(X / RADIUS, Y / RADIUS, TERMS)


def matched(a, b=None, columns=SEATED):
    """Two measurements at the places of a disc."""
    b = np.zeros(COUNT) if b is None else b
    flat = np.full(SIDE * SIDE, np.nan)
    flat[INSIDE] = a - b
    step = LINE[1] - LINE[0]
    nothing = LocalHeights(*np.zeros((7, COUNT)))
    return Matched(
        grid=HeightGrid(height=flat.reshape(SIDE, SIDE), x0=-RADIUS, y0=-RADIUS, dx=step, dy=step),
        filled=INSIDE, x=X, y=Y, a=a, b=b, columns=np.stack(list(columns.values())),
        dofs=tuple(columns), moved=dict.fromkeys(columns, 0.0), refused={},
        from_a=nothing, from_b=nothing, b_x=X, b_y=Y,
    )  # fmt: skip


def noisy(size, **shapes):
    return MeasurementErrors(shapes, np.full(COUNT, size), np.full(COUNT, size))


def levelled(values, columns=SEATED):
    design = np.stack(list(columns.values()), axis=1)
    design = design / np.linalg.norm(design, axis=0)
    return values - design @ np.linalg.lstsq(design, values, rcond=None)[0]


# Figures.


def test_figures_of_few_values_are_those_by_hand():
    values = np.array([[3.0, -4.0, 0.0, 5.0], [1.0, 1.0, 1.0, 1.0]])
    assert peak_to_valley(values).tolist() == [9.0, 0.0]
    assert root_mean_square(values) == pytest.approx([np.sqrt(12.5), 1.0])


def test_a_speck_in_a_thousand_is_no_robust_peak_to_valley():
    values = np.linspace(-1, 1, 2001)
    assert robust_peak_to_valley(values) == pytest.approx(2 * 0.995)
    specks = np.append(values, [500.0, -700.0])
    assert robust_peak_to_valley(specks) == pytest.approx(2 * 0.995, rel=2e-3)
    assert peak_to_valley(specks) == 1200


@pytest.mark.parametrize("figure", [peak_to_valley, robust_peak_to_valley, root_mean_square])
def test_figures_scale_with_the_heights_and_know_no_order(figure):
    values = RNG.normal(size=(3, 200))
    assert figure(-2.5 * values) == pytest.approx(2.5 * figure(values))
    assert figure(RNG.permuted(values, axis=1)) == pytest.approx(figure(values))
    if figure is not root_mean_square:
        assert figure(values + 7.0) == pytest.approx(figure(values))


def test_figures_are_of_what_the_fit_leaves():
    form = 50e-9 * VALUES[2]
    pair = matched(form + 1e-6 + 3e-5 * X, 0.5 * form - 2e-5 * Y)
    found = figures_of(pair)
    for name, figure in (("peak_to_valley", peak_to_valley), ("rms", root_mean_square)):
        assert found[name].a == pytest.approx(float(figure(levelled(form))))
        assert found[name].b == pytest.approx(float(figure(levelled(form))) / 2)
        assert found[name].e_n is None


# Shapes.


def test_errors_of_two_stand_side_by_side_and_what_is_one_is_subtracted():
    one, other, both = RNG.normal(size=(3, 2, COUNT))
    errors = (noisy(1.0, own=one, calibration=both), noisy(1.0, calibration=2 * both, other=other))
    apart = shapes_of_difference(errors)
    assert apart.shape == (8, COUNT)
    np.testing.assert_allclose(
        apart.T @ apart, one.T @ one + other.T @ other + 5 * both.T @ both, atol=1e-12
    )
    shared = shapes_of_difference(errors, ("calibration",))
    np.testing.assert_allclose(
        shared.T @ shared, one.T @ one + other.T @ other + both.T @ both, atol=1e-12
    )
    assert shapes_of_difference((noisy(1.0), noisy(1.0))).shape == (0, COUNT)


# Terms.


def by_least_squares(difference, columns=SEATED):
    """Terms of the difference from one fit of all columns, and their covariance per variance."""
    seat = np.stack(list(columns.values()), axis=1)
    design = np.hstack([seat / np.linalg.norm(seat, axis=0), VALUES.T])
    found = np.linalg.lstsq(design, difference, rcond=None)[0]
    covariance = np.linalg.inv(design.T @ design)
    return found[len(columns) :], covariance[len(columns) :, len(columns) :]


def test_terms_and_their_uncertainty_are_those_of_one_fit_of_all():
    difference = RNG.normal(0, 3e-9, COUNT) + 20e-9 * VALUES[1] + 1e-6
    found = judge(matched(difference), (noisy(4e-9), noisy(3e-9)))
    expected, per_variance = by_least_squares(difference)
    assert [(t.n, t.m) for t in found.terms] == [tuple(term) for term in TERMS]
    assert [t.difference for t in found.terms] == pytest.approx(expected)
    spread = 5e-9 * np.sqrt(np.diag(per_variance))
    assert [t.uncertainty for t in found.terms] == pytest.approx(spread)
    score = expected @ np.linalg.solve(25e-18 * per_variance, expected)
    assert found.probability == pytest.approx(stats.chi2.sf(score, len(TERMS)), rel=1e-6)


def test_the_coverage_factor_is_that_of_all_terms_together():
    """Šidák: with 95 % none of independent terms exceeds it."""
    found = judge(matched(RNG.normal(0, 1e-9, COUNT)), (noisy(1e-9), noisy(1e-9)))
    factor = stats.norm.ppf((1 + 0.95 ** (1 / len(TERMS))) / 2)
    for term in found.terms:
        assert term.expanded == pytest.approx(factor * term.uncertainty)
        assert term.e_n == pytest.approx(term.difference / term.expanded)
    assert found.largest.e_n == max((t.e_n for t in found.terms), key=abs)


def test_an_error_of_the_form_of_a_term_is_the_uncertainty_of_that_term():
    shape = 30e-9 * VALUES[None, TERMS.index((3, 1))]
    found = judge(matched(np.zeros(COUNT)), (noisy(1e-12, coma=shape), noisy(1e-12)))
    spread = {(t.n, t.m): t.uncertainty for t in found.terms}
    assert spread.pop((3, 1)) == pytest.approx(30e-9, rel=1e-4)
    assert max(spread.values()) < 1e-11
    assert found.probability == pytest.approx(1.0)


def test_what_the_fit_takes_off_is_no_uncertainty():
    planes = np.stack([1e-6 * np.ones(COUNT), 1e-3 * X])
    plain = judge(matched(np.zeros(COUNT)), (noisy(1e-9), noisy(1e-9)))
    seated = judge(matched(np.zeros(COUNT)), (noisy(1e-9, seat=planes), noisy(1e-9)))
    np.testing.assert_allclose(seated.uncertainty, plain.uncertainty, rtol=1e-6)


def test_a_term_that_was_fitted_is_not_judged():
    bowl = {**SEATED, "power": (X**2 + Y**2) / 2}
    difference = RNG.normal(0, 1e-9, COUNT)
    found = judge(matched(difference, columns=bowl), (noisy(1e-9), noisy(1e-9)))
    names = {(t.n, t.m) for t in found.terms}
    assert names == {tuple(t) for t in TERMS} - {(2, 0)}


def test_exchanged_they_differ_by_the_opposite():
    a, b = RNG.normal(0, 2e-9, (2, COUNT)) + 10e-9 * VALUES[4]
    errors = (noisy(2e-9, own=5e-9 * VALUES[3:4]), noisy(1e-9))
    there, back = judge(matched(a, b), errors), judge(matched(b, a), errors[::-1])
    assert [t.difference for t in back.terms] == pytest.approx([-t.difference for t in there.terms])
    assert [t.e_n for t in back.terms] == pytest.approx([-t.e_n for t in there.terms])
    assert back.probability == pytest.approx(there.probability)
    assert (back.within, back.farthest, back.at) == (
        there.within, pytest.approx(there.farthest), there.at,
    )  # fmt: skip
    for name, number in there.figures.items():
        assert back.figures[name].a == pytest.approx(number.b)
        # Drawn anew, a standard deviation of 300 is known to 4 %.
        assert back.figures[name].expanded == pytest.approx(number.expanded, rel=0.2)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_in_other_units_of_height_the_judgement_is_the_same(scale):
    a, b = RNG.normal(0, 2e-9, (2, COUNT)) + 10e-9 * VALUES[4]
    shape = 5e-9 * VALUES[3:4]
    usual = judge(matched(a, b), (noisy(2e-9, own=shape), noisy(1e-9)))
    other = judge(
        matched(scale * a, scale * b), (noisy(scale * 2e-9, own=scale * shape), noisy(scale * 1e-9))
    )
    assert [t.e_n for t in other.terms] == pytest.approx([t.e_n for t in usual.terms])
    assert other.probability == pytest.approx(usual.probability)
    assert other.allowed == pytest.approx(usual.allowed)
    assert other.figures["rms"].e_n == pytest.approx(usual.figures["rms"].e_n)


def test_an_error_that_is_one_in_both_is_none_of_the_difference():
    a, b = RNG.normal(0, 2e-9, (2, COUNT))
    shape = 200e-9 * VALUES[5:6]
    errors = (noisy(2e-9, loop=shape), noisy(2e-9, loop=shape))
    without = judge(matched(a, b), (noisy(2e-9), noisy(2e-9)))
    shared = judge(matched(a, b), errors, ("loop",))
    apart = judge(matched(a, b), errors)
    np.testing.assert_allclose(shared.uncertainty, without.uncertainty, rtol=1e-9)
    assert shared.probability == pytest.approx(without.probability)
    spread = {(t.n, t.m): t.uncertainty for t in apart.terms}
    assert spread[TERMS[5]] == pytest.approx(np.sqrt(2) * 200e-9, rel=1e-3)


# Places.


def test_the_share_within_is_that_of_places_below_two_uncertainties():
    difference = RNG.normal(0, 3e-9, COUNT)
    found = judge(matched(difference), (noisy(2e-9), noisy(1e-9)))
    spread = np.hypot(2e-9, 1e-9)
    np.testing.assert_allclose(found.uncertainty, np.full(COUNT, spread))
    assert found.within == np.mean(np.abs(difference) < COVERAGE_FACTOR * spread)
    assert found.aperture == (pytest.approx(RADIUS), pytest.approx(0.0), pytest.approx(0.0))


def test_the_place_that_is_farthest_off_is_named_in_uncertainties():
    difference = RNG.normal(0, 1e-9, COUNT)
    difference[117] = -40e-9
    errors = noisy(1e-9)
    # Twice as uncertain, twice as far off there would count no more.
    broad = replace(errors, single=np.where(np.arange(COUNT) == 117, 4e-9, 1e-9))
    found = judge(matched(difference), (errors, broad))
    assert found.at == (X[117], Y[117])
    assert found.farthest == pytest.approx(40 / np.sqrt(17))
    assert found.farthest > found.allowed


def test_of_independent_places_the_farthest_is_that_of_as_many_normal_ones():
    found = judge(matched(np.zeros(COUNT)), (noisy(1e-9), noisy(1e-9)))
    expected = stats.norm.ppf((1 + 0.99 ** (1 / COUNT)) / 2)
    assert found.allowed == pytest.approx(expected, rel=0.1)


def test_figures_that_differ_by_noise_alone_agree():
    """Noise widens a peak to valley by many of its own uncertainties; that is allowed for."""
    form = 100e-9 * VALUES[2]
    a, b = form + RNG.normal(0, 20e-9, COUNT), form + RNG.normal(0, 1e-9, COUNT)
    found = judge(matched(a, b), (noisy(20e-9), noisy(1e-9)))
    broad = found.figures["peak_to_valley"]
    assert broad.a - broad.b > 30e-9
    assert all(abs(number.e_n) < 1 for number in found.figures.values())


def test_a_part_of_twice_the_form_error_differs_in_every_figure():
    form = 100e-9 * VALUES[2]
    noise = RNG.normal(0, 1e-9, (2, COUNT))
    found = judge(matched(2 * form + noise[0], form + noise[1]), (noisy(1e-9), noisy(1e-9)))
    assert all(number.e_n > 1 for number in found.figures.values())
    term = next(t for t in found.terms if (t.n, t.m) == TERMS[2])
    assert term.difference == pytest.approx(100e-9, abs=5 * term.uncertainty)
    assert found.probability < 1e-6
    assert found.within < 0.5


def test_the_same_input_is_judged_alike_twice():
    difference = RNG.normal(0, 1e-9, COUNT)
    errors = (noisy(1e-9, own=2e-9 * VALUES[:2]), noisy(1e-9))
    one, other = (judge(matched(difference), errors) for _ in range(2))
    assert one.figures == other.figures
    assert one.allowed == other.allowed
