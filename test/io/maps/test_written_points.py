"""Points that are written are read again bit for bit, by a plain reader and by ours."""

import struct

import numpy as np
import plain_readers
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from omsm_ros.core.surface.height_grid import HeightGrid
from omsm_ros.errors import FileError
from omsm_ros.io.maps.columns_file import write_columns
from omsm_ros.io.maps.instrument_files import write_hdf5, write_sdf
from omsm_ros.io.maps.read_map import read_points
from omsm_ros.io.maps.vertex_file import write_pcd, write_ply
from omsm_ros.units import units_of

# Any bits that a place on a machine can have, the sign of zero and the smallest numbers too.
METRES = st.floats(-100, 100)
ROWS = st.lists(st.tuples(METRES, METRES, METRES, st.floats(0, 1e-3)), min_size=1, max_size=8)
NAMES = ("x", "y", "height", "uncertainty")


def bits(values):
    return [struct.pack("<d", value) for value in values]


def table_of(rows, names=("x", "y", "z", "uncertainty")):
    return np.array(rows, [(name, "<f8") for name in names])


def write(path, rows):
    """By the ending; return what a plain reader finds, by role."""
    columns = {f"{n}_m": np.array(v) for n, v in zip(NAMES, zip(*rows, strict=True), strict=True)}
    if path.suffix == ".ply":
        write_ply(path, table_of(rows))
        found = plain_readers.ply(path)
    elif path.suffix == ".pcd":
        write_pcd(path, table_of(rows))
        found = plain_readers.pcd(path)
    else:
        write_columns(path, columns, csv=path.suffix == ".csv")
        found = plain_readers.text(path)
    return {name.removesuffix("_m").replace("z", "height"): v for name, v in found.items()}


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".csv", ".xyz"])
def test_every_bit_is_written_and_read(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"

    @settings(max_examples=25)
    @given(ROWS)
    def holds(rows):
        plain = write(path, rows)
        assert list(plain) == list(NAMES)
        points = read_points(path)
        for place, name in enumerate(NAMES):
            wanted = bits(row[place] for row in rows)
            assert bits(plain[name]) == wanted, name
            assert bits(getattr(points, name)) == wanted, name
        assert points.missing == 0

    holds()


def test_every_bit_of_a_table_is_in_hdf5(tmp_path):
    h5py = pytest.importorskip("h5py", reason="the extra 'formats' is not installed")
    rng = np.random.default_rng(0)
    columns = {name: rng.uniform(-1, 1, 40) for name in ("x", "y", "height")}
    columns |= {"uncertainty": rng.random(40) * 1e-8, "sample": np.arange(40, dtype=np.uint32) * 7}
    columns["intensity"] = rng.random(40).astype(np.float32)
    write_hdf5(tmp_path / "a.h5", columns, "who wrote it")
    with h5py.File(tmp_path / "a.h5", "r") as content:
        assert set(content) == set(columns)
        assert content.attrs["comment"] == "who wrote it"
        for name, values in columns.items():
            assert content[name].dtype == values.dtype
            assert content[name][()].tobytes() == values.tobytes()
            pure = name in ("sample", "intensity")
            assert content[name].attrs["units"] == ("1" if pure else "m")
    points = read_points(tmp_path / "a.h5")
    for name in ("x", "y", "height", "uncertainty"):
        assert getattr(points, name).tobytes() == columns[name].tobytes()
    assert points.sample.tolist() == columns["sample"].tolist()


@pytest.mark.parametrize(
    ("change", "reported"),
    [
        ({"x": np.zeros((2, 2))}, r"shape \(2, 2\), expected 1"),
        ({"height": np.array([b"high", b"low"])}, r"'\|S4', expected numbers"),
        ({"height": np.zeros(3)}, "different lengths .*'height': 3.*; write it again"),
        ({"height": None}, "a.h5' has no column 'height'; write it again"),
    ],
)
def test_a_table_of_ours_that_was_altered_is_reported_by_its_part(tmp_path, change, reported):
    h5py = pytest.importorskip("h5py", reason="the extra 'formats' is not installed")
    path = tmp_path / "a.h5"
    write_hdf5(path, dict.fromkeys(NAMES, np.zeros(2)), "")
    with h5py.File(path, "r+") as content:
        for name, values in change.items():
            del content[name]
            if values is not None:
                content[name] = values
    with pytest.raises(FileError, match=reported) as refused:
        read_points(path)
    assert "a.h5" in str(refused.value)


def test_whole_numbers_and_single_precision_keep_their_digits_in_text(tmp_path):
    """As many digits as tell each number from its neighbours, and no more."""
    third = np.array([1 / 3, 0.1], np.float32)
    columns = {"x_m": third, "y_m": np.array([0.1, 1 / 3]), "height_m": third}
    columns["sample"] = np.array([4294967295, 0], np.uint32)
    write_columns(tmp_path / "a.csv", columns, csv=True)
    lines = (tmp_path / "a.csv").read_text().splitlines()
    assert lines[0] == "x_m,y_m,height_m,sample"
    single, double, _, sample = lines[1].split(",")
    assert sample == "4294967295"
    assert np.float32(single) == third[0]
    assert len(single) <= len("0.333333333")
    assert float(double) == 0.1


def test_more_points_than_one_portion_are_written_in_order(tmp_path):
    count = 100_003
    ramp = np.arange(count, dtype=np.float64) / 2**20
    write_columns(tmp_path / "a.csv", {"x_m": ramp}, csv=True)
    last = (tmp_path / "a.csv").read_text().splitlines()
    assert len(last) == count + 1
    assert [float(line) for line in last[1:]] == ramp.tolist()


@settings(max_examples=25)
@given(ROWS, st.sampled_from(["mm", "um", "nm", "in", "cm", "mm,nm", "m,um"]))
def test_a_unit_scales_places_and_heights_and_nothing_else(tmp_path_factory, rows, unit):
    """The same numbers, named in their unit in the header or beside it, are the same points."""
    folder = tmp_path_factory.mktemp("units")
    lateral, high = (unit.split(",") * 2)[:2]
    body = "\n".join(" ".join(map(repr, row[:3])) for row in rows) + "\n"
    (folder / "said.xyz").write_text(f"x_{lateral} y_{lateral} z_{high}\n{body}")
    (folder / "bare.xyz").write_text(body)
    (folder / "metres.xyz").write_text(f"x_m y_m z_m\n{body}")
    said, bare = read_points(folder / "said.xyz"), read_points(folder / "bare.xyz", units_of(unit))
    base = read_points(folder / "metres.xyz")
    metres = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "nm": 1e-9, "in": 0.0254}
    for name, one in (("x", lateral), ("y", lateral), ("height", high)):
        assert getattr(said, name).tolist() == getattr(bare, name).tolist()
        assert getattr(said, name).tolist() == [v * metres[one] for v in getattr(base, name)]


@pytest.mark.parametrize("name", ["a.ply", "a.pcd"])
def test_what_is_not_ours_has_no_uncertainty_and_no_order(tmp_path, name):
    """A column of that name in another program's unit would be taken for metres."""
    rows = [(0.5, 1.5, 2.5, 0.1, 3.0), (3.5, 4.5, 5.5, 0.2, 4.0)]
    table = table_of(rows, ("x", "y", "z", "uncertainty", "sample"))
    (write_ply if name == "a.ply" else write_pcd)(tmp_path / name, table)
    ours = read_points(tmp_path / name)
    assert ours.uncertainty.tolist() == [0.1, 0.2]
    assert ours.sample.tolist() == [3, 4]
    raw = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(raw.replace(b"lengths in metres", b"lengths in furlongs", 1))
    theirs = read_points(tmp_path / name, units_of("mm"))
    assert theirs.uncertainty is None
    assert theirs.sample is None
    assert theirs.height.tolist() == [2.5e-3, 5.5e-3]


def test_an_uncertainty_that_nobody_knows_is_none(tmp_path):
    rows = [(0.0, 1.0, 2.0, float("nan")), (3.0, 4.0, 5.0, float("nan"))]
    write_ply(tmp_path / "a.ply", table_of(rows))
    assert read_points(tmp_path / "a.ply").uncertainty is None
    write_ply(tmp_path / "a.ply", table_of([rows[0], (3.0, 4.0, 5.0, 1e-9)]))
    with pytest.raises(FileError, match=r"uncertainty\[0\] is nan m"):
        read_points(tmp_path / "a.ply")


def test_a_file_that_fails_on_the_way_is_not_there(tmp_path):
    """An earlier file of its name stays unchanged."""
    (tmp_path / "a.csv").write_text("mine")
    with pytest.raises(KeyError):
        write_columns(tmp_path / "a.csv", Failing(x_m=np.zeros(2)), csv=True)
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("a.csv", "mine")]


class Failing(dict):
    """Columns that cannot be had twice."""

    def values(self):
        raise KeyError("gone")


def test_a_written_sdf_is_laid_out_by_iso_25178_71(tmp_path):
    """Read by the words of the standard: header, ``*``, one number a point, BAD for a lost one."""
    height = np.arange(12.0).reshape(3, 4) * 1e-9
    height[1, 2] = np.nan
    write_sdf(tmp_path / "a.sdf", HeightGrid(height=height, x0=0.0, y0=0.0, dx=2e-6, dy=3e-6))
    head, body, end = (tmp_path / "a.sdf").read_text().split("*")
    version, *lines = head.split("\n")
    fields = dict(line.split(" = ") for line in lines if line)
    assert (version, end.strip()) == ("aISO-1.0", "")
    assert (fields["NumPoints"], fields["NumProfiles"]) == ("4", "3")
    assert (float(fields["Xscale"]), float(fields["Yscale"])) == (2e-6, 3e-6)
    found = np.array([np.nan if w == "BAD" else float(w) for w in body.split()]).reshape(3, 4)
    np.testing.assert_allclose(found * float(fields["Zscale"]), height)
