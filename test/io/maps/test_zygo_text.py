"""The two texts of Zygo, by the MetroPro Reference Guide: lines 4, 8 and 11 of the header count."""

import numpy as np
import pytest

from omsm_ros.errors import FileError
from omsm_ros.io.maps.read_map import read_points

XYZ, ASCII = "Zygo XYZ Data File - Format 1", "Zygo ASCII Data File - Format 2"
PIXEL, WAVELENGTH = 5.067e-5, 6.328e-7
HEIGHTS = np.array([[0.0, 1.5, -2.0], [3.0, np.nan, 5.25]])


def header(first, left, top, resolution=1, pixel=PIXEL):
    return [
        first, '0 8 3 5 "Tue Aug 25 16:59:23 2020"', "0 0 3 2 1 255", f"{left} {top} 3 2",
        '"of # 7"', '"9"', '"M1"', f"0 0.5 {WAVELENGTH} 0 1.1 0 {pixel} 1598374763",
        '640 480 0 0 0 0 "lens"', "0 0 1 33 0 0 0.1 60.4 2 50", f"{resolution} 1 20 2 0 0 0 0 0",
        '0 ""', "1 5", '""', "#",
    ]  # fmt: skip


def xyz(**changes):
    lines = header(XYZ, 10, 20, **changes)
    for row, heights in enumerate(HEIGHTS):
        for column, height in enumerate(heights):
            value = "No Data" if np.isnan(height) else f"{height:.4f}"
            lines.append(f"{10 + column} {20 + row} {value}")
    return "\n".join([*lines, "#", ""])


def phases(*greys, **changes):
    steps = np.where(np.isnan(HEIGHTS), 2147483640, HEIGHTS * 1000).astype(int).ravel()
    body = [*greys, "#", " ".join(map(str, steps[:4])), " ".join(map(str, steps[4:])), "#", ""]
    return "\n".join(header(ASCII, 0, 0, **changes) + body)


def read(tmp_path, text, name="map.asc"):
    path = tmp_path / name
    path.write_bytes(text.encode())
    return read_points(path)


@pytest.mark.parametrize("ends", ["\n", "\r\n"])
def test_pixels_and_micrometres_from_the_upper_row_on(tmp_path, ends):
    points = read(tmp_path, xyz().replace("\n", ends), "map.xyz")
    assert points.height == pytest.approx([3e-6, 5.25e-6, 0, 1.5e-6, -2e-6])
    assert points.x == pytest.approx([0, 2 * PIXEL, 0, PIXEL, 2 * PIXEL])
    assert points.y == pytest.approx([0, 0, PIXEL, PIXEL, PIXEL])
    assert points.missing == 1


@pytest.mark.parametrize("greys", [(), ("12 13 14", "15 16 17")])
@pytest.mark.parametrize(("resolution", "steps"), [(0, 4096), (1, 32768), (2, 131072)])
def test_phases_are_scaled_as_in_the_binary_file(tmp_path, greys, resolution, steps):
    points = read(tmp_path, phases(*greys, resolution=resolution))
    unit = 1000 * 0.5 * WAVELENGTH * 1.1 / steps
    assert points.height == pytest.approx(unit * np.array([3, 5.25, 0, 1.5, -2]))
    assert points.missing == 1


@pytest.mark.parametrize("text", [xyz(), phases()])
def test_a_file_that_was_cut_short_is_refused(tmp_path, text):
    for kept in (len(text) - 2, len(text) - 5, len(text) - 40, 60):
        with pytest.raises(FileError, match="is damaged or was cut short; export it again"):
            read(tmp_path, text[:kept])


def test_a_camera_without_calibration_is_refused(tmp_path):
    with pytest.raises(FileError, match="no lateral calibration"):
        read(tmp_path, xyz(pixel=0))
    with pytest.raises(FileError, match="does not say how high a fringe is"):
        read(tmp_path, phases(resolution=7))


def test_a_pixel_outside_the_map_is_refused(tmp_path):
    with pytest.raises(FileError, match="cut short"):
        read(tmp_path, xyz().replace("\n10 20 0.0000", "\n9 20 0.0000"))
    with pytest.raises(FileError, match="cut short"):
        read(tmp_path, xyz().replace("\n12 21 5.2500", "\n13 21 5.2500"))
