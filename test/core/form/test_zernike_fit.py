"""Against plain least squares of the whole design matrix, and against chance."""

import numpy as np
import pytest
from soaked import always

from omsm_ros.core.form.zernike_fit import RimStrip, fit_zernikes
from omsm_ros.core.surface.aperture import Aperture
from omsm_ros.core.surface.area_weights import area_weights
from omsm_ros.core.surface.zernike_terms import (
    ZernikeIndex,
    first_terms,
    terms_up_to,
    zernike_values,
)
from omsm_ros.errors import DataError

DISC, TERMS = Aperture(12.7e-3, 1e-4, -2e-4), first_terms(37)


def scattered(points=20_000, seed=1):
    rng = np.random.default_rng(seed)
    r, angle = 12.7e-3 * rng.uniform(0, 1, points), rng.uniform(0, 2 * np.pi, points)
    return r * np.cos(angle) + DISC.x, r * np.sin(angle) + DISC.y, rng


@pytest.mark.parametrize("weighted", [False, True])
def test_it_is_the_least_squares_of_the_whole_matrix(weighted):
    """To a billionth of the extent, with a form that the terms cannot describe."""
    x, y, rng = scattered()
    value = 1e-7 * np.sin(2000 * x) * np.cos(900 * y) + rng.normal(0, 1e-8, len(x))
    weights = rng.uniform(0.1, 3, len(x)) if weighted else None
    found = fit_zernikes(x, y, value, TERMS, DISC, weights=weights)
    design = zernike_values(*DISC.scaled(x, y), TERMS).T
    root = np.ones(len(x)) if weights is None else np.sqrt(weights)
    expected = np.linalg.lstsq(design * root[:, np.newaxis], value * root, rcond=None)[0]
    np.testing.assert_allclose(found.coefficients, expected, atol=1e-9 * np.ptp(value), rtol=0)
    np.testing.assert_allclose(found.height(x, y), design @ expected, atol=1e-9 * np.ptp(value))
    assert found.left_out == ()


def test_the_uncertainty_is_the_scatter():
    """White noise: 24 draws tell a standard deviation to 14 %, 37 terms together to 2.4 %."""
    off = []
    for seed in range(24):
        x, y, rng = scattered(10_000, seed)
        found = fit_zernikes(x, y, rng.normal(0, 1e-8, len(x)), TERMS, DISC)
        off.append(found.coefficients / found.uncertainty)
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(1.0, abs=0.08)


def test_on_a_spiral_the_stated_variance_is_not_too_small():
    """For white noise the covariance is known. The fit follows the few groups at the rim; without
    the jackknife the result would be 7 % too small, 17 % for symmetric terms."""
    radius, angle = np.linspace(12.7e-3, 0, 20_000), np.linspace(0, 200 * np.pi, 20_000)
    x, y = radius * np.cos(angle) + DISC.x, radius * np.sin(angle) + DISC.y
    columns = zernike_values(*DISC.scaled(x, y), TERMS)
    inverse = np.linalg.inv((columns * radius) @ columns.T)
    true = np.diag(inverse @ ((columns * radius**2) @ columns.T) @ inverse)
    stated = [
        np.diag(fit_zernikes(x, y, noise, TERMS, DISC, weights=radius).covariance) / true
        for noise in np.random.default_rng(4).normal(0, 1, (12, len(x)))
    ]
    assert 0.98 < np.mean(stated) < 1.3
    symmetric = [k for k, term in enumerate(TERMS) if term.m == 0]
    assert np.mean(np.array(stated)[:, symmetric]) > 0.93


def test_the_height_at_the_rim_of_a_spiral_scatters_as_stated():
    """Half of the noise there is that of two turns, which fourth differences hardly contain.

    White noise on terms up to order 12, where the variance is known.
    """
    terms, turns = terms_up_to(12), 60
    radius, angle = np.linspace(12.7e-3, 0, 12_000), np.linspace(0, 2 * np.pi * turns, 12_000)
    x, y = radius * np.cos(angle) + DISC.x, radius * np.sin(angle) + DISC.y
    columns = zernike_values(*DISC.scaled(x, y), terms)
    inverse = np.linalg.inv((columns * radius) @ columns.T)
    true = inverse @ ((columns * radius**2) @ columns.T) @ inverse
    around = np.exp(2j * np.pi * np.arange(100) / 100)
    for share in (1.0, 0.95, 0.7):
        there = zernike_values(share * around.real, share * around.imag, terms)
        stated = [
            np.mean(
                there * (fit_zernikes(x, y, noise, terms, DISC, weights=radius).covariance @ there)
            )
            for noise in np.random.default_rng(4).normal(0, 1, (4, len(x)))
        ]
        assert 0.8 < np.mean(stated) / np.mean(there * (true @ there)) < 1.5


def test_errors_that_hang_together_count_as_such():
    """Noise that lasts for 40 points averages out over a fortieth as many."""
    off = []
    for seed in range(15):
        x, y, rng = scattered(40_000, seed)
        # Points in the order of a path, for it is time in which errors hang together.
        order = np.argsort(np.hypot(x, y))
        slow = np.convolve(rng.normal(0, 1e-8, len(x) + 39), np.ones(40) / np.sqrt(40), "valid")
        found = fit_zernikes(x[order], y[order], slow, TERMS[:9], DISC)
        off.append(found.coefficients / found.uncertainty)
    assert 0.7 < np.sqrt(np.mean(np.square(off))) < 1.5


def spiral(turns, points):
    """Return a spiral of even turns from the rim to the centre, with the area of each point."""
    radius, angle = np.linspace(12.7e-3, 0, points), np.linspace(0, 2 * np.pi * turns, points)
    return radius * np.cos(angle) + DISC.x, radius * np.sin(angle) + DISC.y, radius


def rings(x, y, pitch, phase):
    return 40e-9 * np.cos(2 * np.pi / pitch * np.hypot(x - DISC.x, y - DISC.y) + phase)


def test_form_that_the_path_resolves_is_no_scatter():
    """Rings of 80 nm that 37 terms cannot follow, sixteen turns each, under 10 nm of noise.

    Taken for scatter, they would state fifteen times as much.
    """
    x, y, area = spiral(127, 30_000)
    noise = np.random.default_rng(2).normal(0, 1e-8, len(x))
    of_noise = fit_zernikes(x, y, noise, TERMS, DISC, weights=area)
    both = fit_zernikes(x, y, noise + rings(x, y, 1.6e-3, 0.0), TERMS, DISC, weights=area)
    ratio = both.uncertainty / of_noise.uncertainty
    assert np.sqrt(np.mean(np.square(ratio))) < 1.3
    assert np.max(ratio) < 2.5


def test_form_that_the_path_does_not_resolve_is_uncertainty():
    """Rings of less than two turns each: the terms are off by up to their height, and say so.

    The truth is of the whole disc, as 60 000 points of it tell.
    """
    x, y, area = spiral(12.7, 8_000)
    k = np.arange(60_000) + 0.5
    far, angle = DISC.radius * np.sqrt(k / len(k)), np.pi * (3 - np.sqrt(5)) * k
    everywhere = far * np.cos(angle) + DISC.x, far * np.sin(angle) + DISC.y
    off, stated = [], []
    random = np.random.default_rng(3)
    for pitch, phase in zip(np.linspace(1.3e-3, 1.9e-3, 16), random.uniform(0, 6, 16), strict=True):
        true = fit_zernikes(*everywhere, rings(*everywhere, pitch, phase), TERMS, DISC)
        found = fit_zernikes(x, y, rings(x, y, pitch, phase), TERMS, DISC, weights=area)
        off.append((found.coefficients - true.coefficients)[:15])
        stated.append(found.uncertainty[:15])
    assert np.sqrt(np.mean(np.square(off))) > 2e-9
    held = np.abs(off) <= 2 * np.array(stated)
    assert np.mean(held) > 0.9
    assert np.sqrt(np.mean(np.square(off)) / np.mean(np.square(stated))) == pytest.approx(0.8, 0.5)


def raster(lines, per_line):
    """Return the points of a raster within the disc, three times as dense along its lines."""
    x, y = np.meshgrid(np.linspace(-1, 1, per_line), np.linspace(-1, 1, lines))
    inside = np.hypot(x, y) <= 1
    return DISC.radius * x[inside] + DISC.x, DISC.radius * y[inside] + DISC.y


@pytest.mark.parametrize(
    ("outline", "sizes"),
    always(
        ("ellipse", [12.7e-3, 10.7e-3]),
        of=[("disc", [12.7e-3]), ("ellipse", [12.7e-3, 10.7e-3]), ("rectangle", [9e-3, 8e-3])],
    ),
)
def test_form_is_continued_from_the_last_tracks_to_the_outline(outline, sizes):
    """Waves that no term describes, on 150 lines, against a million points."""
    rim = Aperture.of(outline, *sizes, DISC.x, DISC.y)

    def waves(u, v):
        return 1e-8 * np.cos(2 * np.pi / 1.7e-3 * (u + 0.4 * v))

    fine, off = np.array(raster(1500, 1500)), []
    fine = fine[:, rim.holds(*fine)]
    true = fit_zernikes(*fine, waves(*fine), TERMS, DISC)
    points = np.array(raster(150, 450))
    points = points[:, rim.holds(*points)]
    area = area_weights(*points, outline=rim)
    for known in (None, RimStrip.of(points, area, rim, DISC.radius / 75, TERMS, DISC)):
        fit = fit_zernikes(*points, waves(*points), TERMS, DISC, weights=area, strip=known)
        off.append(fit.coefficients - true.coefficients)
    rms = np.sqrt(np.mean(np.square(off), axis=1))
    assert rms[1] < rms[0] / 2


def test_terms_of_parts_with_rings_hold_the_truth():
    """Rings of 10 nm on spirals, with noise of 1 nm; without the rim 80 % of the terms do."""
    x, y, area = spiral(80, 40_000)
    rng, held = np.random.default_rng(8), []
    strip = RimStrip.of(np.stack([x, y]), area, DISC, DISC.radius / 80, TERMS, DISC)
    far, weight = np.polynomial.legendre.leggauss(400)
    far, weight = (far + 1) / 2, weight * (far + 1)
    along = zernike_values(far, np.zeros_like(far), TERMS)
    for pitch, phase in zip(
        rng.uniform(6, 15, 8) * DISC.radius / 80, rng.uniform(0, 6, 8), strict=True
    ):
        value = rings(x, y, pitch, phase) / 4 + rng.normal(0, 1e-9, len(x))
        fit = fit_zernikes(x, y, value, TERMS, DISC, weights=area, strip=strip)
        form = rings(far * DISC.radius + DISC.x, DISC.y, pitch, phase) / 4
        true = [
            (along[k] @ (weight * form)) / (along[k] ** 2 @ weight) if t.m == 0 else 0.0
            for k, t in enumerate(TERMS)
        ]
        held.append(np.abs(fit.coefficients - true) <= 2 * fit.uncertainty)
    assert np.mean(held) > 0.92


def test_terms_that_the_points_do_not_tell_apart_are_left_out():
    x, y, _ = scattered()
    strip = np.abs(y - DISC.y) < 2e-4
    found = fit_zernikes(x[strip], y[strip], 1e-3 * x[strip], TERMS, DISC)
    assert 0 < len(found.terms) < 37
    assert len(found.terms) + len(found.left_out) == 37
    np.testing.assert_allclose(found.height(x[strip], y[strip]), 1e-3 * x[strip], atol=1e-12)


def test_coefficients_of_effects_are_those_of_the_same_fit():
    x, y, rng = scattered(3000)
    value, effect = rng.normal(0, 1e-8, (2, len(x)))
    both = fit_zernikes(x, y, value, TERMS, DISC, effects=effect[np.newaxis])
    alone = fit_zernikes(x, y, effect, TERMS, DISC)
    np.testing.assert_allclose(both.effects[:, 0], alone.coefficients, rtol=1e-9)
    quiet = fit_zernikes(x, y, value, TERMS, DISC)
    more = both.uncertainty**2 - quiet.uncertainty**2
    np.testing.assert_allclose(more, alone.coefficients**2, rtol=1e-6, atol=1e-24)


def test_too_few_points_are_refused():
    with pytest.raises(DataError, match="50 points for 37 Zernike terms, expected 74"):
        fit_zernikes(*np.random.default_rng(0).uniform(-1e-3, 1e-3, (3, 50)), TERMS, DISC)


def test_sums_that_cancel_to_rounding_leave_the_scatter_of_points():
    """A wave across a strip, the same in each of its lines: tip of the lines has no scatter."""
    x, y = np.meshgrid(np.linspace(-1, 1, 19) * 3e-6, np.linspace(-1, 1, 19) * 3e-3)
    x, y = x.ravel(), y.ravel()
    deviation = 1e-6 * np.sin(2 * np.pi * x / 3.7e-6)
    terms = (ZernikeIndex(0, 0), ZernikeIndex(1, -1), ZernikeIndex(1, 1))
    with np.errstate(all="raise"):
        found = fit_zernikes(x, y, deviation, terms, Aperture(3e-3, 0.0, 0.0))
        assert np.all(np.isfinite(found.uncertainty))
    assert np.all(np.linalg.eigvalsh(found.covariance) >= -1e-30)
    assert np.all(found.uncertainty > 1e-9)


def test_terms_of_a_rolled_edge_hold_where_points_are_sparse_along_the_turns():
    """Steps of 140 turns of 12 000 points are seven times the distance of the turns."""

    def rolled(r):
        return -500e-9 * np.clip((r - 0.9) / 0.1, 0, None) ** 2

    disc, share = Aperture(25e-3), np.linspace(1, 0, 12_000)
    x, y = (disc.radius * share * f(280 * np.pi * share) for f in (np.cos, np.sin))
    area = area_weights(x, y, outline=disc)
    strip = RimStrip.of(np.stack([x, y]), area, disc, disc.radius / 140, TERMS, disc)
    found = fit_zernikes(x, y, rolled(share), TERMS, disc, weights=area, strip=strip)
    far = np.sqrt((np.arange(800) + 0.5) / 800)
    angle = 2 * np.pi * np.arange(64)[:, np.newaxis] / 64
    u, v = (disc.radius * (far * f(angle)).ravel() for f in (np.cos, np.sin))
    true = fit_zernikes(u, v, rolled(np.hypot(u, v) / disc.radius), TERMS, disc).coefficients
    assert np.all(np.abs(found.coefficients - true) <= 3 * found.uncertainty)
