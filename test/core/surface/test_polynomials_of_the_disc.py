"""Zernike's and Forbes' polynomials: what turning, quadrature, scipy and their rims say of them."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from scipy import special

from omsm_ros.core.surface.aspheres import Sphere, bfs_series, con_series, freeform_series
from omsm_ros.core.surface.nominal import (
    QBfs,
    QCon,
    QFreeform,
    QTerm,
    XYPolynomial,
    XYTerm,
    ZernikeSurface,
)
from omsm_ros.core.surface.zernike_terms import (
    NUMBERING,
    ZernikeIndex,
    first_terms,
    noll,
    rms_of,
    terms_up_to,
    zernike_slopes,
    zernike_values,
)
from omsm_ros.errors import SurfaceError

RNG = np.random.default_rng(11)
RADIUS, ANGLE = np.sqrt(RNG.uniform(0, 1, 150)), RNG.uniform(-np.pi, np.pi, 150)
X, Y = RADIUS * np.cos(ANGLE), RADIUS * np.sin(ANGLE)


def disc_rule(points):
    """Places and weights (n,) of a rule over the unit disc, exact to the degree 2 points − 1."""
    nodes, weights = np.polynomial.legendre.leggauss(points)
    around = 2 * np.pi * np.arange(2 * points) / (2 * points)
    radius, angle = np.meshgrid(np.sqrt((nodes + 1) / 2), around, indexing="ij")
    weight = np.repeat(weights / 2, 2 * points) / (2 * points)
    return (radius * np.cos(angle)).ravel(), (radius * np.sin(angle)).ravel(), weight


# Zernike.


@pytest.mark.parametrize("name", NUMBERING)
def test_no_number_names_a_term_twice_and_all_are_polynomials(name):
    terms = first_terms(37 if name == "fringe" else 400, name)
    assert len(set(terms)) == len(terms)
    for n, m in terms:
        assert abs(m) <= n
        assert (n - m) % 2 == 0


@pytest.mark.parametrize("name", ["noll", "ansi"])
def test_the_first_numbers_fill_the_orders_one_by_one(name):
    """(n + 1)(n + 2)/2 terms have all of the orders up to n, and no others."""
    for order in range(12):
        count = (order + 1) * (order + 2) // 2
        assert set(first_terms(count, name)) == set(terms_up_to(order))


def test_even_numbers_of_noll_are_cosines():
    """Noll 1976: "even j for the cosines", of symmetric terms there is one."""
    for j in range(1, 300):
        n, m = noll(j)
        assert m == 0 or (m > 0) == (j % 2 == 0)
        assert n == sum(1 for k in range(1, j) if k * (k + 1) // 2 < j)


def test_the_fringe_set_grows_by_n_plus_m():
    """Its squares end groups of equal (n + |m|)/2."""
    for j, (n, m) in enumerate(first_terms(36), 1):
        assert (n + abs(m)) // 2 == int(np.ceil(np.sqrt(j))) - 1


def test_terms_from_an_order_on_are_those_without_the_lower_ones():
    assert set(terms_up_to(6, 3)) == set(terms_up_to(6)) - set(terms_up_to(2))
    assert terms_up_to(0) == (ZernikeIndex(0, 0),)
    assert terms_up_to(2, 3) == ()


def test_at_the_rim_a_term_is_its_angular_part():
    terms = terms_up_to(14)
    values = zernike_values(np.cos(ANGLE), np.sin(ANGLE), terms)
    for (_, m), row in zip(terms, values, strict=True):
        expected = np.cos(m * ANGLE) if m >= 0 else np.sin(-m * ANGLE)
        np.testing.assert_allclose(row, expected, atol=1e-12)


def test_in_the_middle_only_the_symmetric_terms_are_and_they_alternate():
    terms = terms_up_to(16)
    zero = np.zeros(1)
    expected = [(-1.0) ** (n // 2) if m == 0 else 0.0 for n, m in terms]
    np.testing.assert_allclose(zernike_values(zero, zero, terms)[:, 0], expected, atol=1e-15)


@pytest.mark.parametrize("order", [20, 27, 60])
def test_high_orders_are_as_good_as_scipys_jacobi_polynomials(order):
    """No factorial, so no digit is lost where their sum would lose all."""
    terms = [t for t in terms_up_to(order, order - 1) if t.m >= 0]
    assert len(terms) == order + 1
    found = zernike_values(X, Y, terms)
    for (n, m), row in zip(terms, found, strict=True):
        jacobi = special.eval_jacobi((n - m) // 2, 0, m, 2 * RADIUS**2 - 1)
        np.testing.assert_allclose(row, RADIUS**m * jacobi * np.cos(m * ANGLE), atol=1e-11)


def test_the_last_fringe_term_is_right_in_fractions():
    """R_12^0 by its published whole numbers, exact at fractions of the radius."""
    whole = (924, -2772, 3150, -1680, 420, -42, 1)
    for share in (Fraction(1, 4), Fraction(1, 2), Fraction(7, 8)):
        exact = sum(c * share ** (12 - 2 * k) for k, c in enumerate(whole))
        found = zernike_values(np.array([float(share)]), np.zeros(1), [ZernikeIndex(12, 0)])
        assert found[0, 0] == pytest.approx(float(exact), abs=1e-13)


@pytest.mark.parametrize("turn", [0.3, -1.9, np.pi / 2])
def test_turning_the_disc_mixes_each_cosine_with_its_sine_alone(turn):
    c, s = np.cos(turn), np.sin(turn)
    terms = terms_up_to(9)
    turned = dict(zip(terms, zernike_values(c * X - s * Y, s * X + c * Y, terms), strict=True))
    here = dict(zip(terms, zernike_values(X, Y, terms), strict=True))
    for n, m in terms:
        if m < 0:
            continue
        cosine, sine = here[n, m], here.get((n, -m), 0 * X) if m else 0 * X
        expected = np.cos(m * turn) * cosine - np.sin(m * turn) * sine
        np.testing.assert_allclose(turned[n, m], expected, atol=1e-12)


def test_terms_come_in_the_order_and_as_often_as_they_are_asked_for():
    asked = [
        ZernikeIndex(4, 2),
        ZernikeIndex(0, 0),
        ZernikeIndex(3, -1),
        ZernikeIndex(4, 2),
        ZernikeIndex(2, 0),
    ]
    table = dict(zip(terms_up_to(4), zernike_values(X, Y, terms_up_to(4)), strict=True))
    np.testing.assert_allclose(zernike_values(X, Y, asked), [table[t] for t in asked], atol=1e-15)
    slopes = zernike_slopes(X, Y, asked)
    every = zernike_slopes(X, Y, terms_up_to(4))
    for found, whole in zip(slopes, every, strict=True):
        by_term = dict(zip(terms_up_to(4), whole, strict=True))
        np.testing.assert_allclose(found, [by_term[t] for t in asked], atol=1e-14)
    assert zernike_values(X, Y, []).shape == (0, 150)


def test_slopes_of_low_terms_are_their_polynomials():
    """2ρ² − 1, ρ² cos 2θ, ρ² sin 2θ and (3ρ³ − 2ρ) cos θ, differentiated by hand."""
    along_x, along_y = zernike_slopes(
        X, Y, [ZernikeIndex(2, 0), ZernikeIndex(2, 2), ZernikeIndex(2, -2), ZernikeIndex(3, 1)]
    )
    square = X**2 + Y**2
    np.testing.assert_allclose(
        along_x, [4 * X, 2 * X, 2 * Y, 3 * square + 6 * X**2 - 2], atol=1e-13
    )
    np.testing.assert_allclose(along_y, [4 * Y, -2 * Y, 2 * X, 6 * X * Y], atol=1e-13)


def test_the_mean_square_slope_of_the_outermost_terms_is_their_order():
    """r^n cos nθ is harmonic, so that the mean of |∇Z|² is ∮ Z ∂Z/∂r over π, which is n."""
    x, y, weight = disc_rule(16)
    terms = [t for t in terms_up_to(8) if t.n == abs(t.m) and t.n]
    assert len(terms) == 16
    along_x, along_y = zernike_slopes(x, y, terms)
    for (n, _), dx, dy in zip(terms, along_x, along_y, strict=True):
        assert (dx**2 + dy**2) @ weight == pytest.approx(n)


# Surfaces of them.


@pytest.mark.parametrize("indexing", NUMBERING)
def test_of_unit_rms_the_mean_square_over_the_disc_is_that_of_the_coefficients(indexing):
    sizes = RNG.normal(0, 1e-6, 20)
    x, y, weight = disc_rule(24)
    surface = ZernikeSurface(0.02, tuple(sizes), indexing, "rms")
    z = surface.height(0.02 * x, 0.02 * y)
    assert z**2 @ weight == pytest.approx(sizes @ sizes, rel=1e-6, abs=0)
    # Its mean is the piston, which each numbering has first.
    assert z @ weight == pytest.approx(sizes[0])


def test_one_term_has_one_shape_under_each_of_its_numbers():
    """Astigmatism ρ² cos 2θ is Noll's 6, the fifth of Fringe and 5 of ANSI, counted from none."""
    made = [
        ZernikeSurface(0.02, (*[0.0] * place, 3e-6), name).height(0.02 * X, 0.02 * Y)
        for name, place in (("noll", 5), ("fringe", 4), ("ansi", 5))
    ]
    for z in made:
        np.testing.assert_allclose(z, 3e-6 * RADIUS**2 * np.cos(2 * ANGLE), atol=1e-20)


def test_peak_and_rms_are_one_surface_in_two_units():
    sizes = RNG.normal(0, 1e-6, 15)
    shares = [rms_of(t) for t in first_terms(15, "noll")]
    one = ZernikeSurface(0.02, tuple(sizes), "noll", "peak")
    other = ZernikeSurface(0.02, tuple(sizes * shares), "noll", "rms")
    x, y = 0.02 * X, 0.02 * Y
    np.testing.assert_allclose(one.height(x, y), other.height(x, y), rtol=0, atol=1e-19)


def test_without_terms_a_surface_is_flat_wherever_one_looks():
    for surface in (ZernikeSurface(0.01, ()), ZernikeSurface(0.01, (0.0, 0.0))):
        assert surface.height(X[:, None], Y[None, :3]).shape == (150, 3)
        assert not np.any(surface.height(X, Y))
        assert not np.any(surface.gradient(X, Y))


def test_beyond_its_disc_a_zernike_surface_goes_on_as_its_polynomial():
    surface = ZernikeSurface(0.01, (0, 0, 0, 1e-6))
    u = np.array([1.5, 2.0])
    np.testing.assert_allclose(surface.height(0.01 * u, 0 * u), 1e-6 * (2 * u**2 - 1))


@pytest.mark.parametrize(("indexing", "most"), [("fringe", 37), ("noll", 400), ("ansi", 400)])
def test_more_terms_than_a_numbering_has_are_refused(indexing, most):
    ZernikeSurface(0.01, (0.0,) * most, indexing)
    with pytest.raises(SurfaceError, match=f"{most + 1}, expected {most} at most.*'{indexing}'"):
        ZernikeSurface(0.01, (0.0,) * (most + 1), indexing)


def test_a_coefficient_in_nanometres_is_refused_by_its_place():
    with pytest.raises(SurfaceError, match=r"coefficients\[2\] is 35.0 m"):
        ZernikeSurface(0.01, (0.0, 0.0, 35.0))


# Forbes.


def test_strong_aspheres_are_scipys_jacobi_polynomials():
    x = np.linspace(0, 1, 21)
    for m in range(15):
        value, rate = con_series([0.0] * m + [1.0], x)
        np.testing.assert_allclose(value, special.eval_jacobi(m, 0, 4, 2 * x - 1), atol=1e-11)
        # dP_m^(0,4)(t)/dt = (m + 5)/2 P_(m−1)^(1,5)(t)
        slope = (m + 5) * special.eval_jacobi(m - 1, 1, 5, 2 * x - 1) if m else 0 * x
        np.testing.assert_allclose(rate, slope, atol=1e-9)


@pytest.mark.parametrize("series", [bfs_series, con_series, lambda a, x: freeform_series(a, 3, x)])
def test_a_series_is_linear_in_its_coefficients_and_its_rate_is_its_derivative(series):
    x = np.linspace(0.05, 0.95, 19)
    one, other = RNG.normal(size=(2, 8))
    both, first, second = (series(a, x) for a in (2 * one - 3 * other, one, other))
    for k in range(2):
        np.testing.assert_allclose(both[k], 2 * first[k] - 3 * second[k], atol=1e-9)
    # A polynomial of degree seven through eight places, differentiated.
    nodes = np.polynomial.chebyshev.chebpts1(8) / 2 + 0.5
    through = np.polynomial.Polynomial.fit(nodes, series(one, nodes)[0], 7)
    np.testing.assert_allclose(first[0], through(x), rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(first[1], through.deriv()(x), rtol=1e-7, atol=1e-7)


def test_at_its_rim_a_mild_asphere_is_its_sphere_and_in_the_middle_too():
    surface = QBfs(0.01, (3e-6, -2e-6, 5e-6), 0.05)
    rim, zero = np.array([0.01]), np.zeros(1)
    assert surface.height(rim, zero) == pytest.approx(Sphere(0.05).height(rim, zero), rel=1e-14)
    assert surface.height(zero, zero) == 0


def test_at_its_rim_a_strong_asphere_departs_by_the_sum_of_its_coefficients():
    """Each P_m^(0,4) is one at one."""
    sizes = (3e-6, -2e-6, 5e-6, 1e-6)
    rim, zero = np.array([0.01]), np.zeros(1)
    found = QCon(0.01, sizes).height(rim, zero)
    assert found == pytest.approx(sum(sizes), rel=1e-12)


def test_in_the_middle_a_strong_asphere_departs_by_the_fourth_power():
    """Halved, the radius leaves a sixteenth: Q_con has no power that a conic has."""
    r = np.array([1e-4, 5e-5])
    z = QCon(0.01, (1e-6,)).height(r, 0 * r)
    assert z[0] / z[1] == pytest.approx(16)


@pytest.mark.parametrize("m", [1, 2, 5])
def test_a_freeform_turns_by_mixing_cosine_with_sine(m):
    turn = 0.7
    x, y = 0.009 * X, 0.009 * Y
    c, s = np.cos(turn), np.sin(turn)
    cosine, sine = (QFreeform(0.01, (QTerm(2, k, 1e-6),), 0.05) for k in (m, -m))
    base = QFreeform(0.01, (), 0.05).height(x, y)
    turned = cosine.height(c * x - s * y, s * x + c * y) - base
    mixed = np.cos(m * turn) * (cosine.height(x, y) - base)
    mixed -= np.sin(m * turn) * (sine.height(x, y) - base)
    np.testing.assert_allclose(turned, mixed, atol=1e-18)


def test_a_freeform_without_terms_is_its_sphere_and_equal_terms_add_up():
    x, y = 0.009 * X, 0.009 * Y
    np.testing.assert_allclose(
        QFreeform(0.01, (), -0.06).height(x, y), Sphere(-0.06).height(x, y), rtol=1e-14
    )
    apart = QFreeform(0.01, (QTerm(1, 2, 1e-6), QTerm(1, 2, 2e-6), QTerm(1, 0, -1e-6)))
    together = QFreeform(0.01, (QTerm(1, 0, -1e-6), QTerm(1, 2, 3e-6)))
    np.testing.assert_allclose(apart.height(x, y), together.height(x, y), atol=1e-20)
    assert not np.any(QFreeform(0.01, ()).height(x, y))


def test_the_deviation_is_along_the_normal():
    """At the rim of u = 1 a term of m = 2, n = 0 rises over a sphere by its flat height / cos."""
    angle = np.linspace(0, 2 * np.pi, 9)
    x, y = 0.01 * np.cos(angle), 0.01 * np.sin(angle)
    flat = QFreeform(0.01, (QTerm(0, 2, 1e-6),)).height(x, y)
    curved = QFreeform(0.01, (QTerm(0, 2, 1e-6),), 0.02).height(x, y) - Sphere(0.02).height(x, y)
    np.testing.assert_allclose(curved, flat / np.sqrt(1 - 0.25), atol=1e-17)
    bfs, sphere = (QBfs(0.01, a, 0.02).height(x / 2, y / 2) for a in ((1e-6, 2e-6), ()))
    flat = QBfs(0.01, (1e-6, 2e-6)).height(x / 2, y / 2)
    np.testing.assert_allclose(bfs - sphere, flat / np.sqrt(1 - 1 / 16), atol=1e-17)


def test_slopes_of_an_xy_polynomial_are_its_powers_lowered_by_one():
    surface = XYPolynomial(0.01, (XYTerm(3, 2, 4e-6), XYTerm(0, 1, 1e-6)))
    u, v = X, Y
    along_x, along_y = surface.gradient(0.01 * u, 0.01 * v)
    np.testing.assert_allclose(along_x, 4e-4 * 3 * u**2 * v**2, atol=1e-17)
    np.testing.assert_allclose(along_y, 4e-4 * 2 * u**3 * v + 1e-4, atol=1e-17)
