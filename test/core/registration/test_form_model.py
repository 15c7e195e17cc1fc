"""Fit of a pose with unknown form: length of a step, and convergence of an oscillating pose."""

import numpy as np
import pytest
from scipy import stats

from omsm_ros.core.registration.form_model import Estimate, FormBasis, _upper_variances, estimate
from omsm_ros.core.registration.placement import POSE_PARAMETERS, PointBatch
from omsm_ros.core.registration.pose_parameters import parse_dofs
from omsm_ros.core.registration.register import register
from omsm_ros.core.surface.aperture import Aperture
from omsm_ros.core.surface.aspheres import Sphere
from omsm_ros.core.surface.nominal import Flat, ZernikeSurface
from omsm_ros.core.surface.posed import Sum
from omsm_ros.twin.part import PartPose, mounted_surface

RADIUS = 12.7e-3


def test_a_step_is_measured_in_its_own_uncertainty():
    """Compare with the inverse of the covariance for parameters of different units."""
    rng = np.random.default_rng(1)
    mixed = rng.normal(size=(3, 3)) * np.array([[1e-9], [1e3], [1.0]])
    covariance = np.zeros((5, 5))
    covariance[:3, :3] = mixed @ mixed.T
    step = mixed @ np.array([2.0, -1.0, 2.0])
    made = Estimate(step, np.zeros(2), covariance, np.zeros(2), 1.0, covariance)
    assert made.length == pytest.approx(3.0, rel=1e-6)


@pytest.mark.parametrize("terms", [4, 12])
@pytest.mark.parametrize("unknown", [0.0, 0.5])
def test_a_size_found_from_few_terms_may_be_larger(terms, unknown):
    """A mean of ν squares lies below that of all by ν/χ²(ν) in one of seven; half known, half ν."""
    factor = _upper_variances(np.ones(terms), np.full(terms, unknown), np.full(terms, 8))
    known = terms * (1 - unknown)
    assert factor == pytest.approx(known / stats.chi2.ppf(0.15, known), rel=0.03)


@pytest.mark.parametrize("fall", [2, 3, 4])
def test_form_of_which_no_term_is_seen_continues_the_fall_of_the_others(fall):
    """A toroid with free radii and clocking takes all of order 2; its bound is above the law."""
    order = np.repeat(np.arange(2, 9), np.arange(3, 10))
    law = order ** (-2.0 * fall)
    unseen = 1.0 * (order == 2)
    found = _upper_variances(np.where(order == 2, 1e3, law), unseen, order)
    assert 1 < found[0] / law[0] < 3 * _upper_variances(law, 0 * unseen, order)[0] / law[0]


def test_one_large_term_is_not_drawn_to_the_law_of_the_others():
    """Clamping makes 300 nm of astigmatism alone; the bound is no smaller than the term."""
    order = np.repeat(np.arange(2, 9), np.arange(3, 10))
    sizes = np.where(order == 2, 300e-9, 1e-9) ** 2
    assert _upper_variances(sizes, np.where(order == 2, 1 / 3, 0.0), order)[0] > 300e-9**2


@pytest.mark.parametrize("seed", [1, 6, 9])
def test_form_that_the_pose_hides_does_not_grow_to_cancel_a_long_step(seed):
    """Where all terms of order 2 look like moves, chance in the others tells nothing of them."""
    rng = np.random.default_rng(seed)
    r, angle = np.sqrt(rng.random(4000)), 2 * np.pi * rng.random(4000)
    x, y = r * np.cos(angle), r * np.sin(angle)
    basis = FormBasis.over(x, y, np.ones(4000), Aperture(1.0))
    form, order = basis.columns(x, y), np.where(basis.group > 8, 4, basis.group)
    moves = form[basis.group == 2] + 0.01 * form[basis.group == 6][:3]
    sizes = 50e-9 * order**-2.5 * rng.normal(size=len(form))
    height = sizes @ form + rng.normal(0, 1e-9, 4000)
    columns, mean_square = np.concatenate([moves, form]), float(np.mean(height**2))
    expected = np.zeros(3), np.full(3, 1e-3)
    found = estimate(
        columns @ columns.T, columns @ height, 1e-18, mean_square, basis.group, expected
    )
    assert np.linalg.norm(found.form[basis.group == 2]) < mean_square**0.5 / 2


def scanned(path):
    """Return x and y [m] of a scan of the whole disc, along a spiral or the lines of a raster."""
    if path == "spiral":
        r, angle = np.linspace(RADIUS, 0, 20_000), np.linspace(0, 200 * np.pi, 20_000)
        return r * np.cos(angle), r * np.sin(angle)
    x, y = np.meshgrid(np.linspace(-1, 1, 400), np.linspace(-1, 1, 62)[1:-1])
    inside = np.hypot(x, y) <= 1
    return RADIUS * x[inside], RADIUS * y[inside]


@pytest.mark.parametrize("path", ["spiral", "raster"])
@pytest.mark.parametrize("seed", range(3))
def test_coma_of_a_whole_part_is_no_tilt(path, seed):
    """Zernike terms over a disc have no tilt in common, wherever single points lie on it."""
    rng = np.random.default_rng([seed, 5])
    x, y = scanned(path)
    form = ZernikeSurface(RADIUS, (0, 0, 0, *(80e-9 * rng.normal(size=12))))
    height = form.height(x, y) + rng.normal(0, 2e-9, len(x))
    portion = PointBatch(x, y, height, np.empty((0, len(x))))
    found = register(Flat(), lambda: [portion], POSE_PARAMETERS[:3], aperture=Aperture(RADIUS))
    for name in ("tip", "tilt"):
        assert abs(found.placement.value(name)) < 4 * found.spread.get(name)
        assert found.spread.get(name) * RADIUS < 0.1e-9


@pytest.mark.soak
def test_a_pose_that_goes_to_and_fro_within_its_uncertainty_stands():
    """A weak freeform: the sizes of form jump by a thousandth, and no whole step ever was small."""
    nominal = Sum((Sphere(0.1), ZernikeSurface(RADIUS, (0, 0, 0, 0, 1e-5, 0, 4e-6, 0, 0, 3e-6))))
    rng = np.random.default_rng([7, 7])
    s = rng.uniform(-1, 1, 6)
    a, b = rng.uniform(0, 2 * np.pi, 2)
    curved = (50e-9 * np.cos(a), 50e-9 * np.sin(a), 15e-9 * np.cos(b), 15e-9 * np.sin(b))
    part = Sum((nominal, ZernikeSurface(RADIUS, (0, 0, 0, 0, *curved))))
    half = np.radians(0.5)
    pose = {"x": 5e-4 * s[0], "y": 5e-4 * s[1], "piston": 5e-4 * s[2]}
    pose |= {"tip": half * s[3], "tilt": half * s[4], "clocking": half * s[5]}
    sits = PartPose(
        x_m=pose["x"], y_m=pose["y"], z_m=pose["piston"],
        tilt_x_rad=pose["tip"], tilt_y_rad=pose["tilt"], clocking_rad=pose["clocking"],
    )  # fmt: skip
    r, angle = np.linspace(RADIUS, 0, 20_000), np.linspace(0, 254 * np.pi, 20_000)
    x, y = r * np.cos(angle), r * np.sin(angle)
    height = mounted_surface(part, sits).height(x, y) + rng.normal(0, 10e-9, len(x))
    portion = PointBatch(x, y, height, np.empty((0, len(x))))
    found = register(nominal, lambda: [portion], parse_dofs("auto"), aperture=Aperture(RADIUS))
    for name in POSE_PARAMETERS[:6]:
        assert abs(found.placement.value(name) - pose[name]) < 3 * found.spread.get(name)
