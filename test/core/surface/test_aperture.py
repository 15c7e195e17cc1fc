"""Apertures: areas in closed form, the smallest disc, what of them no point covers."""

import numpy as np
import pytest

from omsm_ros.core.form.analyse import analyse_form
from omsm_ros.core.registration.placement import PointBatch
from omsm_ros.core.surface.aperture import (
    Aperture,
    BoundedSurface,
    best_covered,
    disc_of,
    smallest_disc,
)
from omsm_ros.core.surface.nominal import Flat
from omsm_ros.errors import SurfaceError

RNG = np.random.default_rng(3)
AREAS = {
    "12e-3": np.pi * 144,
    "disc:12e-3,1e-3,-2e-3": np.pi * 144,
    "annulus:12e-3,5e-3": np.pi * (144 - 25),
    "ellipse:12e-3,17e-3,1e-3,0": np.pi * 12 * 17,
    "rectangle:10e-3,5e-3,0,3e-3": 200.0,
    "polygon:0,0,10e-3,0,0,10e-3": 50.0,
    "polygon:0,0,10e-3,0,10e-3,10e-3,5e-3,2e-3,0,10e-3": 60.0,
}


@pytest.mark.parametrize(
    ("text", "area", "square"),
    [
        ("2", np.pi * 4, np.pi * 2**4 / 4),
        ("annulus:2,1", np.pi * 3, np.pi * (2**4 - 1) / 4),
        ("ellipse:2,3", np.pi * 6, np.pi * 2**3 * 3 / 4),
        ("rectangle:2,3", 24.0, 32.0),
    ],
)
def test_sums_over_nodes_are_integrals(text, area, square):
    """∫ dA and ∫ x² dA in closed form, with the middle elsewhere; odd powers cancel."""
    outline = Aperture.parse(text if text == "2" else f"{text},0.5,-1")
    x, y, share = outline.nodes()
    u, v = x - outline.x, y - outline.y
    assert share.sum() == pytest.approx(area, rel=1e-12)
    assert share @ u**2 == pytest.approx(square, rel=1e-12)
    assert share @ (u**7 * v**8) == pytest.approx(0.0, abs=1e-9)
    assert np.all(outline.holds(x, y))


def test_sums_over_nodes_of_a_polygon_are_nearly_integrals():
    """∫ dA, ∫ x dA and ∫ x² dA of a right triangle in closed form."""
    triangle = Aperture.parse("polygon:0,0,1,0,0,1")
    x, y, share = triangle.nodes()
    np.testing.assert_allclose(
        share @ np.stack([x**0, x, x**2]).T, [1 / 2, 1 / 6, 1 / 12], rtol=1e-3
    )
    assert np.all(triangle.holds(x, y))


def test_an_aperture_holds_its_rim_even_in_float32():
    disc = Aperture(5e-3, 1e-3, -2e-3)
    angle = np.linspace(0, 2 * np.pi, 50)
    rim = np.stack([1e-3 + 5e-3 * np.cos(angle), -2e-3 + 5e-3 * np.sin(angle)])
    assert np.all(disc.holds(*rim))
    assert np.all(disc.holds(*rim.astype(np.float32).astype(float)))
    centre = np.array([[1e-3], [-2e-3]])
    assert not np.any(disc.holds(*(centre + 1.001 * (rim - centre))))
    u, v = disc.scaled(*rim)
    np.testing.assert_allclose(np.hypot(u, v), np.ones(50))


@pytest.mark.parametrize("text", AREAS)
def test_the_area_is_that_of_the_outline(text):
    made = Aperture.parse(text)
    u, v = RNG.uniform(-1, 1, (2, 200_000)) * made.radius
    inside = made.holds(made.x + u, made.y + v)
    area = float(np.mean(inside)) * 4 * made.radius**2 * 1e6
    assert area == pytest.approx(AREAS[text], rel=0.02)
    assert np.all(np.hypot(u, v)[inside] <= made.radius * (1 + 1e-6))
    x, y = made.rim()
    shoelace = abs(float(x[:-1] @ y[1:] - x[1:] @ y[:-1])) / 2 * 1e6
    assert shoelace == pytest.approx(AREAS[text], rel=1e-3)


@pytest.mark.parametrize(
    "text", ["", "x", "-1e-3", "annulus:1e-3,2e-3", "ellipse:1e-3", "polygon:0,0,1,1", "square:1,1",
             "1e-3,0", "nan", "disc:1e-3,0,0,0", "polygon:0,0,1,1,1"],
)  # fmt: skip
def test_another_text_is_no_aperture(text):
    with pytest.raises(SurfaceError):
        Aperture.parse(text)


def test_the_smallest_disc_rests_on_its_farthest_points():
    for count in (2, 3, 10, 300):
        x, y = RNG.normal(size=(2, count)) + 5
        (u, v), radius = smallest_disc(x, y)
        away = np.hypot(x - u, y - v)
        assert np.all(away <= radius * (1 + 1e-9))
        # It is the smallest if its middle lies among the points that it rests on.
        angle = np.sort(np.arctan2(y - v, x - u)[away > radius * (1 - 1e-7)])
        gaps = np.diff(np.append(angle, angle[0] + 2 * np.pi))
        assert gaps.max() <= np.pi * (1 + 1e-6)


def test_the_disc_of_points_is_about_the_origin_if_that_is_near_their_middle():
    x, y = RNG.uniform(-1e-2, 1e-2, (2, 5000))
    kept = np.hypot(x, y) < 1e-2
    x, y = x[kept], y[kept]
    assert disc_of(x, y) == Aperture(float(np.hypot(x, y).max()))
    moved = disc_of(x + 0.03, y + 0.04)
    assert (moved.x, moved.y) == pytest.approx((0.03, 0.04), abs=1e-4)
    assert moved.radius == pytest.approx(1e-2, rel=0.01)
    assert disc_of(np.zeros(3), np.zeros(3)).radius == 1.0


@pytest.mark.parametrize("width", [0.0, 0.2e-3, 0.5e-3, 2e-3])
def test_a_ring_without_points_is_uncovered(width):
    """Turns 20 µm apart; the ring begins at 6 mm of 10 mm."""
    radius = 10e-3 * np.arange(1, 500) / 500
    radius = radius[(radius < 6e-3) | (radius >= 6e-3 + width)]
    r = np.repeat(radius, 800)
    angle = np.tile(np.linspace(0, 2 * np.pi, 800, endpoint=False), len(radius))
    found = best_covered(r * np.cos(angle), r * np.sin(angle), 2e-5, Aperture(10e-3), free=False)
    expected = ((6e-3 + width) ** 2 - 6e-3**2) / 10e-3**2
    assert found[0] == pytest.approx(expected, rel=0.15, abs=0.002)


@pytest.mark.parametrize(
    "text", ["annulus:10e-3,4e-3", "ellipse:10e-3,6e-3", "rectangle:10e-3,3e-3"]
)
def test_an_aperture_of_the_nominal_surface_counts(text):
    """Without it the disc about the points of an annulus is open in its middle."""
    made = Aperture.parse(text)
    x, y = RNG.uniform(-10e-3, 10e-3, (2, 5000))
    inside = made.holds(x, y)
    batch = PointBatch(x, y, RNG.normal(0, 1e-9, len(x)), np.empty((0, len(x))))
    part = analyse_form(BoundedSurface(Flat(), made), lambda: [batch], ("piston",))
    assert part.aperture == made
    assert part.uncovered < 0.01
    assert part.counts["used"] == np.sum(inside)
    assert (part.registration.disc.radius, part.registration.disc.outline) == (made.radius, "disc")
    share, around = best_covered(x[inside], y[inside], 0.0, Aperture(made.radius), free=True)
    assert share == pytest.approx(0.16 * (made.outline == "annulus"), abs=0.03)
    assert around.outline in (made.outline, "disc")


def test_a_disc_off_the_origin_ends_at_its_points():
    """A flat turned up by 200 nm at its rim, scanned on the axis, and three tracks off."""
    r, c = np.linspace(0, 5e-3, 4000), np.linspace(0, 100 * np.pi, 4000)
    height = 200e-9 * np.clip(r / 5e-3 - 0.8, 0, None) ** 2 / 0.04
    found = []
    for shift in (0.0, 0.3e-3):
        batch = PointBatch(r * np.cos(c) + shift, r * np.sin(c), height, np.empty((0, len(r))))
        found.append(analyse_form(Flat(), lambda batch=batch: [batch], ("piston", "tip", "tilt")))
    # The end of the outermost turn lies a track within the rim.
    assert (found[1].aperture.x, found[1].aperture.radius) == pytest.approx(
        (0.3e-3, 5e-3), abs=5e-5
    )
    within = np.linspace(0, 1, 10_001)
    true = 200e-9 * np.clip(within - 0.8, 0, None) ** 2 / 0.04
    mean, square = (2 * np.trapezoid(within * true**power, within) for power in (1, 2))
    for form in found:
        for name, value in (("rms", np.sqrt(square - mean**2)), ("peak_to_valley", 200e-9)):
            assert abs(form.deviation[name].value - value) <= 2 * form.deviation[name].uncertainty
