"""Estimated parameters of a shape: exact on exact points, and covered on parts with form."""

import numpy as np
import pytest
from soaked import soaked

from omsm_ros.core.form.analyse import analyse_form
from omsm_ros.core.registration.placement import Placement, PointBatch
from omsm_ros.core.registration.register import register
from omsm_ros.core.surface.aspheres import Asphere, Sphere, Toroid
from omsm_ros.core.surface.nominal import Flat, OffAxisParaboloid
from omsm_ros.core.surface.posed import Pose, PosedSurface
from omsm_ros.core.surface.shape_parameters import external
from omsm_ros.core.surface.zernike_terms import ZernikeIndex, terms_up_to, zernike_values
from omsm_ros.errors import ConfigurationError

R, N = 12e-3, 2000
TURN = np.linspace(0.01, 1, N)
X, Y = R * TURN * np.cos(240 * TURN), R * TURN * np.sin(240 * TURN)
POSE = Pose(piston=2e-6, tip=3e-4, tilt=-2e-4)


def fitted(guess, height, asked):
    batch = PointBatch(X, Y, height, np.empty((0, N)))
    found = register(guess, lambda: [batch], asked)
    return found, {n: external(n, v, found.spread.get(n)) for n, v in found.placement.shape}


@pytest.mark.parametrize(
    ("guess", "true"),
    [
        (Sphere(1.0), {"radius": 0.05}),
        (Sphere(0.1), {"radius": -0.015}),
        (Toroid(0.1), {"radius_x": 0.08}),
        (Toroid(0.1, 0.1), {"radius_x": 0.1, "radius_y": -0.3}),
        (OffAxisParaboloid(0.1, 50.8e-3), {"parent_focal_length": 25.4e-3}),
        (Asphere(None, 0.0, (0.0, 3.0)), {"radius": 0.04, "conic_constant": -1.2}),
    ],
)
def test_exact_points_give_the_parameters_from_any_start(guess, true):
    made = type(guess)(**{f: getattr(guess, f) for f in guess.__dataclass_fields__} | true)
    height = PosedSurface(made, POSE).height(X, Y)
    _, found = fitted(guess, height, ("auto", *true))
    for name, value in true.items():
        size = max(abs(value), 1e-3)
        assert found[name][0] == pytest.approx(value, abs=3e-7 * size)


@pytest.mark.parametrize(
    ("guess", "true"),
    [
        (Sphere(1.0), {"radius": 0.025}),
        (Toroid(1.0, 1.0), {"radius_x": -0.035, "radius_y": -0.076}),
        (Asphere(1.0), {"radius": 0.028, "conic_constant": -1.9}),
    ],
)
def test_a_part_away_from_the_origin_has_the_parameters_of_the_one_at_it(guess, true):
    """An instrument may have its origin at a corner; the vertex is then where points are level."""
    made = type(guess)(**{f: getattr(guess, f) for f in guess.__dataclass_fields__} | true)
    rng = np.random.default_rng(5)
    height = PosedSurface(made, Pose(tip=2e-3, tilt=-3e-3)).height(X, Y)
    height += rng.normal(0, 2e-9, N)
    found = {}
    for at in ((0.0, 0.0), (1.7 * R, 2.6 * R)):
        batch = PointBatch(X + at[0], Y + at[1], height, np.empty((0, N)))
        one = register(guess, lambda batch=batch: [batch], ("auto", *true))
        assert abs(one.placement.value("x") - at[0]) < 2e-3
        found[at] = {n: (v, one.spread.get(n)) for n, v in one.placement.shape}
    here, away = found.values()
    for name in true:
        value, spread = external(name, *away[name])
        assert value == pytest.approx(external(name, *here[name])[0], abs=0.2 * spread)
        assert abs(value - true[name]) < 3 * spread


def test_the_radius_is_within_two_uncertainties_on_parts_with_form():
    """Power of the part is part of its form, so that it counts in the uncertainty of the radius."""
    u, v = X / R, Y / R
    s = u * u + v * v
    form = [2 * s - 1, u * u - v * v, 2 * u * v, (3 * s - 2) * u, (3 * s - 2) * v,
            u**3 - 3 * u * v * v, v**3 - 3 * u * u * v, 6 * s * s - 6 * s + 1]  # fmt: skip
    hits = []
    for seed in range(25):
        rng = np.random.default_rng(seed)
        size = 30e-9 * np.array([1, 1, 1, 0.4, 0.4, 0.4, 0.4, 0.2])
        height = PosedSurface(Sphere(0.08), POSE).height(X, Y) + rng.normal(0, 3e-9, N)
        height += (rng.normal(size=8) * size) @ np.array(form)
        value, spread = fitted(Sphere(0.1), height, ("piston", "tip", "tilt", "radius"))[1][
            "radius"
        ]
        hits.append(abs(value - 0.08) <= 2 * spread)
        assert spread < 20e-6
    # Fewer than 20 of 25 have a probability of 2e-4 at 95 %.
    assert sum(hits) >= 20


def test_a_parameter_that_the_shape_does_not_have_is_named():
    with pytest.raises(ConfigurationError, match="conic_constant"):
        fitted(Sphere(0.1), np.zeros(N), ("auto", "conic_constant"))


@pytest.mark.parametrize("seed", [0, *soaked(1, 2)])
def test_a_declared_placement_is_never_exceeded_and_saves_the_astigmatism(seed):
    """On the off-axis paraboloid a shift of 10 µm looks like 100 nm of astigmatism."""
    nominal, off = OffAxisParaboloid(25.4e-3, 50.8e-3), {"x": 1e-6, "y": 1e-6, "clocking": 1e-5}
    u, v = X / R, Y / R
    rng = np.random.default_rng(seed)
    pose = Pose(**{name: float(rng.normal()) * size for name, size in off.items()})
    height = PosedSurface(nominal, pose).height(X, Y) + 50e-9 * (u * u - v * v)
    batch = PointBatch(X, Y, height + rng.normal(0, 3e-9, N), np.empty((0, N)))
    form = analyse_form(nominal, lambda: [batch], ("auto",), declared=off)
    for name, size in off.items():
        assert form.registration.spread.get(name) <= size * (1 + 1e-9)
    place = form.zernike.terms.index(ZernikeIndex(2, 2))
    astigmatism = form.zernike.coefficients[place]
    spread = form.zernike.uncertainty[place]
    assert abs(astigmatism - 50e-9) < 3 * spread < 10e-9


def test_a_conic_constant_holds_what_spherical_aberration_of_the_part_makes_of_it():
    """That is as high as the rest of the fourth order, but looks like another conic constant."""
    u, v = X / R, Y / R
    s, rng = u * u + v * v, np.random.default_rng(1)
    others = (u**4 - 6 * u * u * v * v + v**4, 4 * (u**3 * v - u * v**3),
              (4 * s - 3) * (u * u - v * v), (4 * s - 3) * 2 * u * v)  # fmt: skip
    height = PosedSurface(Asphere(0.05, -0.8), POSE).height(X, Y) + rng.normal(0, 2e-9, N)
    height += np.sqrt(10) * 20e-9 * np.array([1, -1, -1, 1]) @ others
    aberration = np.sqrt(5) * 20e-9 * (6 * s * s - 6 * s + 1)
    (value, spread), (changed, _) = (
        fitted(Asphere(0.051, -0.6), h, ("auto", "radius", "conic_constant"))[1]["conic_constant"]
        for h in (height, height + aberration)
    )
    assert 1e-3 < abs(changed - value) < 2 * spread


@pytest.mark.parametrize("count", [60, 350])
@pytest.mark.parametrize("radius", [2e6, -3e5, 40.0])
def test_a_profile_has_a_radius_however_flat_and_with_few_points(count, radius):
    """A mirror of half a metre with the sagitta of 2e6 m, 16 nm, is no plane."""
    along = np.linspace(-0.25, 0.25, count)
    form = 5e-9 * np.cos(13 * along / 0.25) + 3e-4 * along
    height = Sphere(radius).height(along, 0 * along) + form
    batch = PointBatch(along, 0 * along, height, np.empty((0, count)))
    found = register(Sphere(1.0), lambda: [batch], ("auto", "radius"))
    ((_, curvature),) = found.placement.shape
    assert abs(curvature - 1 / radius) < 2 * found.spread["radius"] < 1e-5
    flat = register(Flat(), lambda: [batch], ("auto",))
    assert "clocking" in flat.dofs.refused


def test_a_place_that_the_points_contradict_is_not_held_at_its_nominal_one():
    """A fast off-axis paraboloid, 0.15 mm off along y and 0.3 mm along x, with 100 nm of form."""
    random, radius, focal = np.random.default_rng(39), 6e-3, 11.3e-3
    x, y = (v.ravel() for v in np.meshgrid(*[np.linspace(-radius, radius, 100)] * 2))
    x, y = (v[np.hypot(x, y) <= radius] for v in (x, y))
    terms = terms_up_to(8, 2)
    amplitudes = random.normal(size=len(terms)) * [term.n**-2.5 for term in terms]
    form = amplitudes @ zernike_values(x / radius, y / radius, terms)
    places = np.array([-3e-4, -1.5e-4, 2.2e-3, -2e-3]) * random.choice([-1, 1], 4)
    pose = Placement().moved(("x", "y", "tip", "tilt"), places).pose
    height = PosedSurface(OffAxisParaboloid(focal, 10.2e-3), pose).height(x, y)
    height += 100e-9 * form / form.std() + random.normal(0, 5e-9, len(x))
    points = PointBatch(x, y, height, np.empty((0, len(x))))
    asked = ("auto", "parent_focal_length")
    found = register(OffAxisParaboloid(50e-3, 10.2e-3), lambda: [points], asked, even=True)
    error = found.placement.value("parent_focal_length") - 1 / focal
    assert abs(error) < 2 * found.spread["parent_focal_length"] < 0.02 / focal
