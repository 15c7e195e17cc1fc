"""x3p written and read by zip, XML and struct alone, after ISO 25178-72."""

import hashlib
import math
import struct
import zipfile

import numpy as np
import plain_readers
import pytest

from omsm_ros.core.surface.height_grid import HeightGrid
from omsm_ros.errors import FileError
from omsm_ros.io.maps.instrument_files import write_x3p
from omsm_ros.io.maps.read_map import read_points

from .surfaces import by_place, grid

pytest.importorskip("x3pio", reason="the extra 'formats' is not installed")

AXIS = "<{0}><AxisType>{1}</AxisType><DataType>{2}</DataType>{3}</{0}>"
MAIN = """<?xml version="1.0" encoding="UTF-8"?>
<p:ISO5436_2 xmlns:p="http://www.opengps.eu/2008/ISO5436_2">
<Record1><Revision>ISO5436 - 2000</Revision><FeatureType>{feature}</FeatureType>
<Axes>{axes}{rotation}</Axes></Record1>
<Record2><Date>2026-01-01T00:00:00</Date><Instrument><Manufacturer>M</Manufacturer><Model>O</Model>
<Serial>1</Serial><Version>1</Version></Instrument>
<CalibrationDate>2026-01-01T00:00:00</CalibrationDate>
<ProbingSystem><Type>NonContacting</Type><Identification>I</Identification></ProbingSystem>
</Record2>
<Record3><MatrixDimension><SizeX>{size[0]}</SizeX><SizeY>{size[1]}</SizeY><SizeZ>{size[2]}</SizeZ>
</MatrixDimension><DataLink><PointDataLink>bindata/data.bin</PointDataLink>
<MD5ChecksumPointData>{md5}</MD5ChecksumPointData></DataLink></Record3>
<Record4><ChecksumFile>md5checksum.hex</ChecksumFile></Record4></p:ISO5436_2>
"""


def numbers(increment, offset=None):
    said = f"<Increment>{increment!r}</Increment>" if increment is not None else ""
    return said + (f"<Offset>{offset!r}</Offset>" if offset is not None else "")


def made(path, values, kind="D", *, z=(None, None), x=(2e-6, 0.0), layers=1, rotation="", md5=""):
    """A map of ``values`` (rows, columns), 2 µm by 3 µm; with its checksums."""
    form = {"I": "h", "L": "i", "F": "f", "D": "d"}[kind]
    rows, columns = np.shape(values)
    data = struct.pack(f"<{rows * columns}{form}", *np.ravel(values)) * layers
    axes = AXIS.format("CX", "I", "D", numbers(*x)) + AXIS.format(
        "CY", "I", "D", numbers(3e-6, 0.0)
    )
    axes += AXIS.format("CZ", "A", kind, numbers(*z))
    md5 = md5 or hashlib.md5(data).hexdigest()
    main = MAIN.format(
        feature="SUR", axes=axes, rotation=rotation, size=(columns, rows, layers), md5=md5
    ).encode()
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("main.xml", main)
        archive.writestr("bindata/data.bin", data)
        archive.writestr("md5checksum.hex", hashlib.md5(main).hexdigest() + " *main.xml")
    return path


def test_ours_by_the_words_of_the_standard(tmp_path):
    ours = grid()
    write_x3p(tmp_path / "a.x3p", ours, "a <comment> & more")
    root, axes, rows = plain_readers.x3p(tmp_path / "a.x3p")
    assert (len(rows), len(rows[0])) == ours.height.shape
    for row, wanted in zip(rows, ours.height.tolist(), strict=True):
        assert row == [None if math.isnan(v) else v for v in wanted]
    for name, step, start in (("CX", ours.dx, ours.x0), ("CY", ours.dy, ours.y0)):
        assert axes[name]["AxisType"] == "I"
        assert float(axes[name]["Increment"]) == step
        assert float(axes[name]["Offset"]) == start
    assert root.find("Record2/Comment").text == "a <comment> & more"
    assert root.find("Record2/Instrument/Manufacturer").text == "omsm_ros"


@pytest.mark.parametrize("kind", ["D", "F"])
def test_heights_are_metres_x_runs_first_and_then_y(tmp_path, kind):
    values = np.array([[1.5, 2.5, math.nan], [4.5, -5.5, 6.5]]) / 2**20
    points = read_points(made(tmp_path / "a.x3p", values, kind))
    assert points.missing == 1
    assert points.height.tolist() == [v / 2**20 for v in (1.5, 2.5, 4.5, -5.5, 6.5)]
    assert points.x.tolist() == [0.0, 2e-6, 0.0, 2e-6, 4e-6]
    assert points.y.tolist() == [0.0, 0.0, 3e-6, 3e-6, 3e-6]


@pytest.mark.parametrize("kind", ["I", "L"])
@pytest.mark.parametrize("offset", [None, 2.5e-6])
def test_whole_numbers_count_increments_from_the_offset(tmp_path, kind, offset):
    values = np.array([[100, -200], [32000, 7]])
    points = read_points(made(tmp_path / "a.x3p", values, kind, z=(5e-10, offset)))
    wanted = [v * 5e-10 + (offset or 0.0) for v in (100, -200, 32000, 7)]
    assert points.height == pytest.approx(wanted, abs=1e-21)


@pytest.mark.parametrize("kind", ["I", "L"])
def test_whole_numbers_without_an_increment_are_no_lengths(tmp_path, kind):
    path = made(tmp_path / "a.x3p", np.array([[1, 2], [3, 4]]), kind)
    with pytest.raises(FileError, match=r"a.x3p.*without an increment; save it with one"):
        read_points(path)


def test_an_offset_of_x_moves_the_map(tmp_path):
    path = made(tmp_path / "a.x3p", np.ones((2, 2)), x=(2e-6, 1e-3))
    assert read_points(path).x == pytest.approx([1e-3, 1.002e-3] * 2, abs=1e-18)


def test_a_quarter_turn_is_applied(tmp_path):
    """About z: x goes where y was, y where −x was; heights stay."""
    turn = "".join(
        f"<r{i + 1}{j + 1}>{v}</r{i + 1}{j + 1}>"
        for i, row in enumerate([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
        for j, v in enumerate(row)
    )
    values = np.array([[1.0, 2.0], [3.0, 4.0]]) * 1e-6
    path = made(tmp_path / "a.x3p", values, rotation=f"<Rotation>{turn}</Rotation>")
    points = read_points(path)
    assert points.x == pytest.approx([0, 0, -3e-6, -3e-6], abs=1e-18)
    assert points.y == pytest.approx([0, 2e-6, 0, 2e-6], abs=1e-18)
    assert points.height.tolist() == values.ravel().tolist()


def test_of_two_layers_the_first_is_read_and_a_note_says_so(tmp_path):
    points = read_points(made(tmp_path / "a.x3p", np.ones((2, 3)) * 1e-6, layers=2))
    assert len(points) == 6
    assert points.notes == (
        "channel 0, 'layer 0'; --channel selects another one of 0 'layer 0', 1 'layer 1'",
    )


def test_data_that_do_not_have_their_checksum_are_refused(tmp_path):
    path = made(tmp_path / "a.x3p", np.ones((2, 2)), md5="0" * 32)
    with pytest.raises(FileError, match=r"a.x3p' cannot be read: .*save it again"):
        read_points(path)


def test_places_listed_one_by_one_are_refused(tmp_path):
    path = made(tmp_path / "a.x3p", np.ones((2, 2)))
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    main = parts["main.xml"].replace(b"<CX><AxisType>I", b"<CX><AxisType>A")
    parts |= {"main.xml": main, "md5checksum.hex": hashlib.md5(main).hexdigest().encode()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in parts.items():
            archive.writestr(name, content)
    with pytest.raises(FileError, match="cannot be read"):
        read_points(path)


def test_written_and_read_is_the_same_map_wherever_it_lies(tmp_path):
    rng = np.random.default_rng(1)
    for place in range(5):
        ours = HeightGrid(
            height=rng.normal(size=(3 + place, 4)) * 1e-6,
            x0=rng.uniform(-1, 1), y0=rng.uniform(-1, 1), dx=1e-4, dy=2e-4,
        )  # fmt: skip
        write_x3p(tmp_path / "a.x3p", ours, "")
        back = read_points(tmp_path / "a.x3p")
        np.testing.assert_array_equal(by_place(back)[:, 2], by_place(ours.points())[:, 2])
        np.testing.assert_allclose(by_place(back), by_place(ours.points()), rtol=0, atol=1e-15)
