"""Maps read by SurfaceTopography, with a stand-in for the library."""

import logging
import os
import signal
import struct
import sys
import time
import zlib
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest

from omsm_ros.errors import FileError
from omsm_ros.io import child_process
from omsm_ros.io.maps.instrument_files import unpacked_sur
from omsm_ros.io.maps.read_map import read_points
from omsm_ros.units import LengthUnits

# Slopes of a plane in both directions, size of its map [µm], number of places.
SLOPES, SIZES, PLACES = (3e-3, -1e-3), (40.0, 15.0), (20, 5)


class UnknownError(Exception):
    """No reader knows the format."""


@pytest.fixture
def map_of(tmp_path, monkeypatch):
    """A file that the library takes for a map, whose heights begin with the direction x."""

    def made(
        unit="µm", sizes=SIZES, heights=None, names=(("Height", "HEIGHT"),), reader="SDFReader"
    ):
        x, y = (size / n * np.arange(n) for size, n in zip(SIZES, PLACES, strict=True))
        plane = SLOPES[0] * x[:, np.newaxis] + SLOPES[1] * y if heights is None else heights
        along = 2.0 * np.arange(len(plane))

        def topography(channel_index):
            return SimpleNamespace(
                heights=lambda: plane * (channel_index + 1), positions=lambda: along,
                physical_sizes=sizes, unit=unit,
            )  # fmt: skip

        channels = [SimpleNamespace(name=n, data_kind=SimpleNamespace(name=k)) for n, k in names]
        opened = type(reader, (), {})()
        opened.topography, opened.channels = topography, channels
        library = SimpleNamespace(
            open_topography=lambda path: nullcontext(opened),
            Exceptions=SimpleNamespace(CannotDetectFileFormat=UnknownError),
        )
        monkeypatch.setitem(sys.modules, "SurfaceTopography", library)
        path = tmp_path / "map.other"
        path.write_bytes(b"\0" * 100)
        return path

    return made


@pytest.mark.parametrize(("reader", "upwards"), [("SDFReader", 1), ("OPDReader", -1)])
def test_a_plane_keeps_its_slopes_and_its_size(map_of, reader, upwards):
    """Heights of an instrument begin with the upper row of the image, those of SDF with least y."""
    points = read_points(map_of(reader=reader))
    design = np.stack([points.x, points.y, np.ones(len(points.x))], axis=1)
    found = np.linalg.lstsq(design, points.height, rcond=None)[0]
    np.testing.assert_allclose(found[:2], [SLOPES[0], upwards * SLOPES[1]], rtol=1e-9)
    # From the first place to the last: one less than the map has.
    assert np.ptp(points.x) == pytest.approx(38e-6)
    assert np.ptp(points.y) == pytest.approx(12e-6)


@pytest.mark.parametrize("mistaken", [1e6, 1.0])
def test_pixels_of_nanofocus_are_those_of_a_microscope(map_of, mistaken):
    """SurfaceTopography 1.27 takes the nanometres of the file for millimetres."""
    points = read_points(map_of(reader="NMSReader", sizes=tuple(mistaken * v for v in SIZES)))
    assert np.ptp(points.x) == pytest.approx(38e-6)
    assert np.ptp(points.y) == pytest.approx(12e-6)


def test_a_format_that_no_reader_knows_is_one_sentence(map_of, capfd):
    path, library = map_of(), sys.modules["SurfaceTopography"]

    def opened(path):
        print("could not reshape data")
        raise UnknownError("\n".join(f"tried Reader{k}: wrong magic" for k in range(40)))

    library.open_topography = opened
    with pytest.raises(FileError, match="damaged or cut short, or none of the formats") as caught:
        read_points(path)
    assert "tried" not in str(caught.value)
    assert capfd.readouterr().out == ""  # it belongs to the JSON of the command


def test_lost_places_are_no_points(map_of):
    heights = np.ma.masked_less(np.arange(100.0).reshape(PLACES), 10.0)
    heights[-1, -1] = -np.finfo(np.float64).max  # the mark of SDF for a missing double
    points = read_points(map_of(heights=heights))
    assert np.sum(np.isfinite(points.height)) == 89


def test_a_unit_that_the_file_lacks_is_asked_for(map_of):
    with pytest.raises(FileError, match="--unit"):
        read_points(map_of(unit=None))
    stated = read_points(map_of(unit=None), LengthUnits(1e-3, 1e-6))
    assert np.ptp(stated.x) == pytest.approx(38e-3)


def test_a_map_without_a_size_is_refused_and_a_profile_is_read(map_of):
    with pytest.raises(FileError, match="no map with its size"):
        read_points(map_of(sizes=None))
    profile = read_points(map_of(heights=np.arange(5.0)))
    np.testing.assert_allclose(profile.x, 2e-6 * np.arange(5))
    assert "a profile along x" in profile.notes


def test_the_channel_is_chosen_and_always_named(map_of):
    names = (("Phase", "PHASE"), ("Z", "HEIGHT"), ("Z back", "HEIGHT"))
    path = map_of(names=names)
    usual = read_points(path)
    assert any("channel 1, 'Z'; --channel selects" in note for note in usual.notes)
    for channel in ("Z back", "2"):
        other = read_points(path, channel=channel)
        np.testing.assert_allclose(other.height, 1.5 * usual.height)
    for wrong, text in (("3", "no channel '3'"), ("Phase", "holds no heights")):
        with pytest.raises(FileError, match=text):
            read_points(path, channel=wrong)


def test_a_unit_in_utf_8_that_was_read_as_latin_1_is_known(map_of):
    """Surfalize writes µm into a .sur in UTF-8; the library reads the format's Latin-1."""
    np.testing.assert_allclose(
        read_points(map_of(unit="Âµm")).height, read_points(map_of()).height, rtol=1e-12
    )


@pytest.mark.parametrize(
    ("deed", "reported"),
    [
        (lambda _: bytearray(20 << 30), "more memory"),
        (lambda _: time.sleep(1000), "not read in 1 s"),
        (lambda _: os.kill(os.getpid(), signal.SIGSEGV), "the program that reads it ended"),
        (lambda _: 1 / 0, "division by zero; .*convert it to xyz"),
    ],
)
def test_a_library_that_takes_too_much_or_crashes_is_ended(map_of, monkeypatch, deed, reported):
    path = map_of()
    monkeypatch.setattr(sys.modules["SurfaceTopography"], "open_topography", deed)
    if "1 s" in reported:
        monkeypatch.setattr(child_process, "_FILE_S", 0.2)
    with pytest.raises(FileError, match=reported):
        read_points(path)


def sur_of(heights, streams=1, magic=b"DSCOMPRESSED", claimed=None):
    """Return a map of Digital Surf by its public layout, whole numbers of four bytes."""
    head = bytearray(512)
    head[:12] = magic
    struct.pack_into("<H", head, 98, 32)
    struct.pack_into("<3i", head, 108, *reversed(heights.shape), heights.size)
    struct.pack_into("<2H", head, 334, 5, 2)
    raw = heights.astype("<i4").tobytes()
    if magic == b"DIGITAL SURF":
        return bytes(head) + b"textsPR" + raw
    parts = [raw[k * len(raw) // streams : (k + 1) * len(raw) // streams] for k in range(streams)]
    packed = [zlib.compress(part) for part in parts]
    each = zip(parts, packed, strict=True)
    sizes = [struct.pack("<2I", claimed or len(part), len(zipped)) for part, zipped in each]
    return bytes(head) + b"textsPR" + struct.pack("<I", streams) + b"".join([*sizes, *packed])


@pytest.mark.parametrize("streams", [1, 3])
def test_a_compressed_map_of_digital_surf_is_read_as_the_uncompressed_one(tmp_path, streams):
    heights, path = np.arange(600).reshape(20, 30), tmp_path / "map.sur"
    path.write_bytes(sur_of(heights, streams))
    found = unpacked_sur(path, "map")
    assert found.getvalue() == sur_of(heights, magic=b"DIGITAL SURF")
    path.write_bytes(found.getvalue())
    assert unpacked_sur(path, "map") is None


@pytest.mark.parametrize(
    ("content", "reported"),
    [
        (sur_of(np.arange(600).reshape(20, 30))[:-40], "unpacks to"),
        (sur_of(np.arange(600).reshape(20, 30))[:521], "damaged or cut short"),
        (sur_of(np.arange(600).reshape(20, 30))[:540] + b"\xff" * 400, "damaged or cut short"),
        (sur_of(np.zeros((1, 1_000_000)), claimed=400)[:112] + struct.pack("<2i", 1, 100)
         + sur_of(np.zeros((1, 1_000_000)), claimed=400)[120:], "unpacks to 401 bytes for 100"),
        (sur_of(np.arange(600).reshape(20, 30))[:116] + b"\xff" * 400, "number of points"),
    ],
)  # fmt: skip
def test_a_damaged_one_or_a_bomb_is_refused_in_one_sentence(map_of, content, reported):
    path = map_of()
    path.write_bytes(content)
    with pytest.raises(FileError, match=reported):
        read_points(path)


def test_what_a_library_logs_about_a_damaged_file_is_not_shown(tmp_path, capfd, monkeypatch):
    """A reader of .opd files logs all their bytes as an error; nobody handles logs here."""
    monkeypatch.setattr(logging.getLogger(), "handlers", [])
    path = tmp_path / "map.opd"
    path.write_bytes(b"\0" * 100)

    def read():
        logging.getLogger("reader").error("could not reshape %s", path.read_bytes())
        raise ValueError("damaged")

    with pytest.raises(FileError, match=r"map\.opd.*damaged; save it again"):
        child_process.read_in_child(path, "map.opd", "save it again", read)
    assert "reshape" not in "".join(capfd.readouterr())
