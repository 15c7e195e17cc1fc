"""Each shape against its geometry; each slope against differences of its height."""

import numpy as np
import pytest
from scipy import optimize

from omsm_ros.core.surface.aspheres import Asphere, Biconic, Sphere, Toroid
from omsm_ros.core.surface.height_grid import gradient_of
from omsm_ros.core.surface.nominal import (
    PAPER_MIRROR,
    Flat,
    OffAxisParaboloid,
    QBfs,
    QCon,
    QFreeform,
    QTerm,
    XYPolynomial,
    XYTerm,
    ZernikeSurface,
)
from omsm_ros.core.surface.posed import OffAxisSection, Pose, PosedSurface, Sum
from omsm_ros.errors import SurfaceError

RNG = np.random.default_rng(0)
X, Y = RNG.uniform(-8e-3, 8e-3, (2, 400))
POSE = Pose(x=5e-4, y=-3e-4, piston=1e-4, tip=0.01, tilt=-0.02, clocking=0.3)
SHAPES = {
    "flat": Flat(1e-3),
    "sphere": Sphere(-0.05),
    "paraboloid": PAPER_MIRROR,
    "asphere": Asphere(0.06, -0.7, (0.3, 2e3, 1e6), (1e-4, 5.0)),
    "flat asphere": Asphere(even_terms=(1.0, 1e3)),
    "toroid": Toroid(-0.1, 0.05, -0.5),
    "cylinder": Toroid(0.1),
    "biconic": Biconic(0.1, -0.2, -2.0, 0.3),
    "xy": XYPolynomial(0.01, (XYTerm(2, 1, 1e-5), XYTerm(0, 3, -2e-6), XYTerm(0, 0, 1e-3))),
    "zernike": ZernikeSurface(0.01, tuple(RNG.normal(0, 1e-6, 37)), "noll", "rms"),
    "q_bfs": QBfs(0.01, (1e-6, 2e-6, -1e-6, 3e-6), 0.05),
    "q_con": QCon(0.01, (1e-6, 2e-6, -1e-6), 0.05, -1.2),
    "q_freeform": QFreeform(
        0.01, (QTerm(0, 2, 2e-6), QTerm(3, -1, 1e-6), QTerm(2, 0, 5e-7), QTerm(4, 7, -1e-6)), 0.05
    ),
    "section": OffAxisSection(Asphere(0.08, -0.6, (0.0, 50.0)), 0.03, 0.7),
    "posed": PosedSurface(PAPER_MIRROR, POSE),
    "sum": Sum((Sphere(0.1), XYPolynomial(0.01, (XYTerm(1, 2, 1e-6),)))),
}


@pytest.mark.parametrize("name", SHAPES)
def test_slopes_are_those_of_the_height(name):
    """Differences of the fourth order: their own error is 1e-11 at this step."""
    surface, step = SHAPES[name], 1e-5

    def rate(dx, dy):
        near, far = (
            surface.height(X + k * dx, Y + k * dy) - surface.height(X - k * dx, Y - k * dy)
            for k in (1, 2)
        )
        return (8 * near - far) / (12 * step)

    along_x, along_y = surface.gradient(X, Y)
    np.testing.assert_allclose(along_x, rate(step, 0), atol=2e-11)
    np.testing.assert_allclose(along_y, rate(0, step), atol=2e-11)


def test_a_shape_that_knows_its_height_alone_has_slopes_too():
    class Bare:
        def height(self, x, y):
            return PAPER_MIRROR.height(x, y)

    for one, other in zip(gradient_of(Bare(), X, Y), PAPER_MIRROR.gradient(X, Y), strict=True):
        np.testing.assert_allclose(one, other, atol=2e-10)


@pytest.mark.parametrize("k", [-2.5, -1.0, 0.0, 0.8])
def test_a_conic_obeys_the_equation_of_conics(k):
    z = Asphere(-0.07, k).height(X, Y)
    np.testing.assert_allclose(X**2 + Y**2, 2 * -0.07 * z - (1 + k) * z**2, rtol=1e-12)


def test_aspheric_terms_are_powers_of_the_radius():
    r = np.hypot(X, Y)
    z = Asphere(even_terms=(2.0, 3e2, 4e4), odd_terms=(1e-3, 7.0)).height(X, Y)
    expected = 2.0 * r**2 + 3e2 * r**4 + 4e4 * r**6 + 1e-3 * r + 7.0 * r**3
    np.testing.assert_allclose(z, expected, rtol=1e-13)


def test_the_tip_of_a_cone_and_the_centre_of_all_have_finite_slopes():
    zero = np.zeros(1)
    assert Asphere(0.1, odd_terms=(1e-3,)).gradient(zero, zero) == (0.0, 0.0)


@pytest.mark.parametrize(("rx", "ry"), [(0.1, 0.05), (-0.1, 0.05), (0.1, -0.05), (-0.1, -0.05)])
def test_a_point_of_a_toroid_is_on_its_tube(rx, ry):
    """The tube's centre line is a circle of radius R_x − R_y about the axis."""
    z = Toroid(rx, ry).height(X, Y)
    from_axis = np.hypot(X, z - rx)
    np.testing.assert_allclose(np.hypot(from_axis - abs(rx - ry), Y), abs(ry), rtol=1e-12)


def test_equal_conics_make_a_biconic_of_revolution():
    one, other = Biconic(0.1, 0.1, -0.4, -0.4), Asphere(0.1, -0.4)
    np.testing.assert_allclose(one.height(X, Y), other.height(X, Y), rtol=1e-14)
    lines = (np.stack([X, 0 * X]), np.stack([0 * X, X]))
    for (x, y), (radius, conic) in zip(lines, ((0.1, -2.0), (-0.2, 0.3)), strict=True):
        z = SHAPES["biconic"].height(x, y)
        np.testing.assert_allclose(z, Asphere(radius, conic).height(x, y), rtol=1e-13)


def test_beyond_its_end_a_surface_has_no_height():
    far = np.array([0.2])
    for surface in (Sphere(0.1), Asphere(0.1), Toroid(0.1, 0.05), QBfs(0.01, (1e-6,), 0.1)):
        assert np.isnan(surface.height(far, 0 * far))
    assert np.isfinite(Asphere(0.1, -1.0).height(far, 0 * far))


# Sections and poses.


def test_a_section_of_a_paraboloid_is_the_closed_form():
    closed, general = OffAxisParaboloid(0.04, 0.03), OffAxisSection(Asphere(0.08, -1.0), 0.03)
    np.testing.assert_allclose(general.height(X, Y), closed.height(X, Y), atol=1e-17)


@pytest.mark.parametrize("azimuth", [0.0, 0.7, -2.0])
def test_a_section_touches_its_plane_at_the_centre_and_lies_on_the_parent(azimuth):
    parent = Toroid(0.2, 0.1)
    piece = OffAxisSection(parent, 0.02, azimuth)
    zero = np.zeros(1)
    assert abs(piece.height(zero, zero)) < 1e-17
    assert np.all(np.abs(piece.gradient(zero, zero)) < 1e-13)
    # Back into the parent's frame by its own tangents, taken by differences.
    centre = 0.02 * np.array([np.cos(azimuth), np.sin(azimuth)])
    slope = np.array([s[0] for s in gradient_of(parent, centre[:1], centre[1:])])
    normal = np.array([-slope[0], -slope[1], 1]) / np.sqrt(1 + slope @ slope)
    away = np.array([*centre, 0.02 * slope @ centre / 0.02])
    along = away / np.linalg.norm(away)
    frame = np.stack([along, np.cross(normal, along), normal], axis=1)
    middle = np.array([*centre, parent.height(centre[:1], centre[1:])[0]])
    p = middle[:, np.newaxis] + frame @ np.stack([X, Y, piece.height(X, Y)])
    np.testing.assert_allclose(p[2], parent.height(p[0], p[1]), atol=1e-16)


def test_a_posed_surface_is_met_where_a_ray_meets_it():
    """Each height against the root of a bracketed search along the machine's z."""
    turn, moved = POSE.rotation, PosedSurface(PAPER_MIRROR, POSE)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-15)

    def above(z, x, y):
        p = turn.T @ (np.array([x, y, z]) - POSE.origin)
        return p[2] - PAPER_MIRROR.height(p[0], p[1])

    for x, y, z in zip(X[:20], Y[:20], moved.height(X[:20], Y[:20]), strict=True):
        assert optimize.brentq(above, -0.01, 0.01, args=(x, y), xtol=1e-16) == pytest.approx(
            z, abs=1e-16
        )


def test_the_rotation_is_about_x_then_y_then_z_and_its_rates_are_its_derivatives():
    from scipy.spatial.transform import Rotation

    angles = [POSE.tip, POSE.tilt, POSE.clocking]
    expected = Rotation.from_euler("xyz", angles).as_matrix()
    np.testing.assert_allclose(POSE.rotation, expected, atol=1e-15)
    step = 1e-6
    for k, rate in enumerate(POSE.rotation_rates()):
        high, low = (np.array(angles) + s * step * (np.arange(3) == k) for s in (1, -1))
        found = Rotation.from_euler("xyz", high).as_matrix()
        found = (found - Rotation.from_euler("xyz", low).as_matrix()) / (2 * step)
        np.testing.assert_allclose(rate, found, atol=1e-9)


def test_where_a_turned_surface_has_no_height_it_says_so():
    turned = PosedSurface(Sphere(0.01), Pose(x=0.005, tip=0.1))
    z = turned.height(np.array([0.0, 0.02]), np.zeros(2))
    assert np.isfinite(z[0])
    assert np.isnan(z[1])


# Forbes' series.


def test_the_first_polynomials_of_forbes_are_those_of_his_paper():
    """2007, table 1: Q_0 = 1, Q_1 = (13 − 16x)/√19, Q_2 = √(2/95) [29 − 4x(25 − 19x)]."""
    x = np.linspace(0, 1, 11)
    bfs = [QBfs(1.0, tuple(np.eye(3)[m])).height(np.sqrt(x), 0 * x) for m in range(3)]
    expected = [
        np.ones(11),
        (13 - 16 * x) / np.sqrt(19),
        np.sqrt(2 / 95) * (29 - 4 * x * (25 - 19 * x)),
    ]
    for one, other in zip(bfs, expected, strict=True):
        np.testing.assert_allclose(one, x * (1 - x) * other, atol=1e-14)
    con = [QCon(1.0, tuple(np.eye(3)[m])).height(np.sqrt(x), 0 * x) for m in range(3)]
    expected = [np.ones(11), -(5 - 6 * x), 15 - 14 * x * (3 - 2 * x)]
    for one, other in zip(con, expected, strict=True):
        np.testing.assert_allclose(one, x**2 * other, atol=1e-13)


def test_slopes_of_bfs_are_orthonormal():
    """2007, eq. 3.4 and 3.9: ⟨s_i s_j⟩ = δ_ij with weight 1/√(u²(1 − u²)) over u."""
    angle = (np.arange(400) + 0.5) * np.pi / 800
    u = np.sin(angle)  # uniform in arcsin u: the weight 1/√(1 − u²)
    slopes = [QBfs(1.0, tuple(np.eye(7)[m])).gradient(u, 0 * u)[0] for m in range(7)]
    gram = np.array([[np.mean(a * b) for a in slopes] for b in slopes])
    np.testing.assert_allclose(gram / gram[0, 0], np.eye(7), atol=1e-12)


def test_freeform_terms_are_orthonormal_in_the_gradient():
    """2012, sec. 3: the mean of ∇S_i·∇S_j is δ_ij, with weight 1/√(1 − u²) over u, even over θ."""
    angle, around = np.meshgrid((np.arange(40) + 0.5) * np.pi / 80, np.arange(32) * np.pi / 16)
    u = np.sin(angle)
    x, y, step = u * np.cos(around), u * np.sin(around), 1e-3
    terms = [QTerm(n, m, 1.0) for m in (0, 1, -1, 2, 3, -8) for n in range(5)]

    def slope(surface, dx, dy):
        """Differences of the eighth order of the height alone."""
        weights = (4 / 5, -1 / 5, 4 / 105, -1 / 280)
        return sum(
            w * (surface.height(x + k * dx, y + k * dy) - surface.height(x - k * dx, y - k * dy))
            for k, w in enumerate(weights, 1)
        ) / (dx + dy)

    made = [QFreeform(1.0, (term,)) for term in terms]
    slopes = np.array([[slope(s, step, 0.0), slope(s, 0.0, step)] for s in made])
    flat = slopes.reshape(len(terms), -1)
    np.testing.assert_allclose(flat @ flat.T / x.size, np.eye(len(terms)), atol=1e-9)


@pytest.mark.parametrize(("n", "m"), [(0, 1), (3, 1), (2, 2), (5, 4), (12, 9)])
def test_a_freeform_term_is_a_polynomial_of_its_degree_with_alternating_sign(n, m):
    """Degree in u² and sign of the highest power, which the gradient does not determine."""
    x = np.linspace(0.05, 1, n + 3)
    along = QFreeform(1.0, (QTerm(n, m, 1.0),)).height(np.sqrt(x), 0 * x) / np.sqrt(x) ** m
    differences = np.diff(along, n)
    assert np.all(differences * (-1) ** n > 0)
    assert np.ptp(differences) < 1e-6 * np.max(np.abs(differences))


def test_freeform_terms_without_an_angle_are_those_of_bfs_and_sines_are_cosines_turned():
    sizes = (1e-6, -2e-6, 3e-6)
    terms = tuple(QTerm(n, 0, size) for n, size in enumerate(sizes))
    one, other = QFreeform(0.01, terms, -0.07), QBfs(0.01, sizes, -0.07)
    np.testing.assert_allclose(one.height(X, Y), other.height(X, Y), rtol=1e-13)
    cosine, sine = (QFreeform(0.01, (QTerm(2, m, 1e-6),), 0.05) for m in (3, -3))
    # A sixth of a turn of three lobes by half a lobe: x to y.
    c, s = np.cos(np.pi / 6), np.sin(np.pi / 6)
    turned = sine.height(c * X - s * Y, s * X + c * Y)
    np.testing.assert_allclose(turned, cosine.height(X, Y), atol=1e-19)


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: Asphere(0.0), "radius is 0.0 m"),
        (lambda: Asphere(0.1, 1e9), "conic_constant"),
        (lambda: Asphere(0.1, 0.0, (np.nan,)), r"even_terms\[0\]"),
        (lambda: Asphere(0.1, 0.0, (0.0,) * 21), "21 coefficients"),
        (lambda: Toroid(np.inf), "radius_x"),
        (lambda: Biconic(0.1, 0.0), "radius_y"),
        (lambda: XYTerm(-1, 0, 1.0), "x is -1"),
        (lambda: ZernikeSurface(0.01, (1e-6,), "wyant"), "indexing is 'wyant'"),
        (lambda: ZernikeSurface(0.01, (1e-6,), "noll", "pv"), "norm is 'pv'"),
        (lambda: OffAxisSection(Sphere(0.01), 0.02), "distance is 0.02 m"),
        (lambda: Pose(tip=4.0), "tip is 4.0 rad"),
        (lambda: Sum(()), "no parts"),
        (lambda: QBfs(-1.0, ()), "aperture_radius"),
        (lambda: QFreeform(0.01, (), 0.0), "radius is 0.0 m"),
        (lambda: QTerm(21, 0, 1e-6), "degree n is 21"),
        (lambda: QTerm(0, -21, 1e-6), "angular order"),
    ],
)
def test_what_nobody_makes_is_refused_by_name(make, named):
    with pytest.raises(SurfaceError, match=named):
        make()
