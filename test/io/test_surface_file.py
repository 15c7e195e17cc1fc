"""Every shape through its YAML; what is wrong in it is named."""

import numpy as np
import pytest

from omsm_ros.core.surface.aspheres import Asphere
from omsm_ros.core.surface.height_grid import GridSurface, HeightGrid
from omsm_ros.core.surface.nominal import PAPER_MIRROR, SHAPES, XYPolynomial, XYTerm, ZernikeSurface
from omsm_ros.core.surface.posed import OffAxisSection, Pose, PosedSurface, Sum
from omsm_ros.errors import SurfaceError
from omsm_ros.io import descriptions
from omsm_ros.io.descriptions import load_surface

TEXTS = {
    "shape: asphere\nradius: 0.05\nconic_constant: -1\neven_terms: [0, 2.5e3]\n": Asphere(
        0.05, -1.0, (0.0, 2500.0)
    ),
    "shape: zernike\nradius: 0.01\nindexing: noll\nnorm: rms\ncoefficients: [0, 1e-6]\n": (
        ZernikeSurface(0.01, (0.0, 1e-6), "noll", "rms")
    ),
    "shape: xy_polynomial\nradius: 0.01\nterms:\n- {x: 2, y: 1, value: 1.0e-6}\n": XYPolynomial(
        0.01, (XYTerm(2, 1, 1e-6),)
    ),
    "shape: off_axis_section\ndistance: 0.03\nparent: {shape: asphere, radius: 0.1}\n": (
        OffAxisSection(Asphere(0.1), 0.03)
    ),
    "shape: sum\nparts:\n- {shape: asphere, radius: 0.1}\n- {shape: asphere, odd_terms: [1]}\n": (
        Sum((Asphere(0.1), Asphere(odd_terms=(1.0,))))
    ),
    "shape: off_axis_paraboloid\nparent_focal_length: 0.0254\noff_axis_distance: 0.0508\n"
    "pose: {x: 1.0e-3, clocking: 0.1}\n": PosedSurface(PAPER_MIRROR, Pose(x=1e-3, clocking=0.1)),
}


@pytest.mark.parametrize("text", TEXTS)
def test_a_description_is_the_surface(text, tmp_path):
    path = tmp_path / "surface.yaml"
    path.write_text(text)
    assert load_surface(path) == TEXTS[text]
    assert np.isfinite(load_surface(path).height(np.zeros(1), np.zeros(1)))


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("radius: 1\n", "shape is required"),
        ("shape: cone\n", "cone.*expected one of"),
        ("shape: [sphere]\n", "shape is"),
        ("shape: sphere\nradius: yes please\n", "radius is 'yes please', expected a number"),
        ("shape: sphere\nradius: true\n", "radius is True, expected a number"),
        ("shape: asphere\neven_terms: 3\n", "even_terms is 3, expected a list"),
        ("shape: asphere\neven_terms: [1, a]\n", r"even_terms\[1\] is 'a', expected a number"),
        ("shape: zernike\nradius: 1\ncoefficients: []\nindexing: x\n", "expected one of"),
        ("shape: xy_polynomial\nradius: 1\nterms: [3]\n", r"terms\[0\] is 3, expected names"),
        ("shape: xy_polynomial\nradius: 1\nterms: [{x: 1, y: 0}]\n", "value is required"),
        ("shape: xy_polynomial\nradius: 1\nterms: [{x: 1.5, y: 0, value: 1}]\n", "x is 1.5"),
        ("shape: off_axis_section\ndistance: 1\nparent: 3\n", "parent is 3, expected names"),
        ("shape: sum\nparts: [{shape: sphere}]\n", r"parts\[0\]: sphere: radius is required"),
        ("shape: flat\npose: {z: 1}\n", "'z' is unknown"),
        ("shape: flat\npose: 3\n", "pose is 3, expected names"),
        ("shape: flat\npose: {tip: 90}\n", "tip is 90.0 rad"),
        ("shape: off_axis_section\ndistance: 1\nparent: {shape: flat}\n_centre: 1\n", "_centre"),
    ],
)
def test_what_is_wrong_is_named(text, named, tmp_path):
    path = tmp_path / "surface.yaml"
    path.write_text(text)
    with pytest.raises(SurfaceError, match=named):
        load_surface(path)


def test_every_shape_has_a_schema():
    """A record whose fields the reader does not understand would be found by a user."""
    for name, kind in SHAPES.items():
        with pytest.raises(SurfaceError, match="no_such"):
            descriptions.surface_of({"shape": name, "no_such": 1}, "it")
        assert kind.__doc__


def test_a_map_is_a_surface(tmp_path):
    """Through text in millimetres; between its places to the fourth order of their spacing."""
    line = np.linspace(-10, 10, 81)
    x, y = (v.ravel() for v in np.meshgrid(line, line))
    height = 1e3 * PAPER_MIRROR.height(x * 1e-3, y * 1e-3)
    np.savetxt(tmp_path / "sag.xyz", np.stack([x, y, height], axis=1), fmt="%.12g")
    path = tmp_path / "surface.yaml"
    path.write_text("shape: grid\nfile: sag.xyz\nunit: mm\npose: {piston: 1.0e-3}\n")
    surface = load_surface(path)
    u, v = np.random.default_rng(1).uniform(-9e-3, 9e-3, (2, 500))
    np.testing.assert_allclose(surface.height(u, v) - 1e-3, PAPER_MIRROR.height(u, v), atol=1e-12)
    for one, other in zip(surface.gradient(u, v), PAPER_MIRROR.gradient(u, v), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-8)
    assert np.isnan(surface.height(np.array([0.02]), np.zeros(1)))


def test_a_map_may_be_part_of_a_sum_or_parent_of_a_section(tmp_path):
    """The deviation of a surface from its formula is often given as a map."""
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(-8, 8, 81), np.linspace(-6, 6, 61)))
    wave = 1e-3 * np.cos(0.3 * x) * np.sin(0.2 * y)
    np.savetxt(tmp_path / "map.xyz", np.column_stack([x, y, wave]), fmt="%.15g")
    path = tmp_path / "surface.yaml"
    map_ = "{shape: grid, file: map.xyz, unit: mm}"
    path.write_text(f"shape: sum\nparts:\n- {{shape: sphere, radius: 0.1}}\n- {map_}\n")
    at_x, at_y = np.array([1.23e-3, -4.5e-3]), np.array([2.34e-3, 3.3e-3])
    expected = 1e-6 * np.cos(300 * at_x) * np.sin(200 * at_y)
    expected += 0.1 - np.sqrt(0.01 - at_x**2 - at_y**2)
    np.testing.assert_allclose(load_surface(path).height(at_x, at_y), expected, atol=1e-11)
    path.write_text(f"shape: off_axis_section\ndistance: 1.0e-3\nparent: {map_}\n")
    assert np.isfinite(load_surface(path).height(at_x, at_y)).all()
    path.write_text("shape: sum\nparts:\n- {shape: grid, file: map.xyz}\n")
    with pytest.raises(SurfaceError, match=r"parts\[0\]: grid: .*unit"):
        load_surface(path)


def test_a_hole_in_a_map_is_a_hole_in_the_surface():
    line = np.linspace(-1.0, 1.0, 21)
    height = np.add.outer(line**2, line)
    height[5, 5] = np.nan
    surface = GridSurface(HeightGrid(height=height, x0=-1.0, y0=-1.0, dx=0.1, dy=0.1))
    u = np.array([-0.46, -0.74, 0.43])
    found = surface.height(u, np.array([-0.52, -0.52, 0.2]))
    assert np.isnan(found[0])
    np.testing.assert_allclose(found[1:], [-0.74 + 0.52**2, 0.43 + 0.04], atol=2e-3)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("shape: grid\n", "file is required"),
        ("shape: grid\nfile: none.xyz\n", "none.xyz"),
        ("shape: grid\nfile: points.xyz\nunit: mm\n", "no evenly spaced rows"),
        ("shape: grid\nfile: points.xyz\nunit: cubit\n", "cubit"),
        ("shape: sum\nparts: [{shape: grid, file: a}]\n", r"parts\[0\]: grid: "),
    ],
)
def test_what_is_no_map_is_refused(text, named, tmp_path):
    np.savetxt(tmp_path / "points.xyz", np.random.default_rng(1).uniform(0, 1, (50, 3)))
    path = tmp_path / "surface.yaml"
    path.write_text(text)
    with pytest.raises(SurfaceError, match=named):
        load_surface(path)


@pytest.mark.parametrize(
    "description",
    [
        {"shape": "xy_polynomial", "radius": 1e-4, "terms": [{"x": 20, "y": 20, "value": 10.0}]},
        {"shape": "asphere", "radius": 1e-6, "even_terms": [1e40] * 20, "odd_terms": [1e40] * 20},
        {"shape": "zernike", "radius": 1e-4, "coefficients": [10.0] * 400, "indexing": "noll"},
        {"shape": "q_bfs", "aperture_radius": 1e-4, "coefficients": [10.0] * 20, "radius": 1e5},
        {"shape": "q_con", "aperture_radius": 1e-4, "coefficients": [10.0] * 20},
        {"shape": "toroid", "radius_x": 1e-6, "radius_y": 1e5, "conic_constant": -1e4},
        {"shape": "biconic", "radius_x": 1e-6, "radius_y": -1e-6, "conic_x": 1e4, "conic_y": -1e4},
        {"shape": "sphere", "radius": 1e-6, "pose": {"tip": 3.1}},
        {"shape": "flat", "pose": {"tip": np.pi / 2}},
    ],
)
def test_the_wildest_surface_that_is_accepted_does_not_overflow(description):
    """Warnings are errors here: it has a number or none, on anything that a machine may span."""
    x = np.array([0.0, 1e-3, -5.0, 10.0])
    surface = descriptions.surface_of(description, "it")
    for values in (surface.height(x, x[::-1]), *surface.gradient(x, x[::-1])):
        assert not np.any(np.isinf(values))
