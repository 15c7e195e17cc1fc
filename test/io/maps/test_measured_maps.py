"""Maps that others measured, with the figures that were published with them."""

import json
from pathlib import Path

import numpy as np
import pytest

from omsm_ros.core.form.analyse import analyse_form
from omsm_ros.core.registration.placement import PointBatch
from omsm_ros.core.surface.height_grid import as_grid
from omsm_ros.core.surface.nominal import Flat
from omsm_ros.errors import FileError
from omsm_ros.io.maps.read_map import read_points
from omsm_ros.units import LengthUnits

DATA = Path(__file__).parents[4] / "shared" / "data" / "surfaces"
pytestmark_data = pytest.mark.skipif(
    not DATA.is_dir(), reason="the measured maps are not on this machine"
)


@pytestmark_data
def test_the_zeiss_map():
    points = read_points(DATA / "zeiss_19-0057_vfm.asc")
    assert np.ptp(points.height) == pytest.approx(19.2e-9, abs=0.05e-9)
    grid = as_grid(points)
    assert grid.height.shape == (81, 681)
    u, v = points.x / 0.25, points.y / 0.015
    design = np.stack([u**i * v**j for i in range(3) for j in range(3 - i)], axis=1)
    rest = points.height - design @ np.linalg.lstsq(design, points.height, rcond=None)[0]
    assert np.ptp(rest) == pytest.approx(8.95e-9, abs=0.005e-9)
    assert np.std(rest) == pytest.approx(1.52e-9, abs=0.005e-9)


def _described(name):
    return json.loads((DATA / "dabam" / f"dabam-{name}.txt").read_text())


@pytestmark_data
def test_a_dabam_profile_of_heights():
    header = _described("012")
    points = read_points(DATA / "dabam" / "dabam-012.dat")
    assert np.ptp(points.x) == pytest.approx(header["LENGTH_OPTICAL"], abs=1e-3)
    # The header's figures are of the residual, whose columns the file repeats beside.
    raw = np.loadtxt(DATA / "dabam" / "dabam-012.dat", skiprows=1)
    slope = np.std(raw[:, 4])
    assert slope == pytest.approx(header["CALC_SLOPE_RMS"], rel=2e-3)
    best = points.height - np.polyval(np.polyfit(points.x, points.height, 2), points.x)
    assert np.std(best) == pytest.approx(header["CALC_HEIGHT_RMS"] * 1e-9, rel=0.1)


@pytestmark_data
def test_a_dabam_profile_of_slopes():
    header, path = _described("018"), DATA / "dabam" / "dabam-018.dat"
    points = read_points(path)
    assert "its slopes were integrated" in points.notes[0]
    assert np.ptp(points.x) == pytest.approx(header["LENGTH_OPTICAL"], abs=1e-3)
    columns = np.loadtxt(path, skiprows=header["FILE_HEADER_LINES"], usecols=(0, 1)).T
    position, slope = columns * [[header["X1_FACTOR"]], [header["Y1_FACTOR"]]]
    # Its own text says 24.4 km and, less that circle, 0.12 µrad of residual slope.
    line = np.polyfit(position, slope, 1)
    assert 1 / line[0] == pytest.approx(24.4e3, rel=0.02)
    rest = slope - np.polyval(line, position)
    stated = header["CALC_SLOPE_RMS"] * header["CALC_SLOPE_RMS_FACTOR"]
    assert np.std(rest) == pytest.approx(stated, rel=0.05)
    back = np.gradient(points.height, points.x)[1:-1]
    assert back == pytest.approx(slope[1:-1], abs=0.1e-6)


@pytestmark_data
@pytest.mark.parametrize(
    ("name", "rms", "extent", "slope"),
    [("012", 2.503e-9, 11.535e-9, 0.3188e-6), ("018", 1.7556e-9, 7.087e-9, 0.12e-6)],
)
def test_the_form_of_a_profile_is_what_its_file_and_a_parabola_say(name, rms, extent, slope):
    """Height less a parabola by numpy alone; slope as the header has it, of points 1 mm apart."""
    points = read_points(DATA / "dabam" / f"dabam-{name}.dat")
    portion = PointBatch(points.x, points.y, points.height, np.empty((0, len(points))))
    found = analyse_form(Flat(), lambda: [portion], ("piston", "tilt")).deviation
    for figure, truth in (
        ("rms_without_second_order", rms),
        ("peak_to_valley_without_second_order", extent),
        ("slope_rms_without_second_order", slope),
    ):
        off = abs(found[figure].value - truth)
        assert off < 2 * found[figure].uncertainty + 0.02 * truth, figure


HEADER = '{"FILE_FORMAT": 2, "FILE_HEADER_LINES": 1, "X1_FACTOR": 0.001, "Y1_FACTOR": 1e-9}'


def _dabam(folder, header=HEADER, data="x h r\n0 1 9\n1 2 9\n2 4 9\n"):
    (folder / "p.txt").write_text(header)
    (folder / "p.dat").write_text(data)
    return folder / "p.dat"


def test_factors_of_the_header_hold(tmp_path):
    points = read_points(_dabam(tmp_path))
    assert points.x == pytest.approx([0, 1e-3, 2e-3])
    assert points.height == pytest.approx([1e-9, 2e-9, 4e-9])


def test_slopes_of_a_circle_integrate_to_it(tmp_path):
    x = np.linspace(-100, 100, 401)
    data = "x s\n" + "".join(f"{a} {a * 2.0}\n" for a in x)
    header = HEADER.replace('FORMAT": 2', 'FORMAT": 1').replace("1e-9", "1e-6")
    points = read_points(_dabam(tmp_path, header, data))
    circle = points.x**2 / (2 * 500)  # 2 µrad/mm is a radius of 500 m
    assert points.height - points.height.min() == pytest.approx(circle, abs=1e-12)


@pytest.mark.parametrize(
    ("header", "data", "reported"),
    [
        (HEADER.replace('FORMAT": 2', 'FORMAT": 7'), None, "FILE_FORMAT 7"),
        (HEADER.replace("0.001", "null"), None, "factors"),
        (HEADER.replace("1e-9", "0"), None, "factors"),
        (HEADER, "x h\n1 2\n3 four\n", "line 3: '3 four' is no row"),
        (HEADER, "x h\n", "no points"),
    ],
)
def test_a_profile_that_does_not_fit_its_header(tmp_path, header, data, reported):
    path = _dabam(tmp_path, header, *([] if data is None else [data]))
    with pytest.raises(FileError, match=reported):
        read_points(path)


def test_two_columns_are_a_profile_and_a_matrix_is_no_table(tmp_path):
    profile, matrix = tmp_path / "p.csv", tmp_path / "m.txt"
    profile.write_text("x [mm],height [nm]\n" + "".join(f"{k},{2 * k}\n" for k in range(30)))
    found = read_points(profile)
    assert len(found) == 30
    assert not np.any(found.y)
    np.testing.assert_allclose(found.height, 2e-9 * np.arange(30))
    np.testing.assert_allclose(found.x, 1e-3 * np.arange(30))
    np.savetxt(matrix, np.ones((20, 20)))
    with pytest.raises(FileError, match="matrix"):
        read_points(matrix, LengthUnits(1e-3, 1e-9))


def test_a_negative_factor_turns_the_profile(tmp_path):
    header = '{"FILE_FORMAT": 2, "FILE_HEADER_LINES": 0, "X1_FACTOR": 0.001, "Y1_FACTOR": -1e-9}'
    path = _dabam(tmp_path, header, "1 2\n2 3\n3 5\n")
    np.testing.assert_allclose(read_points(path).height, [-2e-9, -3e-9, -5e-9])
