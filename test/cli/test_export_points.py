"""Exported files hold the same numbers, in the format and units of other programs."""

import csv
import json
import shutil
import struct

import numpy as np
import pytest

from omsm_ros.cli import main
from omsm_ros.cli.command_line import BAD_INPUT, DONE
from omsm_ros.cli.export import AS_MAP, AS_POINTS, export
from omsm_ros.core.correction.surface_points import SurfacePoints
from omsm_ros.errors import FileError
from omsm_ros.io.maps.read_map import read_points
from omsm_ros.io.results import PlyWriter


def height(x, y):
    return 0.02 * x + (x**2 + y**2) / 0.1 + 1e-6 * np.sin(700 * x)


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    folder = tmp_path_factory.mktemp("result")
    turn = np.linspace(0, 80 * np.pi, 12_000)
    radius = 5e-3 * (1 - turn / turn[-1])
    x, y = radius * np.cos(turn), radius * np.sin(turn)
    points = SurfacePoints(
        sample=np.arange(12_000) + 7,
        x=x,
        y=y,
        height=height(x, y),
        dynamic_error=1e-8 * x,
        uncertainty=np.full(12_000, 1e-8),
        intensity=np.full(12_000, 0.5, np.float32),
    )
    with PlyWriter(folder / "cloud.ply") as writer:
        writer.write(points)
    return folder


@pytest.mark.parametrize("suffix", AS_POINTS)
def test_points_come_back_from_every_format_without_asking(result, tmp_path, suffix):
    if "h5" in suffix or "hdf5" in suffix:
        pytest.importorskip("h5py", reason="the extra 'formats' is not installed")
    done = export(result, tmp_path / f"out{suffix}")
    assert done["points"] == 12_000
    ours, back = read_points(result), read_points(tmp_path / f"out{suffix}")
    assert np.array_equal(back.height, ours.height)
    assert back.x == pytest.approx(ours.x, rel=1e-8)  # single precision
    assert back.uncertainty == pytest.approx(ours.uncertainty, rel=1e-8)
    if suffix != ".xyz":
        assert back.sample.tolist()[:2] == [7, 8]


@pytest.mark.parametrize("suffix", [suffix for suffix in AS_MAP if suffix != ".sdf"])
def test_a_map_lies_on_the_surface(result, tmp_path, suffix):
    if suffix == ".x3p":
        pytest.importorskip("x3pio", reason="the extra 'formats' is not installed")
    done = export(result, tmp_path / f"out{suffix}")
    back = read_points(tmp_path / f"out{suffix}")
    assert len(back) == done["rows"] * done["columns"] - done["missing"]
    error = back.height - height(back.x, back.y)
    # The cloud keeps x and y in single precision, which on a slope of 0.1 is 0.06 nm.
    assert np.sqrt(np.mean(error**2)) < 2 * done["interpolation_error"] + 0.1e-9
    assert done["interpolation_error"] < 1e-9
    # The whole aperture has heights.
    area = len(back) * done["spacing"][0] * done["spacing"][1]
    assert area == pytest.approx(np.pi * 25e-6, rel=0.08)


def test_a_map_is_not_interpolated(tmp_path):
    pytest.importorskip("x3pio", reason="the extra 'formats' is not installed")
    x, y = (part.ravel() for part in np.meshgrid(np.arange(9.0), np.arange(6.0)))
    z = np.random.default_rng(0).random(54)
    np.savetxt(tmp_path / "a.xyz", np.column_stack([x, y, z]), header="x_mm y_mm z_nm")
    done = export(tmp_path / "a.xyz", tmp_path / "a.x3p")
    assert (done["rows"], done["columns"], done["interpolation_error"]) == (6, 9, 0.0)
    assert done["resampling"].startswith("none")
    assert read_points(tmp_path / "a.x3p").height == pytest.approx(z * 1e-9, abs=1e-18)


def test_csv_is_for_any_program(result, tmp_path):
    export(result, tmp_path / "out.csv")
    with open(tmp_path / "out.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert set(rows[0]) == {
        "x_m", "y_m", "height_m", "dynamic_error_m", "uncertainty_m", "intensity", "sample",
    }  # fmt: skip
    ours = read_points(result)
    assert float(rows[99]["height_m"]) == ours.height[99]
    assert rows[99]["sample"] == "106"


def test_hdf5_says_its_units(result, tmp_path):
    h5py = pytest.importorskip("h5py", reason="the extra 'formats' is not installed")
    export(result, tmp_path / "out.h5")
    with h5py.File(tmp_path / "out.h5") as content:
        units = {name: content[name].attrs["units"] for name in content}
    assert units["height"] == units["x"] == "m"
    assert units["sample"] == "1"


def test_pcd_is_read_by_its_own_words(result, tmp_path):
    """Read the file by its header, as an independent reader does."""
    export(result, tmp_path / "out.pcd")
    head, _, body = (tmp_path / "out.pcd").read_bytes().partition(b"DATA binary\n")
    words = dict(line.split(b" ", 1) for line in head.splitlines() if not line.startswith(b"#"))
    kinds = {b"F4": "f", b"F8": "d", b"U4": "I"}
    form = "<" + "".join(
        kinds[kind + size]
        for kind, size in zip(words[b"TYPE"].split(), words[b"SIZE"].split(), strict=True)
    )
    rows = list(struct.iter_unpack(form, body))
    assert len(rows) == int(words[b"POINTS"])
    place = words[b"FIELDS"].split().index(b"height")
    assert rows[5][place] == read_points(result).height[5]


def test_other_programs_read_what_we_write(result, tmp_path):
    """Read with an independent library, which keeps the places of SDF without a height."""
    topography = pytest.importorskip("SurfaceTopography", reason="a peer, for x3p and SDF")
    for name in ("out.x3p", "out.sdf"):
        export(result, tmp_path / name)
        read = topography.open_topography(str(tmp_path / name)).topography().to_unit("m")
        theirs = np.sort(np.ma.compressed(np.ma.masked_greater(read.heights(), 1.0)))
        assert theirs == pytest.approx(np.sort(read_points(tmp_path / name).height), abs=1e-15)


def test_the_command_tells_what_it_did(result, tmp_path, capsys):
    assert main(["export", str(result), "--out", str(tmp_path / "a.dat"), "--json"]) == DONE
    facts = json.loads(capsys.readouterr().out)
    assert facts["points"] == 12_000
    assert facts["interpolation_error"] < 1e-9
    assert main(["export", str(result), "--out", str(tmp_path / "b.dat")]) == DONE
    shown = capsys.readouterr().out
    assert "local quadratic" in shown
    assert "nm rms" in shown


@pytest.mark.parametrize(
    ("arguments", "reported"),
    [
        (["--out", "a.stl"], "'.stl' of 'a.stl' is unknown, expected one of .csv"),
        (["--out", "a.x3p", "--spacing", "1e-12"], "spacing"),
        (["--out", "a.csv", "--unit", "ell"], "unit 'ell' is not known"),
        (["--out", "a.dat", "--spacing", "1e-8"], "widen --spacing"),
    ],
)
def test_a_wrong_wish_is_one_line(result, tmp_path, monkeypatch, capsys, arguments, reported):
    monkeypatch.chdir(tmp_path)
    assert main(["export", str(result), *arguments]) == BAD_INPUT
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert reported in lines[0]
    assert not list(tmp_path.iterdir())


def test_a_cloud_that_was_cut_short_is_not_exported(result, tmp_path):
    shutil.copy(result / "cloud.ply", tmp_path / "cloud.ply")
    raw = (tmp_path / "cloud.ply").read_bytes()
    (tmp_path / "cloud.ply").write_bytes(raw[:-5])
    with pytest.raises(FileError, match="cut short"):
        export(tmp_path, tmp_path / "out.csv")
