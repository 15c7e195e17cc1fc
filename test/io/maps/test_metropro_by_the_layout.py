"""MetroPro: the header's own numbers, one at a time, against exact arithmetic."""

import struct
from fractions import Fraction

import numpy as np
import pytest

from omsm_ros.errors import FileError
from omsm_ros.io.maps.read_map import read_points

PLACES = {
    "header": (">I", 6, 834), "grey width": (">H", 52, 0), "grey height": (">H", 54, 0),
    "greys": (">H", 56, 0), "width": (">H", 68, 3), "height": (">H", 70, 2),
    "scale": (">f", 164, 0.5), "wavelength": (">f", 168, 6.328e-7), "obliquity": (">f", 176, 1.0),
    "pixel": (">f", 184, 1e-5), "resolution": (">h", 218, 1), "sign": (">h", 232, 0),
}  # fmt: skip
PHASE = [[5, -7, 1000], [2147483639, 2147483640, -2147483648]]


def written(path, phase=PHASE, extra=b"", **changes):
    """A file with its entries as ``changes`` have them; underscores are blanks."""
    size = {name.replace("_", " "): value for name, value in changes.items()}
    head = bytearray(max(size.get("header", 834), 834))
    head[:4] = bytes([0x88, 0x1B, 0x03, 0x6F])
    for name, (form, place, value) in PLACES.items():
        struct.pack_into(form, head, place, size.get(name, value))
    body = b"".join(struct.pack(">i", v) for row in phase for v in row)
    path.write_bytes(bytes(head) + extra + body)
    return path


def single(value):
    return Fraction(struct.unpack(">f", struct.pack(">f", value))[0])


@pytest.mark.parametrize(
    ("entry", "value"), [("scale", 0.25), ("wavelength", 1.55e-6), ("obliquity", 1.1)]
)
def test_a_height_is_the_product_of_its_entries(tmp_path, entry, value):
    points = read_points(written(tmp_path / "a.dat", **{entry: value}))
    factor = Fraction(1, 32768)
    for name in ("scale", "wavelength", "obliquity"):
        factor *= single(value if name == entry else PLACES[name][2])
    # The rows from below: the file begins with the upper one.
    wanted = [float(factor * phase) for phase in (2147483639, -2147483648, 5, -7, 1000)]
    assert points.height.tolist() == pytest.approx(wanted, rel=1e-14)
    assert points.missing == 1


def test_places_are_pixels_from_the_lower_left(tmp_path):
    points = read_points(written(tmp_path / "a.dat", pixel=2.5e-5))
    pixel = float(single(2.5e-5))
    assert points.x.tolist() == [0, 2 * pixel, 0, pixel, 2 * pixel]
    assert points.y.tolist() == [0, 0, pixel, pixel, pixel]


@pytest.mark.parametrize("header", [834, 4096])
def test_the_points_begin_where_header_and_greys_end(tmp_path, header):
    """Values that cannot be phases stand before them."""
    greys = b"\x7f\xff" * (4 * 3 * 2)
    path = written(
        tmp_path / "a.dat", extra=greys, header=header, grey_width=4, grey_height=3, greys=2
    )
    assert read_points(path).height.tolist() == read_points(
        written(tmp_path / "b.dat")
    ).height.tolist()  # fmt: skip


def test_an_inverted_sign_negates_each_height(tmp_path):
    upright = read_points(written(tmp_path / "a.dat"))
    inverted = read_points(written(tmp_path / "b.dat", sign=1))
    np.testing.assert_array_equal(inverted.height, -upright.height)
    assert upright.notes == ()


def test_whatever_follows_the_points_is_not_read(tmp_path):
    path = written(tmp_path / "a.dat")
    path.write_bytes(path.read_bytes() + b"trailer")
    assert len(read_points(path)) == 5


@pytest.mark.parametrize(
    ("changes", "reported"),
    [
        ({"header": 65_537}, "says that its header has 65537 bytes; save it again"),
        ({"width": 0}, "number of points is 0"),
        ({"width": 4}, "has 858 bytes, too few for 4 × 2 points"),
        ({"scale": 0.0}, "how high a fringe is; export it again"),
        ({"wavelength": float("inf")}, "how high a fringe is"),
        ({"obliquity": float("nan")}, "how high a fringe is"),
        ({"resolution": 3}, "how high a fringe is"),
        ({"pixel": -1e-5}, "no lateral calibration; calibrate the camera and save again"),
        ({"pixel": float("inf")}, "no lateral calibration"),
        ({"pixel": 1e9}, "spacing dx of the map"),
        ({"scale": 1e9}, r"height\[0\] is .* give it in metres"),
    ],
)
def test_an_invalid_entry_is_reported(tmp_path, changes, reported):
    path = written(tmp_path / "a.dat", **changes)
    with pytest.raises(FileError, match=reported) as refused:
        read_points(path)
    assert "a.dat" in str(refused.value)
    assert "\n" not in str(refused.value)
