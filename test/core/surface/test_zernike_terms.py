"""Against factorials, quadrature, published lists and differences."""

from math import factorial

import numpy as np
import pytest

from omsm_ros.core.surface.zernike_terms import (
    ansi,
    first_terms,
    fringe,
    noll,
    rms_of,
    terms_up_to,
    zernike_slopes,
    zernike_values,
)

RNG = np.random.default_rng(1)
RADIUS, ANGLE = np.sqrt(RNG.uniform(0, 1, 300)), RNG.uniform(-np.pi, np.pi, 300)
X, Y = RADIUS * np.cos(ANGLE), RADIUS * np.sin(ANGLE)


def by_factorials(n, m, radius, angle):
    radial = sum(
        (-1) ** k
        * factorial(n - k)
        / (factorial(k) * factorial((n + abs(m)) // 2 - k) * factorial((n - abs(m)) // 2 - k))
        * radius ** (n - 2 * k)
        for k in range((n - abs(m)) // 2 + 1)
    )
    return radial * (np.cos(m * angle) if m >= 0 else np.sin(-m * angle))


def test_every_term_is_the_sum_of_factorials():
    terms = terms_up_to(10)
    expected = [by_factorials(n, m, RADIUS, ANGLE) for n, m in terms]
    np.testing.assert_allclose(zernike_values(X, Y, terms), expected, atol=1e-12)


def test_terms_are_orthogonal_and_of_the_stated_rms():
    """Gauss–Legendre over ρ², equal steps over θ: exact for these polynomials."""
    nodes, weights = np.polynomial.legendre.leggauss(20)
    angle = np.arange(40) * 2 * np.pi / 40
    radius = np.repeat(np.sqrt((nodes + 1) / 2), 40)
    weight = np.repeat(weights / 2, 40) / 40
    terms = terms_up_to(8)
    values = zernike_values(
        radius * np.cos(np.tile(angle, 20)), radius * np.sin(np.tile(angle, 20)), terms
    )
    gram = (values * weight) @ values.T
    np.testing.assert_allclose(gram, np.diag([rms_of(t) ** 2 for t in terms]), atol=1e-14)


def test_slopes_are_those_of_the_values():
    terms, step = first_terms(37), 1e-6
    along_x, along_y = zernike_slopes(X, Y, terms)
    rates = (
        zernike_values(X + dx, Y + dy, terms) - zernike_values(X - dx, Y - dy, terms)
        for dx, dy in ((step, 0), (0, step))
    )
    for found, rate in zip((along_x, along_y), rates, strict=True):
        np.testing.assert_allclose(found, rate / (2 * step), atol=5e-8)


@pytest.mark.parametrize(
    ("numbering", "first", "published"),
    [
        # Noll 1976, table I.
        (noll, 1, [(0, 0), (1, 1), (1, -1), (2, 0), (2, -2), (2, 2), (3, -1), (3, 1), (3, -3),
                   (3, 3), (4, 0), (4, 2), (4, -2), (4, 4), (4, -4)]),
        # Wyant and Creath 1992, table III, counted from one.
        (fringe, 1, [(0, 0), (1, 1), (1, -1), (2, 0), (2, 2), (2, -2), (3, 1), (3, -1), (4, 0),
                     (3, 3), (3, -3), (4, 2), (4, -2), (5, 1), (5, -1), (6, 0)]),
        # ANSI Z80.28, annex B.
        (ansi, 0, [(0, 0), (1, -1), (1, 1), (2, -2), (2, 0), (2, 2), (3, -3), (3, -1), (3, 1),
                   (3, 3), (4, -4)]),
    ],
)  # fmt: skip
def test_numbers_are_the_published_ones(numbering, first, published):
    assert [numbering(first + k) for k in range(len(published))] == published


def test_the_37th_fringe_term_is_the_symmetric_one_of_order_twelve():
    assert fringe(37) == (12, 0)
    assert len(set(first_terms(37))) == 37
