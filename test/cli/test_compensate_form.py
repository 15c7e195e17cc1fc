"""A simulated corrective cut removes the form error and leaves only shorter waves."""

import contextlib
import io
import json

import numpy as np
import pytest
from scipy.interpolate import LinearNDInterpolator

from omsm_ros.cli import main
from omsm_ros.core.kinematics.kinematics import workpiece_xy
from omsm_ros.core.surface.nominal import PAPER_MIRROR, ZernikeSurface
from omsm_ros.io.descriptions import load_surface

RADIUS = 12.7e-3
FORM = ZernikeSurface(RADIUS, (0, 0, 0, 40e-9, 0, 50e-9, 0, 15e-9, 20e-9))


def error(x, y):
    """Form that a cut can remove, and ripple that it cannot."""
    return FORM.height(x, y) + 4e-9 * np.sin(2 * np.pi * np.hypot(x, y) / 0.8e-3)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cut")
    n = 15_000
    r, angle = np.linspace(RADIUS, 0, n), np.linspace(0, 200 * np.pi, n)
    x, y = r * np.cos(angle), r * np.sin(angle)
    noise = np.random.default_rng(1).normal(0, 1e-8, n)
    height = PAPER_MIRROR.height(x, y) + error(x, y) + noise
    np.savetxt(folder / "part.xyz", np.stack([x, y, height], axis=1), fmt="%.15g")
    (folder / "mirror.yaml").write_text(
        "shape: off_axis_paraboloid\nparent_focal_length: 0.0254\noff_axis_distance: 0.0508\n"
    )
    return folder


def compensate(folder, out, *more):
    words = ["compensate", folder / "part.xyz", "--nominal", folder / "mirror.yaml", "--unit", "m"]
    words += ["--fit", "piston,tip,tilt", "--out", out, *more]
    return main([str(word) for word in words])


@pytest.fixture(scope="module")
def cut(folder, tmp_path_factory):
    """Facts and folder of a compensation along a spiral."""
    out, said = tmp_path_factory.mktemp("compensation"), io.StringIO()
    with contextlib.redirect_stdout(said):
        words = ("--low-pass", "0.004", "--spiral", "4e-4", "--tool-radius", "0.005", "--json")
        assert compensate(folder, out, *words) == 0
    return json.loads(said.getvalue()), out


def test_one_cut_leaves_what_is_finer_than_the_low_pass(folder, cut):
    facts, out = cut
    table = np.loadtxt(out / "compensation.csv", delimiter=",", skiprows=1)
    assert len(table) == facts["places"]
    taken_off = LinearNDInterpolator(table[:, :2], table[:, 2])
    x, y = np.random.default_rng(2).uniform(-0.65 * RADIUS, 0.65 * RADIUS, (2, 20_000))
    before = error(x, y)
    after = before + taken_off(x, y)
    after = after - after.mean()
    ripple = 4e-9 / np.sqrt(2)
    assert np.std(before) > 5 * ripple
    assert np.std(after) == pytest.approx(ripple, rel=0.35)
    assert load_surface(folder / "mirror.yaml") == PAPER_MIRROR
    # The ripple and the remainder of the filter at the rim; before the cut, squares add up.
    assert ripple < facts["rms_after"] < 7e-9
    assert facts["rms_before"] == pytest.approx(33e-9, rel=0.1)
    # The difference from the filtered form without noise is the filtered noise.
    x, y, offset, spread = table[np.hypot(table[:, 0], table[:, 1]) < 0.6 * RADIUS].T
    off = offset + FORM.height(x, y)
    assert np.std(off) < 4 * np.median(spread)
    assert 1e-10 < np.median(spread) < 2e-9


@pytest.mark.soak
def test_what_will_be_left_holds_marks_finer_than_the_table(tmp_path, capsys):
    """Tool marks of a quarter of a table cell cannot be compensated."""
    r, angle = RADIUS * (1 - np.arange(20_000) / 20_000), np.arange(20_000) * 0.06
    x, y = r * np.cos(angle), r * np.sin(angle)
    marks = 20e-9 * np.cos(2 * np.pi * r / 2.4e-4)
    noise = np.random.default_rng(3).normal(0, 5e-9, len(x))
    height = r**2 / 0.2 + 60e-9 * (x**2 - y**2) / RADIUS**2 + marks + noise
    np.savetxt(tmp_path / "part.xyz", np.stack([x, y, height], axis=1), fmt="%.15g")
    (tmp_path / "mirror.yaml").write_text("shape: asphere\nradius: 0.1\nconic_constant: -1\n")
    assert compensate(tmp_path, tmp_path / "out", "--low-pass", "0.004", "--json") == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["rms_after"] == pytest.approx(20e-9 / np.sqrt(2), rel=0.1)


def test_a_low_pass_finer_than_the_points_is_refused(folder, tmp_path, capsys):
    assert compensate(folder, tmp_path / "out", "--low-pass", "0.0001") == 2
    assert "finer than the points resolve" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_tool_takes_the_form_off_along_its_spiral(cut):
    """Interpret the G-code as a controller does, at the point under the tool."""
    facts, out = cut
    lines = (out / "compensation.nc").read_text().splitlines()
    assert "millimetres" in lines[2]
    moves = [[float(word[1:]) for word in line.split()] for line in lines if line[0] == "X"]
    assert len(moves) == facts["path_places"]
    radius, angle, offset = np.array(moves).T * [[1e-3], [np.pi / 180], [1e-3]]
    part = workpiece_xy(radius, np.zeros(len(radius)), angle)
    before = error(*part)
    inner = radius < 0.65 * RADIUS
    # Points of the spiral are closer together near its centre.
    weights = radius[inner]
    rms = []
    for left in (before[inner], (before + offset)[inner]):
        level = np.average(left, weights=weights)
        rms.append(np.sqrt(np.average((left - level) ** 2, weights=weights)))
    assert rms[0] > 3 * rms[1]
    assert rms[1] == pytest.approx(4e-9 / np.sqrt(2), rel=0.35)
    assert facts["warnings"] == []
    assert facts["significant_share"] > 0.8


@pytest.mark.soak
def test_offsets_below_their_uncertainty_are_warned_of(folder, tmp_path, capsys):
    """A shift that cannot be separated from form is uncertain by tens of nanometres."""
    words = ("--low-pass", "0.004", "--fit", "auto", "--json")
    assert compensate(folder, tmp_path, *words) == 0
    facts = json.loads(capsys.readouterr().out)
    assert "less than twice its uncertainty" in facts["warnings"][0]


@pytest.mark.soak
def test_a_spiral_too_fine_for_a_controller_is_refused(folder, tmp_path, capsys):
    assert compensate(folder, tmp_path / "o", "--low-pass", "0.004", "--spiral", "1e-8") == 2
    assert "take a wider feed" in capsys.readouterr().err


def test_a_complete_program_is_written(cut):
    facts, out = cut
    program = (out / "cut.nc").read_text().splitlines()
    assert sum(line.startswith("G1 ") for line in program) > 500
    assert program[-1] == "M2"
    assert facts["path_error"] < 1e-7


def after_a_cut(folder, cut, out, share, *more):
    """Compensate the part again after a cut that took off ``share`` of its form."""
    points = np.loadtxt(folder / "part.xyz")
    points[:, 2] -= share * FORM.height(points[:, 0], points[:, 1])
    np.savetxt(out / "part.xyz", points, fmt="%.15g")
    (out / "mirror.yaml").write_text((folder / "mirror.yaml").read_text())
    previous = ("--previous", cut[1] / "compensation.csv")
    return compensate(out, out / "again", "--low-pass", "0.004", *previous, *more)


def test_after_a_cut_with_the_wrong_sign_the_next_one_is_refused(folder, cut, tmp_path, capsys):
    assert after_a_cut(folder, cut, tmp_path, -1.0) == 2
    assert "sign" in capsys.readouterr().err
    assert not (tmp_path / "again" / "cut.nc").exists()


@pytest.mark.soak
def test_the_effect_of_the_last_cut_is_stated(folder, cut, tmp_path, capsys):
    assert after_a_cut(folder, cut, tmp_path, 0.9, "--json") == 0
    assert json.loads(capsys.readouterr().out)["last_cut"] == pytest.approx(0.9, abs=0.05)
