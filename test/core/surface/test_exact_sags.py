"""Heights against arithmetic of fifty digits and of fractions, and what no turn or size changes."""

from __future__ import annotations

from decimal import Decimal, getcontext, localcontext
from fractions import Fraction

import numpy as np
import pytest

from omsm_ros.core.surface.aspheres import Asphere, Biconic, Sphere, Toroid
from omsm_ros.core.surface.nominal import OffAxisParaboloid, QBfs, QCon, XYPolynomial, XYTerm

RNG = np.random.default_rng(7)
X, Y = RNG.uniform(-8e-3, 8e-3, (2, 60))
EPS = float(np.finfo(np.float64).eps)


def conic_sag(x: float, y: float, radius: float, k: float) -> Decimal:
    """The root of ``(1 + k) z² − 2 R z + s = 0`` that passes through the vertex, or ``s/2R``."""
    big, s = Decimal(radius), Decimal(x) ** 2 + Decimal(y) ** 2
    bend = 1 + Decimal(k)
    if bend == 0:
        return s / (2 * big)
    root = (big * big - bend * s).sqrt()
    return (big - root.copy_sign(big)) / bend


@pytest.fixture(autouse=True)
def _fifty_digits():
    with localcontext():
        getcontext().prec = 50
        yield


@pytest.mark.parametrize(
    ("radius", "k"),
    [
        (9e-3, -3.0),
        (9e-3, -1.0),
        (9e-3, 0.0),
        (-0.02, -0.25),
        (0.5, 0.0),
        (-30.0, -3.0),
        (1e5, 0.0),
    ],
)
def test_a_conic_is_known_to_its_last_digits_at_any_radius(radius, k):
    inside = 0.99 * radius**2 > X**2 + Y**2
    found = Asphere(radius, k).height(X, Y)
    exact = [float(conic_sag(x, y, radius, k)) for x, y in zip(X[inside], Y[inside], strict=True)]
    # Near its equator a sphere is so steep that the rounding of s moves it by more.
    np.testing.assert_allclose(found[inside], exact, rtol=(8 if abs(radius) > 0.01 else 200) * EPS)


@pytest.mark.parametrize("radius", [9e-3, -0.02, 0.5, -30.0, 1e5])
def test_a_sphere_is_the_conic_of_constant_zero(radius):
    inside = 0.9 * radius**2 > X**2 + Y**2
    exact = [float(conic_sag(x, y, radius, 0.0)) for x, y in zip(X[inside], Y[inside], strict=True)]
    np.testing.assert_allclose(Sphere(radius).height(X[inside], Y[inside]), exact, rtol=50 * EPS)


def test_a_shallow_conic_is_its_series():
    """``s/2R + (1+k) s²/8R³ + (1+k)² s³/16R⁵ + 5 (1+k)³ s⁴/128R⁷``; the next has no digit."""
    radius, k, s = 2.0, 0.7, X**2 + Y**2
    series = s / (2 * radius) * (
        1
        + (1 + k) * s / (4 * radius**2)
        + (1 + k) ** 2 * s**2 / (8 * radius**4)
        + 5 * (1 + k) ** 3 * s**3 / (64 * radius**6)
    )  # fmt: skip
    np.testing.assert_allclose(Asphere(radius, k).height(X, Y), series, rtol=1e-14)


def test_aspheric_terms_add_as_fractions_do():
    even, odd = (0.375, -1.5e3, 2.5e7, 4e11), (2e-3, -3.25, 1e4)
    found = Asphere(even_terms=even, odd_terms=odd).height(X, np.zeros_like(X))
    for x, z in zip(X, found, strict=True):
        r = abs(Fraction(float(x)))
        terms = [Fraction(a) * r ** (2 * i + 2) for i, a in enumerate(even)]
        terms += [Fraction(a) * r ** (2 * i + 1) for i, a in enumerate(odd)]
        size = float(sum(abs(t) for t in terms))
        assert z == pytest.approx(float(sum(terms)), abs=20 * EPS * size)


def test_an_xy_polynomial_adds_as_fractions_do():
    # A file may hold 0.0 for a power.
    terms = (XYTerm(5, 0.0, 1e-6), XYTerm(0, 1, -2e-5), XYTerm(3, 4, 7e-6), XYTerm(3, 4, 1e-6))
    found = XYPolynomial(0.004, terms).height(X, Y)
    for x, y, z in zip(X, Y, found, strict=True):
        u, v = (Fraction(float(value)) / Fraction(0.004) for value in (x, y))
        exact = [Fraction(t.value) * u**t.x * v ** int(t.y) for t in terms]
        size = float(sum(abs(t) for t in exact))
        assert z == pytest.approx(float(sum(exact)), abs=40 * EPS * size)


@pytest.mark.parametrize(("f", "d"), [(25.4e-3, 50.8e-3), (0.3, -0.05), (2.0, 0.0)])
def test_an_off_axis_paraboloid_is_the_small_root_of_its_quadratic(f, d):
    """``a w² − b w + c = 0`` of the docstring, solved in fifty digits."""
    found = OffAxisParaboloid(f, d).height(X, Y)
    focal, m = Decimal(f), Decimal(d) / (2 * Decimal(f))
    q2 = 1 + m * m
    for x, y, w in zip(X, Y, found, strict=True):
        u, v = Decimal(float(x)), Decimal(float(y))
        a, b = m * m / q2, 2 * m * u / q2 + 4 * focal * q2.sqrt()
        c = u * u / q2 + v * v
        exact = c / b if a == 0 else (b - (b * b - 4 * a * c).sqrt()) / (2 * a)
        assert w == pytest.approx(float(exact), rel=20 * EPS)


@pytest.mark.parametrize("kx", [-1.7, 0.4])
def test_a_saddle_is_exact_to_rounding_where_its_bends_cancel(kx):
    cx, cy, ky = 1 / 0.05, -1 / 0.08, -0.6
    found = Biconic(1 / cx, 1 / cy, kx, ky).height(X, Y)
    for x, y, z in zip(X, Y, found, strict=True):
        u, v = Decimal(float(x)), Decimal(float(y))
        rx, ry = Decimal(1 / cx), Decimal(1 / cy)
        curved = u * u / rx + v * v / ry
        p, q = (1 + Decimal(kx)) / rx**2, (1 + Decimal(ky)) / ry**2
        exact = curved / (1 + (1 - p * u * u - q * v * v).sqrt())
        size = float(u * u / rx + v * v / abs(ry))
        assert z == pytest.approx(float(exact), abs=4 * EPS * size)


# Turned, mirrored, enlarged.

SHAPES = [
    Asphere(0.03, -0.7, (0.3, 2e3), (1e-4, 5.0)),
    Asphere(-0.05, 1.5),
    Sphere(0.02),
    QBfs(0.012, (1e-6, -2e-6, 3e-6, 1e-6), 0.05),
    QCon(0.012, (2e-6, -1e-6), -0.06, -1.4),
]


@pytest.mark.parametrize("surface", SHAPES, ids=lambda s: type(s).__name__)
@pytest.mark.parametrize("angle", [0.4, -np.pi / 2])
def test_a_shape_of_revolution_does_not_know_how_it_is_turned(surface, angle):
    c, s = np.cos(angle), np.sin(angle)
    u, v = c * X - s * Y, s * X + c * Y
    np.testing.assert_allclose(surface.height(u, v), surface.height(X, Y), rtol=1e-12)
    slope_x, slope_y = surface.gradient(X, Y)
    turned = surface.gradient(u, v)
    np.testing.assert_allclose(turned[0], c * slope_x - s * slope_y, atol=1e-13)
    np.testing.assert_allclose(turned[1], s * slope_x + c * slope_y, atol=1e-13)


def mirrored(surface):
    """The same shape with each of its lengths negative."""
    if isinstance(surface, Asphere):
        even, odd = (tuple(-a for a in t) for t in (surface.even_terms, surface.odd_terms))
        return Asphere(-surface.radius, surface.conic_constant, even, odd)
    if isinstance(surface, Sphere):
        return Sphere(-surface.radius)
    sizes = tuple(-a for a in surface.coefficients)
    if isinstance(surface, QBfs):
        return QBfs(surface.aperture_radius, sizes, -surface.radius)
    return QCon(surface.aperture_radius, sizes, -surface.radius, surface.conic_constant)


@pytest.mark.parametrize("surface", SHAPES, ids=lambda s: type(s).__name__)
def test_the_mould_of_a_shape_is_the_shape_upside_down(surface):
    other = mirrored(surface)
    np.testing.assert_array_equal(other.height(X, Y), -surface.height(X, Y))
    for one, two in zip(other.gradient(X, Y), surface.gradient(X, Y), strict=True):
        np.testing.assert_array_equal(one, -two)


def test_enlarged_twice_all_is_twice_as_high_and_as_steep_as_before():
    """Lengths by two, terms of r^p by 2^(1 − p): powers of two, so that nothing is rounded."""
    small = Asphere(0.03, -0.7, (0.3, 2e3), (1e-4, 5.0))
    large = Asphere(0.06, -0.7, (0.3 / 2, 2e3 / 8), (1e-4, 5.0 / 4))
    np.testing.assert_array_equal(large.height(2 * X, 2 * Y), 2 * small.height(X, Y))
    for one, two in zip(large.gradient(2 * X, 2 * Y), small.gradient(X, Y), strict=True):
        np.testing.assert_array_equal(one, two)
    toroid, biconic = Toroid(0.05, -0.02, 0.3), Biconic(0.05, -0.02, 0.3, -4.0)
    np.testing.assert_array_equal(
        Toroid(0.1, -0.04, 0.3).height(2 * X, 2 * Y), 2 * toroid.height(X, Y)
    )
    np.testing.assert_array_equal(
        Biconic(0.1, -0.04, 0.3, -4.0).height(2 * X, 2 * Y), 2 * biconic.height(X, Y)
    )


@pytest.mark.parametrize("surface", [Toroid(0.05, -0.02, 0.3), Biconic(0.05, -0.02, 0.3, -4.0)])
def test_a_shape_of_two_planes_is_its_own_mirror_image_in_both(surface):
    z = surface.height(X, Y)
    for u, v in ((-X, Y), (X, -Y), (-X, -Y)):
        np.testing.assert_array_equal(surface.height(u, v), z)
    slope_x, slope_y = surface.gradient(X, Y)
    np.testing.assert_array_equal(surface.gradient(-X, Y)[0], -slope_x)
    np.testing.assert_array_equal(surface.gradient(-X, Y)[1], slope_y)
    np.testing.assert_array_equal(surface.gradient(X, -Y)[1], -slope_y)


@pytest.mark.parametrize(
    ("rx", "ry", "k"), [(0.1, 0.03, -2.0), (-0.05, 0.02, 0.5), (0.04, None, 0)]
)
def test_a_toroid_stays_on_itself_when_it_is_turned_about_its_axis(rx, ry, k):
    """Its profile, swung by φ about the line parallel to y at the height R_x."""
    y = np.linspace(-6e-3, 6e-3, 25)
    profile = np.zeros_like(y) if ry is None else Asphere(ry, k).height(y, 0 * y)
    for turn in (-0.1, 0.05, 0.15):
        arm = rx - profile
        x, z = arm * np.sin(turn), rx - arm * np.cos(turn)
        np.testing.assert_allclose(Toroid(rx, ry, k).height(x, y), z, atol=5e-17)


def test_a_toroid_of_equal_radii_is_a_sphere_and_of_one_a_cylinder():
    np.testing.assert_allclose(
        Toroid(0.03, 0.03).height(X, Y), Sphere(0.03).height(X, Y), rtol=1e-13
    )
    cylinder = Toroid(-0.03)
    np.testing.assert_array_equal(cylinder.height(X, Y), cylinder.height(X, 0 * Y))
    np.testing.assert_allclose(cylinder.height(X, Y), Sphere(-0.03).height(X, 0 * Y), rtol=1e-13)
    assert not np.any(cylinder.gradient(X, Y)[1])


def test_a_biconic_without_radii_is_flat_and_with_one_a_trough():
    assert not np.any(Biconic().height(X, Y))
    trough = Biconic(radius_y=0.04, conic_y=-0.3)
    np.testing.assert_allclose(
        trough.height(X, Y), Asphere(0.04, -0.3).height(0 * X, Y), rtol=1e-14
    )
    assert not np.any(trough.gradient(X, Y)[0])


def test_the_conic_of_a_biconic_without_its_radius_says_nothing():
    np.testing.assert_array_equal(
        Biconic(0.05, None, -0.5, 8.0).height(X, Y), Biconic(0.05, None, -0.5).height(X, Y)
    )


# Where they end.


@pytest.mark.parametrize("k", [0.0, 3.0])
def test_an_ellipsoid_ends_at_its_widest(k):
    """At ``r = R / √(1 + k)``, whichever way it is bent."""
    end = 0.02 / np.sqrt(1 + k)
    x = np.array([0.999, 1.001]) * end
    for surface in (Asphere(0.02, k), Asphere(-0.02, k), Biconic(0.02, 0.02, k, k)):
        assert np.isfinite(surface.height(x, 0 * x)).tolist() == [True, False]
        assert [bool(np.isfinite(g)) for g in surface.gradient(x, 0 * x)[0]] == [True, False]


def test_a_toroid_ends_where_its_tube_and_where_its_profile_does():
    tube = Toroid(0.05, 0.01)
    assert np.isfinite(tube.height(np.zeros(2), np.array([0.0099, 0.0101]))).tolist() == [
        True,
        False,
    ]
    # At y = 6 mm the profile is 2 mm high, and the circle that is left has 48 mm.
    x = np.array([0.0479, 0.0481])
    assert np.isfinite(tube.height(x, np.full(2, 6e-3))).tolist() == [True, False]


def test_q_surfaces_end_with_their_sphere_or_conic():
    r = np.array([0.0199, 0.0201])
    assert np.isfinite(QBfs(0.03, (1e-6,), 0.02).height(r, 0 * r)).tolist() == [True, False]
    assert np.isfinite(QCon(0.03, (1e-6,), 0.02).height(r, 0 * r)).tolist() == [True, False]
    assert np.all(np.isfinite(QCon(0.03, (1e-6,), 0.02, -1.0).height(r, 0 * r)))


@pytest.mark.parametrize(
    "surface",
    [
        *SHAPES,
        Toroid(0.05, -0.02),
        Biconic(0.05, -0.02),
        XYPolynomial(0.01, (XYTerm(1, 2, 1e-6),)),
        XYPolynomial(0.01, ()),
        OffAxisParaboloid(0.1, 0.02),
    ],
    ids=lambda s: type(s).__name__,
)
def test_rows_and_columns_give_the_map_that_each_place_by_itself_gives(surface):
    x, y = X[:4, np.newaxis], Y[np.newaxis, :5]
    table = surface.height(x, y)
    assert table.shape == (4, 5)
    slopes = [np.broadcast_to(s, (4, 5)) for s in surface.gradient(x, y)]
    for i in range(4):
        for j in range(5):
            here = X[i : i + 1], Y[j : j + 1]
            assert table[i, j] == pytest.approx(float(surface.height(*here)[0]), rel=1e-14)
            for whole, one in zip(slopes, surface.gradient(*here), strict=True):
                assert whole[i, j] == pytest.approx(float(one[0]), rel=1e-13, abs=1e-18)
