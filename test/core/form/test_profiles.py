"""Profiles and optical terms of maps that are known in closed form."""

from dataclasses import replace

import numpy as np
import pytest

from omsm_ros.core.form.analyse import ZERNIKES, optical_terms
from omsm_ros.core.form.deviation_map import DeviationMap
from omsm_ros.core.form.part_figures import FORM, SmoothTerms
from omsm_ros.core.form.texture import profiles
from omsm_ros.core.form.zernike_fit import fit_zernikes
from omsm_ros.core.surface.aperture import Aperture
from omsm_ros.core.surface.zernike_terms import ZernikeIndex, first_terms, zernike_values

DISC = Aperture(10e-3, 1e-3, -2e-3)


def disc_map(sizes, noise=0.0, effects=(), points=60_000):
    rng = np.random.default_rng(4)
    r, angle = np.sqrt(rng.uniform(0, 1, points)), rng.uniform(-np.pi, np.pi, points)
    u, v = r * np.cos(angle), r * np.sin(angle)

    def shape(terms):
        values = zernike_values(u, v, list(terms))
        return np.array(list(terms.values())) @ values

    return DeviationMap(
        x=DISC.x + DISC.radius * u, y=DISC.y + DISC.radius * v, area=np.ones(points),
        deviation=shape(sizes) + noise * rng.normal(size=points),
        effects=np.array([shape(e) for e in effects]).reshape(len(effects), points), noise=noise,
    )  # fmt: skip


def test_a_scan_of_few_turns_has_a_radial_profile_too():
    """Forty turns: rings of a fiftieth of the radius are not seen all around, wider ones are."""
    r, angle = np.linspace(1, 0.01, 40_000), np.linspace(0, 80 * np.pi, 40_000)
    x, y = DISC.radius * r * np.cos(angle), DISC.radius * r * np.sin(angle)
    map_ = DeviationMap(x=DISC.x + x, y=DISC.y + y, deviation=1e-8 * r**2, area=r,
                        effects=np.empty((0, len(r))), noise=1e-10)  # fmt: skip
    curve = profiles(map_, DISC)["radius"]
    assert len(curve.position) > 20
    expected = 1e-8 * (curve.position / DISC.radius) ** 2
    assert np.max(np.abs(curve.value - expected)) < 1e-10


def test_profiles_run_where_they_say():
    """Astigmatism is ρ² along x, −ρ² along y, nothing at 45°, and cos 2θ around."""
    found = profiles(disc_map({ZernikeIndex(2, 2): 1e-8}, noise=1e-10), DISC)
    for name, sign in (("x", 1), ("y", -1), ("diagonal", 0)):
        curve = found[name]
        expected = sign * 1e-8 * (curve.position / DISC.radius) ** 2
        off = (curve.value - expected)[3:-3]
        assert np.max(np.abs(off)) < 6e-10
    around = found["angle"]
    shape = np.cos(2 * around.position)
    size = float(around.value @ shape / (shape @ shape))
    assert size == pytest.approx(1e-8 * (1 - (2 / 3) ** 4) / 2 / (1 - (2 / 3) ** 2), rel=0.02)
    assert np.max(np.abs(found["radius"].value)) < 1e-9


def test_what_is_unknown_of_a_profile_is_noise_and_effects():
    map_ = disc_map({ZernikeIndex(2, 0): 1e-8}, noise=1e-9, effects=({ZernikeIndex(1, 1): 3e-9},))
    curve = profiles(map_, DISC)["x"]
    rim = np.abs(curve.position) > 0.9 * DISC.radius
    assert np.mean(curve.uncertainty[rim]) == pytest.approx(3e-9 * 0.95, rel=0.05)
    middle = np.abs(curve.position) < 0.05 * DISC.radius
    assert np.all(curve.uncertainty[middle] < 8e-10)


def test_terms_of_the_standard_are_those_of_known_zernikes():
    """Power 20 nm at the rim, spherical 10, astigmatism 5: ISO 10110-5, 3.3 to 3.5."""
    sizes = {ZernikeIndex(2, 0): 20e-9, ZernikeIndex(4, 0): 10e-9, ZernikeIndex(2, 2): 5e-9}
    map_ = disc_map(sizes, effects=({ZernikeIndex(2, 0): 1e-9},))
    fit = fit_zernikes(map_.x, map_.y, map_.deviation, first_terms(37), DISC, effects=map_.effects)
    found = optical_terms(SmoothTerms.of(map_, DISC, ZERNIKES), fit)
    # Random points are no even disc: their best sphere is 40.002 nm.
    u, v = DISC.scaled(map_.x, map_.y)
    sphere = np.stack([np.ones_like(u), u, v, u**2 + v**2], axis=1)
    power = np.linalg.lstsq(sphere, map_.deviation, rcond=None)[0][3]
    assert found["iso10110_A"].value == pytest.approx(power, rel=1e-6)
    assert power == pytest.approx(40e-9, rel=1e-4)
    assert found["iso10110_A"].uncertainty == pytest.approx(2e-9, rel=1e-3)
    irregular = np.hypot(10e-9 / np.sqrt(5), 5e-9 / np.sqrt(6))
    assert found["iso10110_RMSi"].value == pytest.approx(irregular, rel=0.01)
    assert found["iso10110_RMSa"].value == pytest.approx(5e-9 / np.sqrt(6), rel=0.01)
    # 10 nm of spherical aberration is 6ρ⁴ − 6ρ² + 1: from −5 to 10 nm.
    assert found["iso10110_C"].value == pytest.approx(15e-9, rel=0.02)
    assert found["iso10110_C"].uncertainty < 1e-12
    total = np.hypot(irregular, 20e-9 / np.sqrt(3))
    assert found["iso10110_RMSt"].value == pytest.approx(total, rel=0.01)
    # Power is no irregularity, nor is what may be wrong with it.
    assert found["iso10110_RMSi"].uncertainty < 1e-13


@pytest.mark.soak
def test_the_symmetric_irregularity_is_as_uncertain_as_its_scatter():
    """Noise shakes its few terms: as much as twenty scans scatter, not nothing."""
    still = disc_map({ZernikeIndex(4, 0): 10e-9, ZernikeIndex(2, 2): 5e-9}, points=4_000)
    rng, values = np.random.default_rng(12), []
    for _ in range(20):
        noisy = still.deviation + rng.normal(0, 5e-9, len(still))
        map_ = replace(still, deviation=noisy, noise=5e-9)
        fit = fit_zernikes(map_.x, map_.y, map_.deviation, first_terms(9), DISC)
        figure = optical_terms(SmoothTerms.of(map_, DISC, ZERNIKES), fit)["iso10110_C"]
        values.append(figure.value)
    assert figure.uncertainty == pytest.approx(np.std(values), rel=0.5)


@pytest.mark.parametrize("kind", ["strip", "ring"])
def test_the_sagitta_of_a_part_of_a_disc_is_that_of_the_sphere_that_fits_it(kind):
    """Terms that share what a sphere takes, on a strip, are no figure of the part."""
    rng, n = np.random.default_rng(9), 20_000
    u, v = rng.uniform(-1, 1, n), rng.uniform(-0.06, 0.06, n)
    if kind == "ring":
        r, angle = np.sqrt(rng.uniform(0.5, 1, n)), rng.uniform(-np.pi, np.pi, n)
        u, v = r * np.cos(angle), r * np.sin(angle)
    form = 8e-9 * u**2 + 4e-9 * np.cos(5 * u) + 3e-9 * (u**2 + v**2) ** 2 + 3e-9 * u * v
    map_ = DeviationMap(
        x=DISC.x + DISC.radius * u, y=DISC.y + DISC.radius * v, area=np.ones(n),
        deviation=form + rng.normal(0, 1e-10, n), effects=np.empty((0, n)), noise=1e-10,
    )  # fmt: skip
    sphere = np.stack([np.ones(n), u, v, u**2 + v**2], axis=1)
    expected = abs(np.linalg.lstsq(sphere, map_.deviation, rcond=None)[0][3])
    fit = fit_zernikes(map_.x, map_.y, map_.deviation, first_terms(37), DISC)
    found = optical_terms(SmoothTerms.of(map_, DISC, ZERNIKES), fit)["iso10110_A"]
    assert found.value == pytest.approx(expected, rel=1e-6)
    assert found.uncertainty < 0.5e-9


def test_form_goes_and_ripple_stays():
    sizes = {ZernikeIndex(2, 2): 50e-9, ZernikeIndex(3, 1): 15e-9, ZernikeIndex(12, 0): 4e-9}
    rest = SmoothTerms.of(disc_map(sizes), DISC, FORM).without(FORM)
    assert np.std(rest.deviation) == pytest.approx(4e-9 / np.sqrt(13), rel=0.03)
