"""A part in a pose that is known, seen by a model of its own: the twin's, which intersects by
fixed-point iteration."""

import tracemalloc
from dataclasses import dataclass

import numpy as np
import pytest
from soaked import soaked

from omsm_ros.core.registration import register as registering
from omsm_ros.core.registration.placement import (
    POSE_PARAMETERS,
    Placement,
    PointBatch,
    dof_columns,
    placed,
)
from omsm_ros.core.registration.pose_parameters import parse_dofs
from omsm_ros.core.registration.register import register
from omsm_ros.core.surface.aperture import Aperture
from omsm_ros.core.surface.aspheres import Asphere, Sphere, Toroid
from omsm_ros.core.surface.nominal import PAPER_MIRROR, Flat, XYPolynomial, XYTerm, ZernikeSurface
from omsm_ros.core.surface.posed import Pose, Sum
from omsm_ros.errors import ConfigurationError, DataError
from omsm_ros.twin.part import FigureError, PartPose, mounted_surface

STRAIGHT = Pose()
RADIUS, NOISE = 12.7e-3, 10e-9
FREEFORM = Sum((Sphere(0.1), XYPolynomial(0.0127, (XYTerm(3, 0, 2e-5), XYTerm(1, 2, -3e-5)))))


@dataclass(frozen=True)
class Part:
    """A nominal surface and what the part has beyond it."""

    nominal: object
    error: object

    def height(self, x, y):
        return self.nominal.height(x, y) + self.error.height(x, y)


def spiral(points=12_000, turns=60):
    r, angle = np.linspace(RADIUS, 0, points), np.linspace(0, 2 * np.pi * turns, points)
    return r * np.cos(angle), r * np.sin(angle)


def scan(part, pose=STRAIGHT, noise=NOISE, seed=1, dust=0.0, points=12_000):
    x, y = spiral(points)
    rng = np.random.default_rng(seed)
    sits = PartPose(
        x_m=pose.x, y_m=pose.y, z_m=pose.piston,
        tilt_x_rad=pose.tip, tilt_y_rad=pose.tilt, clocking_rad=pose.clocking,
    )  # fmt: skip
    height = mounted_surface(part, sits).height(x, y) + rng.normal(0, 1, points) * noise
    height = height + 5e-6 * (rng.random(points) < dust)
    return PointBatch(x, y, height, np.empty((0, points)))


def fitted(nominal, portion, text="auto", **options):
    return register(nominal, lambda: [portion], parse_dofs(text), **options)


POSE = Pose(x=4e-4, y=-5e-4, piston=2e-4, tip=8e-3, tilt=-7e-3)


@pytest.mark.parametrize("nominal", [PAPER_MIRROR, FREEFORM, Toroid(0.1, 0.06)])
def test_without_errors_the_pose_is_found_to_rounding(nominal):
    """The two models of a posed surface agree, or it would not be."""
    names = "piston,tip,tilt" if isinstance(nominal, Toroid) else "piston,tip,tilt,x,y"
    pose = POSE if "x" in names else Pose(piston=2e-4, tip=8e-3, tilt=-7e-3)
    found = fitted(nominal, scan(nominal, pose, noise=0.0), names)
    for name in names.split(","):
        assert found.placement.value(name) == pytest.approx(getattr(pose, name), abs=2e-10)


def test_derivatives_are_those_of_the_deviation():
    """Compare with differences in every pose parameter, at a pose far from zero."""
    at = Placement(Pose(x=1e-3, y=-2e-3, piston=1e-3, tip=0.02, tilt=-0.03, clocking=0.5), 0.01)
    portion = scan(FREEFORM, at.pose, noise=1e-7, points=300)
    columns = dof_columns(at, placed(FREEFORM, at, portion), POSE_PARAMETERS)
    for k, name in enumerate(POSE_PARAMETERS):
        step = 1e-7
        high, low = (
            placed(FREEFORM, at.moved([name], np.array([s])), portion).deviation
            for s in (step, -step)
        )
        scale = np.abs(columns[k]).max()
        np.testing.assert_allclose(columns[k], (high - low) / (2 * step), atol=5e-5 * scale)


def test_the_deviation_is_the_distance_along_the_normal():
    """On a sphere the deviation is the distance from its centre less the radius."""
    rng = np.random.default_rng(3)
    x, y = spiral(500)
    z = Sphere(0.02).height(x, y) + rng.normal(0, 5e-6, 500)
    found = placed(Sphere(0.02), Placement(), PointBatch(x, y, z, np.empty((0, 500)))).deviation
    np.testing.assert_allclose(found, 0.02 - np.sqrt(x**2 + y**2 + (z - 0.02) ** 2), atol=2e-12)


@pytest.mark.parametrize(
    ("nominal", "fitted_", "refused"),
    [
        (Flat(), {"piston", "tip", "tilt"}, {"x", "y", "clocking"}),
        (Sphere(0.1), {"piston", "tip", "tilt"}, {"x", "y", "clocking"}),
        (Asphere(0.1, -1.0), {"piston", "tip", "tilt", "x", "y"}, {"clocking"}),
        (Toroid(0.1, 0.06), {"piston", "tip", "tilt", "y", "clocking"}, {"x"}),
        (PAPER_MIRROR, {"piston", "tip", "tilt", "x", "y"}, {"clocking"}),
        (FREEFORM, {"piston", "tip", "tilt", "x", "y", "clocking"}, set()),
        (
            Sum((Sphere(0.1), ZernikeSurface(RADIUS, (0, 0, 0, 0, 1e-5, 0, 4e-6, 0, 0, 3e-6)))),
            {"piston", "tip", "tilt", "x", "y", "clocking"},
            set(),
        ),
    ],
)
def test_what_a_surface_determines_is_found(nominal, fitted_, refused):
    found = fitted(nominal, scan(nominal)).dofs
    assert set(found.fitted) == fitted_
    assert set(found.refused) == refused


def test_points_without_any_deviation_stay_where_they_are():
    x, y = spiral(1000)
    found = fitted(Flat(), PointBatch(x, y, np.zeros(1000), np.empty((0, 1000))))
    assert found.placement == Placement()


def test_a_freedom_that_was_asked_for_in_vain_is_refused_with_the_reason():
    portion = scan(Sphere(0.1))
    with pytest.raises(
        DataError, match="clocking cannot be fitted: this move does not change the surface"
    ):
        fitted(Sphere(0.1), portion, "piston,clocking")
    with pytest.raises(DataError, match=r"x cannot be fitted: .* it has the effect of tilt"):
        fitted(Sphere(0.1), portion, "piston,tip,tilt,x")
    assert fitted(Sphere(0.1), portion, "piston,x,y").dofs.fitted == ("piston", "x", "y")


@pytest.mark.parametrize("text", ["", "yaw", "piston,piston", "piston,,yaw"])
def test_names_that_are_no_freedoms_are_refused(text):
    with pytest.raises(ConfigurationError, match="pose parameter"):
        parse_dofs(text)


def deviations_in_units(nominal, error, names, seeds, pose):
    rows = []
    for seed in range(seeds):
        found = fitted(nominal, scan(Part(nominal, error(seed)), pose, seed=seed), names)
        rows.append(
            [
                (found.placement.value(n) - getattr(pose, n)) / found.spread.get(n)
                for n in names.split(",")
            ]
        )
    return np.array(rows)


@pytest.mark.soak
def test_the_stated_uncertainty_is_the_scatter_on_a_part_without_errors():
    """It may be several times too large, for it is not known that the part has none."""
    off = deviations_in_units(
        PAPER_MIRROR, lambda seed: Flat(), "piston,tip,tilt,x,y", 20, Pose(x=1e-4)
    )
    assert 0.1 < np.sqrt(np.mean(off**2)) < 1.2


@pytest.mark.soak
def test_the_stated_uncertainty_holds_what_the_form_of_the_part_does_to_the_pose():
    """50 nm of astigmatism pass for micrometres of shift: least squares states a hundredth.

    Where a part's form happens to be just what a shift makes, nothing tells: one run in twenty.
    """

    def curved(seed):
        angles = np.random.default_rng(seed).uniform(0, 2 * np.pi, 2)
        sizes = [50e-9 * np.cos(angles[0]), 50e-9 * np.sin(angles[0]),
                 15e-9 * np.cos(angles[1]), 15e-9 * np.sin(angles[1])]  # fmt: skip
        return ZernikeSurface(RADIUS, (0, 0, 0, 0, *sizes))

    off = deviations_in_units(PAPER_MIRROR, curved, "piston,tip,tilt,x,y", 15, POSE)
    assert np.mean(np.abs(off) < 2) > 0.9
    assert np.sqrt(np.mean(off**2)) > 0.05


def test_coma_of_an_asphere_is_a_shift_and_the_uncertainty_holds_it():
    """A lateral shift of an asphere gives coma but no trefoil, so trefoil does not determine it."""
    nominal = Asphere(0.08, -1.2, (0.0, 20.0))
    pose = Pose(x=2e-4, y=-3e-4, tip=2e-3)
    error = ZernikeSurface(RADIUS, (0, 0, 0, 0, 30e-9, 40e-9, 10e-9, -11e-9))
    for seed in range(2):
        found = fitted(nominal, scan(Part(nominal, error), pose, seed=seed), "piston,tip,tilt,x,y")
        for name in ("x", "y"):
            off = found.placement.value(name) - getattr(pose, name)
            assert abs(off) < 2 * found.spread.get(name)


def test_what_is_not_determined_widens_what_follows_it():
    """Clocking of an off-axis paraboloid about its parent's axis, 50.8 mm away."""
    pose = Pose(clocking=5e-3)
    found = fitted(PAPER_MIRROR, scan(PAPER_MIRROR, pose))
    for name in POSE_PARAMETERS[:6]:
        off = found.placement.value(name) - getattr(pose, name)
        assert abs(off) < 2 * found.spread.get(name)
    assert found.spread.get("y") > 5e-4
    held = fitted(PAPER_MIRROR, scan(PAPER_MIRROR), "piston,tip,tilt,x,y")
    assert held.spread.get("y") < 1e-6
    assert held.spread.get("clocking") is None


ASTIGMATIC = ZernikeSurface(RADIUS, (0, 0, 0, 0, 35e-9, 35e-9, 10e-9, -11e-9))


def test_a_move_that_form_looks_like_is_held_and_may_do_what_is_stated():
    """Hold a shift of 3 µm: its 10 nm of form cannot be distinguished from form of the part."""
    pose = Pose(x=3e-6, y=-2e-6, tip=1e-3)
    found = fitted(PAPER_MIRROR, scan(Part(PAPER_MIRROR, ASTIGMATIC), pose))
    assert set(found.dofs.held) == {"x", "y"}
    assert "is not significant" in str(found.dofs.held["x"])
    for name in ("x", "y"):
        assert found.placement.value(name) == 0
        assert abs(getattr(pose, name)) < 2 * found.spread.get(name)
    # By as much as the heights of a part without errors change when it is moved so.
    there = scan(PAPER_MIRROR, pose, noise=0.0)
    points = placed(PAPER_MIRROR, Placement(), there)
    names = ("piston", "tip", "tilt")
    columns = dof_columns(Placement(), points, names).T
    left = points.deviation - columns @ np.linalg.lstsq(columns, points.deviation, rcond=None)[0]
    opened = found.effects(points, np.empty((0, len(there.x))))[1]
    assert opened.shape == (4, len(there.x))
    assert np.sqrt(np.mean(left**2)) < 2 * np.sqrt(np.mean(np.sum(opened**2, axis=0)))


def test_a_part_that_was_plainly_moved_is_fitted_there():
    pose = Pose(x=4e-4, y=-3e-4, tip=1e-3)
    found = fitted(PAPER_MIRROR, scan(Part(PAPER_MIRROR, ASTIGMATIC), pose))
    assert set(found.dofs.fitted) >= {"x", "y"}
    assert not found.dofs.held


def test_what_was_asked_for_by_name_is_never_held():
    found = fitted(PAPER_MIRROR, scan(Part(PAPER_MIRROR, ASTIGMATIC)), "piston,tip,tilt,x,y")
    assert found.dofs.fitted == ("piston", "tip", "tilt", "x", "y")
    assert found.held_effects.shape == (0, 0)


def test_dust_is_left_out():
    clean, dusty = (
        fitted(PAPER_MIRROR, scan(PAPER_MIRROR, POSE, dust=d), "piston,tip,tilt,x,y")
        for d in (0.0, 1e-3)
    )
    for name in clean.dofs.fitted:
        change = abs(dusty.placement.value(name) - clean.placement.value(name))
        assert change < 0.5 * clean.spread.get(name)
    assert dusty.limit < 1e-7


def test_steps_of_the_part_are_no_dust():
    """A tenth of a flat stands 20 nm above the rest, and no noise hides it."""
    x, y = spiral()
    step = 20e-9 * ((np.arctan2(y, x) > 0) & (np.arctan2(y, x) < 0.2 * np.pi))
    portion = PointBatch(x, y, step, np.empty((0, len(x))))
    found = fitted(Flat(), portion, "piston,tip,tilt")
    assert len(found.dust) <= 1


@pytest.mark.parametrize("size", [*soaked(80e-9, 120e-9), 300e-9])
@pytest.mark.parametrize("seed", [3, *soaked(4)])
def test_a_small_piece_settles_though_its_form_looks_like_a_pose(size, seed):
    """Over 3 mm form and shift are one: steps of 0.2 mm, which bend what lies between them."""
    part = FigureError(PAPER_MIRROR, 3e-3, seed=seed, astigmatism=size)
    x, y = (v * 3e-3 / RADIUS for v in spiral(20_000, 30))
    noise = np.random.default_rng(seed).normal(0, NOISE, len(x))
    portion = PointBatch(x, y, part.height(x, y) + noise, np.empty((0, len(x))))
    found = fitted(PAPER_MIRROR, portion)
    assert found.noise == pytest.approx(NOISE, rel=0.1)
    assert not len(found.dust)
    for name in found.dofs.fitted:
        assert abs(found.placement.value(name)) < 2 * found.spread.get(name)


def test_a_pose_that_does_not_settle_is_refused_with_the_remedy(monkeypatch):
    monkeypatch.setattr(registering, "_MOST_REFINED", 2)
    with pytest.raises(DataError, match=r"does not converge.*'fit' piston,tip,tilt"):
        fitted(PAPER_MIRROR, scan(PAPER_MIRROR))


def test_a_systematic_source_moves_the_pose_by_what_it_says():
    """A height that is off by a plane: the tilt follows, and the uncertainty of it is that."""
    portion = scan(PAPER_MIRROR)
    slope = 1e-6
    reported = portion._replace(systematic=slope * portion.x[np.newaxis])
    found = fitted(PAPER_MIRROR, reported, "piston,tip,tilt", sources=("slide",))
    moved = fitted(
        PAPER_MIRROR, portion._replace(height=portion.height + slope * portion.x), "piston,tip,tilt"
    )
    plain = fitted(PAPER_MIRROR, portion, "piston,tip,tilt")
    for k, name in enumerate(plain.dofs.fitted):
        step = moved.placement.value(name) - plain.placement.value(name)
        assert found.moved[k, 0] == pytest.approx(step, rel=0.05, abs=1e-10)
        assert found.from_source["slide"][k] == abs(found.moved[k, 0])
    assert found.spread.get("tilt") == pytest.approx(slope, rel=0.05)


def test_power_is_the_curvature_that_the_part_has_more():
    curved = Part(PAPER_MIRROR, Asphere(even_terms=(0.5e-3,)))
    found = fitted(PAPER_MIRROR, scan(curved), "piston,tip,tilt,power")
    assert found.placement.power == pytest.approx(1e-3, abs=4 * found.spread.get("power"))


def test_the_aperture_leaves_out_what_lies_beyond():
    """A turned-down edge spoils the whole, not the middle."""
    portion = scan(PAPER_MIRROR, POSE)
    edge = np.hypot(portion.x, portion.y) > 11e-3
    spoiled = portion._replace(height=portion.height - 3e-7 * edge)
    found = fitted(PAPER_MIRROR, spoiled, "piston,tip,tilt,x,y", aperture=Aperture(10e-3))
    assert abs(found.placement.value("x") - POSE.x) < 3 * found.spread.get("x")
    assert found.spread.get("x") < 1e-6


@pytest.mark.parametrize(
    ("portion", "named"),
    [
        (PointBatch(*np.zeros((3, 0)), np.empty((0, 0))), "0 points"),
        (PointBatch(*np.zeros((3, 5)), np.empty((0, 5))), "5 points"),
        (PointBatch(*np.full((3, 500), np.nan), np.empty((0, 500))), r"0 points lie"),
        (PointBatch(*np.zeros((3, 500)), np.empty((0, 500))), "within 0 nm .*measure across"),
        (
            scan(Sphere(0.1))._replace(x=spiral()[0] * 100, y=spiral()[1] * 100),
            "not converge|lie on the nominal",
        ),
    ],
)
def test_points_that_cannot_be_registered_are_refused(portion, named):
    with pytest.raises(DataError, match=named):
        fitted(Sphere(0.1), portion)


def test_memory_does_not_grow_with_the_scan():
    portion = scan(PAPER_MIRROR, POSE)

    def peak(times):
        tracemalloc.start()
        register(PAPER_MIRROR, lambda: (portion for _ in range(times)), ("piston", "tip", "tilt"))
        used = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return used

    assert peak(8) < 1.1 * peak(2)


@pytest.mark.parametrize(("depth", "middle"), [(92e-9, 0.5), (156e-9, 0.65), (198e-9, 0.8)])
def test_a_groove_about_as_deep_as_outliers_does_not_go_in_and_out_without_end(depth, middle):
    """The start went to and fro between two poses, one with its bottom and one without."""
    place = np.arange(1, 3001)
    radius, angle = np.sqrt(place / 3000), 2 * np.pi * 0.6180339887 * place
    groove = depth * np.exp(-(np.abs((radius - middle) / 0.07) ** 4))
    height = 28e-9 * (3 * radius**3 - 2 * radius) * np.cos(angle) - groove
    x, y = 1e-2 * radius * np.cos(angle), 1e-2 * radius * np.sin(angle)
    batch = PointBatch(x, y, height, np.empty((0, len(x))))
    found = register(Flat(), lambda: [batch], ("piston", "tip", "tilt"))
    assert (found.placement.pose.tip, found.placement.pose.tilt) == pytest.approx((0, 0), abs=1e-7)


@pytest.mark.parametrize("path", ["turns", "lines"])
def test_a_missing_sector_has_no_share_in_the_pose(path):
    """The pose is that of the covered area, which ends half a step beyond its last points."""
    radius, form = 5e-3, lambda x, y: 4e-3 * (x**2 - y**2 + x * y) + 1.0 * (x**3 + x * y**2)
    there = lambda x, y: np.abs(np.angle((x + 1j * y) * np.exp(-0.4j))) > 0.5  # noqa: E731
    way, lines = np.linspace(0, 1, 20_000), np.linspace(-1, 1, 62)[1:-1]
    x, y = np.array([np.cos(way * 120 * np.pi), np.sin(way * 120 * np.pi)]) * way * radius
    if path == "lines":
        along = np.linspace(-1, 1, 400) * np.where(np.arange(60) % 2, -1, 1)[:, np.newaxis]
        x, y = along.ravel() * radius, np.repeat(lines, 400) * radius
    kept = there(x, y) & (np.hypot(x, y) <= radius)
    x, y = x[kept], y[kept]
    batch = PointBatch(x, y, form(x, y), np.empty((0, len(x))))
    found = register(Flat(), lambda: [batch], ("piston", "tip", "tilt"), aperture=Aperture(radius))
    u, v = radius * np.stack(np.meshgrid(*[(np.arange(1000) + 0.5) / 500 - 1] * 2)).reshape(2, -1)
    covered = there(u, v) & (np.hypot(u, v) <= radius)
    u, v = u[covered], v[covered]
    plane = np.linalg.lstsq(np.stack([np.ones_like(u), u, v], 1), form(u, v), rcond=None)[0]
    pose = found.placement.pose
    away = [pose.piston - plane[0], (pose.tilt + plane[1]) * radius, (pose.tip - plane[2]) * radius]
    assert np.max(np.abs(away)) < 1e-3 * np.ptp(form(u, v))
