"""Figures, fits and profiles of a map: by hand, in closed form, and by what changes nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from omsm_ros.core.form.analyse import ZERNIKES, optical_terms
from omsm_ros.core.form.deviation_map import (
    DeviationMap,
    GridCells,
    UncertainValue,
    neighbour_noise,
)
from omsm_ros.core.form.part_extents import extents_of_parts
from omsm_ros.core.form.part_figures import (
    FORM,
    POWER,
    SYMMETRIC,
    TILT,
    SmoothTerms,
    best_fit,
    rms_of_part,
)
from omsm_ros.core.form.texture import UncertainCurve, edge_roll_off, profiles
from omsm_ros.core.form.zernike_fit import fit_zernikes
from omsm_ros.core.surface.aperture import Aperture
from omsm_ros.core.surface.zernike_terms import ZernikeIndex, terms_up_to, zernike_values
from omsm_ros.errors import DataError

RNG = np.random.default_rng(12)
RADIUS = 10e-3
SHARE, TURN = np.sqrt(RNG.random(3000)), RNG.uniform(-np.pi, np.pi, 3000)
X, Y = RADIUS * SHARE * np.cos(TURN), RADIUS * SHARE * np.sin(TURN)
AREA = RNG.uniform(0.5, 2.0, 3000)
DISC = Aperture(RADIUS)


def map_of(deviation, noise=0.0, effects=(), x=X, y=Y, area=AREA):
    rows = np.array(effects).reshape(len(effects), len(x))
    return DeviationMap(x=x, y=y, deviation=deviation, area=area, effects=rows, noise=noise)


def term(n, m, size=50e-9, x=X, y=Y):
    return size * zernike_values(x / RADIUS, y / RADIUS, [ZernikeIndex(n, m)])[0]


# Figures.


def test_a_map_of_every_kth_point_keeps_what_belongs_to_each():
    whole = replace(map_of(X, 1e-9, [Y, X * Y]), bounds=np.array([1]))
    few = whole.every(1000)
    assert len(few) == 1000
    np.testing.assert_array_equal(few.x, X[::3])
    np.testing.assert_array_equal(few.area, AREA[::3])
    np.testing.assert_array_equal(few.effects, [Y[::3], (X * Y)[::3]])
    assert few.noise == 1e-9
    assert few.bounds.tolist() == [1]
    # No more than were asked for, whatever is left over.
    assert len(whole.every(1001)) == 1000
    assert len(whole.every(2999)) == 1500
    assert len(whole.every(3000)) == 3000


def test_neighbour_noise_is_independent_of_order_and_unit():
    values = term(3, 1) + RNG.normal(0, 2e-9, 3000)
    found = neighbour_noise(X, Y, values)
    assert found == pytest.approx(2e-9, rel=0.2)
    order = RNG.permutation(3000)
    assert neighbour_noise(X[order], Y[order], values[order]) == pytest.approx(found)
    assert neighbour_noise(1e3 * X, 1e3 * Y, 5 * values) == pytest.approx(5 * found)
    assert neighbour_noise(np.zeros(9), np.zeros(9), np.zeros(9)) == 0.0


def test_a_figure_is_written_as_value_and_uncertainty():
    assert UncertainValue(1.0, None).entry() == {"value": 1.0, "uncertainty": None}
    curve = UncertainCurve(np.arange(2.0), np.ones(2), np.zeros(2))
    assert curve.entry() == {
        "position": [0.0, 1.0], "value": [1.0, 1.0], "uncertainty": [0.0, 0.0],
    }  # fmt: skip


@pytest.mark.parametrize("scale", [1e-3, 50.0])
def test_figures_of_the_part_scale_with_heights_and_all_their_errors(scale):
    error, effect = term(2, 2) + RNG.normal(0, 3e-9, 3000), term(3, 1, 4e-9)
    usual, other = (
        map_of(error, 3e-9, [effect]),
        map_of(scale * error, scale * 3e-9, [scale * effect]),
    )
    for one, two in zip(
        (rms_of_part(usual), *extents_of_parts([usual], DISC)[0][:2]),
        (rms_of_part(other), *extents_of_parts([other], DISC)[0][:2]),
        strict=True,
    ):
        assert two.value == pytest.approx(scale * one.value, rel=1e-9, abs=0)
        assert two.uncertainty == pytest.approx(scale * one.uncertainty, rel=1e-6, abs=0)


def test_the_rms_of_the_part_is_without_noise_and_without_the_square_of_errors():
    """``Σ w d² − Σ w e² − σ²`` by hand."""
    error, effect = term(2, 2), term(3, 1, 20e-9)
    found = rms_of_part(map_of(error, 10e-9, [effect])).value
    share = AREA / AREA.sum()
    expected = np.sqrt(share @ error**2 - share @ effect**2 - 1e-16)
    assert found == pytest.approx(expected)
    assert rms_of_part(map_of(0.1 * error, 50e-9)).value == 0.0


# Removal.


@pytest.mark.parametrize(
    ("terms", "gone"),
    [
        (TILT, [(0, 0), (1, 1), (1, -1)]),
        (POWER, [(0, 0), (1, 1), (2, 0)]),
        (FORM, [(0, 0), (2, 2), (3, -3), (4, 0), (4, 4)]),
        (SYMMETRIC, [(0, 0), (1, -1), (2, 0), (4, 0), (8, 0), (12, 0)]),
    ],
)
def test_what_is_removed_goes_and_once_is_enough(terms, gone):
    bare = term(5, 5) + term(7, -3)
    spoiled = map_of(bare + sum(term(n, m, 1e-6) for n, m in gone), effects=[term(*gone[-1])])
    once = SmoothTerms.of(spoiled, DISC, terms).without(terms)
    plain = SmoothTerms.of(map_of(bare), DISC, terms).without(terms)
    np.testing.assert_allclose(once.deviation, plain.deviation, atol=1e-17)
    np.testing.assert_allclose(once.effects, np.zeros((1, 3000)), atol=1e-18)
    again = SmoothTerms.of(once, DISC, terms).without(terms)
    np.testing.assert_allclose(again.deviation, once.deviation, atol=1e-18)


def test_columns_in_any_unit_and_any_mixture_take_the_same_away():
    columns = zernike_values(X / RADIUS, Y / RADIUS, terms_up_to(2))

    def found(moves):
        map_ = map_of(term(4, 2) + term(1, 1), 0.0, moves)
        return best_fit(replace(map_, moves=np.arange(6)))

    usual, mixed = found(columns), found(RNG.normal(size=(6, 6)) @ columns)
    np.testing.assert_allclose(mixed.deviation, usual.deviation, atol=1e-18)
    np.testing.assert_array_equal(mixed.area, AREA)


# Zernike terms.


def test_terms_of_a_map_do_not_know_its_order_and_portions():
    terms = terms_up_to(4)
    values = term(2, -2) + RNG.normal(0, 1e-9, 3000)
    usual = fit_zernikes(X, Y, values, terms, DISC, weights=AREA)
    order = RNG.permutation(3000)
    mixed = fit_zernikes(X[order], Y[order], values[order], terms, DISC, weights=AREA[order])
    np.testing.assert_allclose(mixed.coefficients, usual.coefficients, atol=1e-20)
    thrice = [np.tile(v, 4) for v in (X, Y, values, AREA)]
    many = fit_zernikes(*thrice[:3], terms, DISC, weights=thrice[3])
    np.testing.assert_allclose(many.coefficients, usual.coefficients, atol=1e-20)


def test_a_part_that_is_turned_has_its_terms_turned():
    turn = 0.6
    x, y = np.cos(turn) * X - np.sin(turn) * Y, np.sin(turn) * X + np.cos(turn) * Y
    found = fit_zernikes(x, y, term(2, 2), terms_up_to(3), DISC)
    size = dict(zip(found.terms, found.coefficients, strict=True))
    assert size[2, 2] == pytest.approx(50e-9 * np.cos(2 * turn))
    assert size[2, -2] == pytest.approx(50e-9 * np.sin(2 * turn))


def test_on_a_disc_elsewhere_the_terms_are_the_same():
    there = Aperture(RADIUS, 5e-3, -2e-3)
    one = fit_zernikes(X, Y, term(3, 1), terms_up_to(3), DISC)
    other = fit_zernikes(X + 5e-3, Y - 2e-3, term(3, 1), terms_up_to(3), there)
    np.testing.assert_allclose(other.coefficients, one.coefficients, atol=1e-20)
    np.testing.assert_allclose(other.height(X + 5e-3, Y - 2e-3), term(3, 1), atol=1e-18)


def test_the_uncertainty_of_a_term_holds_scatter_and_every_effect():
    effects = np.stack([term(2, 2, 3e-9), term(2, 2, 4e-9), term(3, 3, 9e-9)])
    clean = fit_zernikes(X, Y, term(4, 0), terms_up_to(4), DISC, effects=effects)
    spread = dict(zip(clean.terms, clean.uncertainty, strict=True))
    assert spread[2, 2] == pytest.approx(5e-9, rel=1e-6)
    assert spread[3, 3] == pytest.approx(9e-9, rel=1e-6)
    assert spread[4, 0] < 1e-15


def test_few_points_are_refused_by_the_number_that_is_needed():
    with pytest.raises(DataError, match="29 points for 15 Zernike terms, expected 30 or more"):
        fit_zernikes(X[:29], Y[:29], X[:29], terms_up_to(4), DISC)
    fit_zernikes(X[:30], Y[:30], X[:30], terms_up_to(4), DISC)
    with pytest.raises(DataError, match="7 points for 1 Zernike terms, expected 8"):
        fit_zernikes(X[:7], Y[:7], X[:7], terms_up_to(0), DISC)


def test_optical_terms_do_not_know_where_the_part_sits_and_scale_with_it():
    error = term(2, 0) + term(2, 2, 20e-9) + term(4, 0, 30e-9)
    few = slice(None, None, 3)

    def found(values):
        map_ = map_of(values[few], x=X[few], y=Y[few], area=AREA[few])
        fit = fit_zernikes(map_.x, map_.y, map_.deviation, terms_up_to(6), DISC, weights=map_.area)
        return {
            n: f.value for n, f in optical_terms(SmoothTerms.of(map_, DISC, ZERNIKES), fit).items()
        }

    usual = found(error)
    moved = found(7 * (error + term(0, 0, 3e-6) + term(1, 1, 2e-6)))
    for name, value in usual.items():
        assert moved[name] == pytest.approx(7 * value, rel=1e-6), name
    assert usual["iso10110_RMSt"] > usual["iso10110_RMSi"] > usual["iso10110_RMSa"]
    assert usual["iso10110_A"] == pytest.approx(100e-9, rel=0.1)


# Cells, profiles and means.


def test_cells_hold_the_mean_of_their_points_one_by_one():
    map_ = map_of(RNG.normal(size=3000), noise=0.3, effects=[X])
    cells = GridCells.of(map_)
    found = {}
    for x, y, d, e in zip(X - X.min(), Y - Y.min(), map_.deviation, X, strict=True):
        found.setdefault((int(y / cells.pitch), int(x / cells.pitch)), []).append((d, e))
    assert int(cells.present.sum()) == len(found)
    for (row, column), points in found.items():
        mean = np.mean(points, axis=0)
        assert cells.mean[row, column] == pytest.approx(mean[0])
        assert cells.effects[0, row, column] == pytest.approx(mean[1])
        assert cells.noise[row, column] == pytest.approx(0.3 / np.sqrt(len(points)))
    middles = cells.x - X.min()
    np.testing.assert_allclose(middles, cells.pitch * (np.arange(len(middles)) + 0.5))


def test_profiles_of_terms_are_their_sections():
    """Coma along x is odd, along y nothing; around it is a cosine."""
    found = profiles(map_of(term(3, 1), area=np.ones(3000)), DISC)
    u = found["x"].position / RADIUS
    np.testing.assert_allclose(found["x"].value, 50e-9 * (3 * u**3 - 2 * u), atol=3e-9)
    np.testing.assert_allclose(found["y"].value, 0 * found["y"].position, atol=3e-9)
    v = found["diagonal"].position / RADIUS
    expected = 50e-9 * (3 * v**3 - 2 * v) * np.sqrt(0.5)
    np.testing.assert_allclose(found["diagonal"].value, expected, atol=3e-9)
    around = found["angle"]
    assert np.all(np.diff(around.position) > 0)
    assert np.sign(around.value[np.argmin(np.abs(around.position))]) == 1


def test_a_profile_is_uncertain_by_its_noise_over_the_root_of_its_points_and_its_effects():
    map_ = map_of(0 * X, noise=8e-9, effects=[np.full(3000, 3e-9)])
    found = profiles(map_, DISC)["angle"]
    outer = np.hypot(X, Y) >= 2 / 3 * RADIUS
    place = np.floor((np.arctan2(Y, X)[outer] + np.pi) / np.radians(2.0)).astype(int) % 180
    points = np.bincount(place, minlength=180)
    expected = np.hypot(8e-9 / np.sqrt(points[points > 0]), 3e-9)
    np.testing.assert_allclose(found.uncertainty, expected)


def test_the_profile_at_the_edge_shows_its_roll_off():
    """A rim that falls by 80 nm over the outer 4 % of the radius."""
    x, y = RNG.uniform(-RADIUS, RADIUS, (2, 60_000))
    inside = np.hypot(x, y) < RADIUS
    x, y = x[inside], y[inside]
    fall = np.maximum(np.hypot(x, y) / RADIUS - 0.96, 0.0) / 0.04
    edge = profiles(map_of(-80e-9 * fall**2, x=x, y=y, area=np.ones(len(x))), DISC)["edge"]
    share = np.maximum(edge.position / RADIUS - 0.96, 0.0) / 0.04
    assert edge.position[0] > 0.89 * RADIUS
    np.testing.assert_allclose(edge.value, -80e-9 * share**2, atol=2e-9)
    assert edge.value[-1] < -60e-9


@pytest.mark.parametrize(
    "text", ["10e-3", "annulus:10e-3,3e-3", "ellipse:10e-3,7e-3", "rectangle:10e-3,6e-3,1e-3,0",
             "polygon:0,0,8e-3,0,8e-3,8e-3,0,8e-3"],
)  # fmt: skip
def test_the_roll_off_of_the_edge_is_what_the_rim_lacks_of_the_form_within(text):
    """80 nm over the outer 4 % with power and astigmatism, and an error of tilt and one of gain."""
    outline = Aperture.parse(text)
    x, y = (RNG.uniform(v.min(), v.max(), 80_000) for v in outline.rim())
    inside = outline.holds(x, y)
    x, y = x[inside], y[inside]
    size = outline.share_of_rim(x, y)
    fall = -80e-9 * (np.maximum(size - 0.96, 0.0) / 0.04) ** 2
    angle = np.arctan2(y - outline.y, x - outline.x)
    form = 60e-9 * size**2 + 30e-9 * size * np.cos(2 * angle)
    map_ = map_of(form + fall, x=x, y=y, area=np.ones(len(x)),
                  effects=np.stack([1e-9 * size * np.cos(angle), 0.1 * fall]))  # fmt: skip
    found = edge_roll_off(map_, outline)
    assert found.value == pytest.approx(-70e-9, abs=6e-9)
    assert found.uncertainty == pytest.approx(np.hypot(0.1 * found.value, map_.noise / 20), rel=0.2)
    assert edge_roll_off(map_.part(size < 0.8), outline).value is None
