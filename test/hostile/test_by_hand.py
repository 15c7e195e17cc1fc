"""Hostile files that chance would not make: bombs, cut archives, counts without end, pipes."""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hostile import maps, trees
from hostile.judge import Case, ask, ask_process, judge, refused

from omsm_ros.errors import FileError
from omsm_ros.io.bags import AXES_TOPIC, DISTANCE_TOPIC, BagReader
from omsm_ros.io.files import save_text

EXPORT = ("export", "{}", "--unit", "mm", "--out", "e.x3p")
SHOW = ("surface", "show", "{}", "--radius", "0.002")
IMPORT = ("import", "{}", "--map", "map.yaml", "--out", "new.mcap")


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("by_hand")
    maps.write_maps(folder)
    maps.write_tables(folder)
    (folder / "map.yaml").write_text(json.dumps(trees.COLUMNS))
    (folder / "surface.yaml").write_text("shape: sphere\nradius: -0.1\n")
    (folder / "folder").mkdir()
    (folder / "loop").symlink_to("loop")
    (folder / "latin").write_bytes(b"\xff\xfe\xe9: 1\n\x80")
    os.mkfifo(folder / "pipe")
    return folder


# Archives.


def x3p(place: Path, change: tuple[str, str] = ("", ""), more: dict[str, bytes] | None = None):
    """A good file with a change of its description, signed again, and more or other members."""
    pytest.importorskip("x3pio", reason="x3p is written from Python 3.11 on")
    with zipfile.ZipFile(place / "good.x3p") as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    if change[0]:
        text, found = re.subn(change[0], change[1], members["main.xml"].decode(), count=1)
        assert found
        members["main.xml"] = text.encode()
        signed = hashlib.md5(members["main.xml"]).hexdigest()
        members["md5checksum.hex"] = f"{signed} *main.xml".encode()
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, raw in (members | (more or {})).items():
            archive.writestr(name, raw)
    return out.getvalue()


_BOMB = "".join(f'<!ENTITY l{k} "{f"&l{k - 1};" * 10}">' for k in range(1, 12))


@pytest.mark.parametrize(
    "change",
    [
        (r"<SizeX>\d+", "<SizeX>1000000000"),
        (r"<SizeX>\d+", "<SizeX>-5"),
        (r"<SizeX>\d+", f"<SizeX>{'9' * 400}"),
        (r"<Increment>[^<]*", "<Increment>1e300"),
        (r"<Increment>[^<]*", "<Increment>nan"),
        (r"(<\?xml.*?\?>)", rf'\1<!DOCTYPE a [<!ENTITY l0 "b">{_BOMB}]>'),
        (r"(<\?xml.*?\?>)", r'\1<!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/passwd">]>'),
    ],
)
def test_a_description_that_lies_is_refused(place, change):
    refused(place, EXPORT, "bad.x3p", x3p(place, change))


def test_an_archive_that_is_cut_forged_or_a_bomb_is_refused(place):
    whole = x3p(place)
    refused(place, EXPORT, "bad.x3p", whole[: len(whole) // 2])
    forged = bytearray(whole)
    struct.pack_into("<I", forged, forged.rfind(b"PK\x01\x02") + 24, 0xFFFFFFF0)
    assert "thin it" in refused(place, EXPORT, "bad.x3p", bytes(forged))
    bomb = x3p(place, more={"bindata/data.bin": bytes(110_000_000)})
    assert len(bomb) < 200_000
    assert "thin it" in refused(place, EXPORT, "bad.x3p", bomb)


# Clouds, maps.

_ASCII = "ply\nformat ascii 1.0\nelement vertex {}\n{}end_header\n1 2 3\n"
_XYZ = "property float x\nproperty float y\nproperty float z\n"


@pytest.mark.parametrize(
    ("name", "text", "reported"),
    [
        *(("a.ply", _ASCII.format(n, _XYZ), f"number of points is '{n[:5]}")
          for n in ("-5", "1e9", "many", "9" * 400, "7" * 13)),
        ("a.ply", _ASCII.format(999_999_999_999, _XYZ), "expected a whole number from 1 to"),
        ("a.ply", _ASCII.format(9_999_999, _XYZ), "holds 6 bytes of them"),
        ("a.ply", _ASCII.format(1, _XYZ.replace("y\n", "x\n")), "name each once"),
        ("a.ply", "ply\nformat", "no end of its header"),
        ("a.xyz", "nan nan nan\n" * 300, "without points"),
        ("a.xyz", "nan 1 1\n" * 300, "without points"),
        ("a.xyz", "1 1 1\ninf 1 1\n" * 300, "x[1] is inf m"),
        ("a.xyz", f"{'9' * 400} 1 1\n", "x[0] is inf m"),
        ("a.xyz", "1 1 1e300\n" * 300, "height[0] is 1e+297 m"),
        ("a.csv", "x_mm,y_mm,height_mm,u_mm\n" + "1,2,3,-5\n" * 300, "uncertainty[0] is -0.005 m"),
        ("a.csv", "x_mm,y_mm,height_mm,sample\n" + "1,2,3,1e300\n" * 300, "sample[0] is 1e+300"),
        ("a.dat", "1000000 1000000 1 1 0\n1 0 0 0\n", "number of points is 1000000000000"),
        ("a.dat", "5 5 1e300 1 0\n" + "1 0 0 0\n" * 25, "spacing dx of the map is 1e+297 m"),
    ],
)  # fmt: skip
def test_counts_and_coordinates_that_cannot_be_are_named(place, name, text, reported):
    assert reported in refused(place, EXPORT, name, text.encode())


def test_a_micrometre_as_windows_writes_it_is_understood(place):
    text = "x [µm],y [µm],z [µm]\n" + "".join(f"{k % 9}e3,{k // 9}e3,1\n" for k in range(90))
    case = Case(("export", "a.csv", "--out", "e.csv", "--json"), {"a.csv": text.encode("latin-1")})
    assert ask(case, place).status == 0
    first = (place / "e.csv").read_text().splitlines()[2]
    assert [float(n) for n in first.split(",")] == pytest.approx([1e-3, 0.0, 1e-6])


@pytest.mark.parametrize(("count", "kind"), [(10**12, "f8"), (12_000_001, "f8"), (9, "S1")])
def test_datasets_that_promise_what_memory_cannot_hold_are_refused(place, count, kind):
    h5py = pytest.importorskip("h5py", reason="the extra 'formats' is not installed")
    with h5py.File(place / "a.h5", "w") as content:  # a thousand bytes of a file
        content.attrs["schema"] = "omsm-points/1"
        for name in ("x", "y", "height"):
            content.create_dataset(name, shape=(count,), chunks=(min(count, 1000),), dtype=kind)
    refused(place, EXPORT, "a.h5", (place / "a.h5").read_bytes())


@pytest.mark.parametrize("name", ["good.ply", "good.pcd"])
def test_a_cloud_without_its_last_byte_is_refused(place, name):
    raw = (place / name).read_bytes()
    assert "cut short" in refused(place, EXPORT, f"short.{name[-3:]}", raw[:-1])


# Tables.


def test_complex_numbers_are_none(place):
    """They would lose their imaginary part without a word."""
    h5py = pytest.importorskip("h5py", reason="the extra 'formats' is not installed")
    from scipy.io import savemat

    many = np.arange(800.0)
    savemat(place / "c.mat", dict.fromkeys("nXZCdi", many) | {"X": many * 1j})
    assert "imaginary" in refused(place, IMPORT, "c.mat", (place / "c.mat").read_bytes())
    with h5py.File(place / "c.h5", "w") as content:
        content.attrs["schema"] = "omsm-points/1"
        content.update({"x": many, "y": many * 1j, "height": many})
    assert "complex128" in refused(place, EXPORT, "c.h5", (place / "c.h5").read_bytes())


def test_what_a_library_logs_of_a_damaged_file_is_no_line_of_ours(place):
    tdms = pytest.importorskip("nptdms", reason="the extra 'formats' is not installed")
    with tdms.TdmsWriter(str(place / "cut.tdms")) as file:
        file.write_segment([tdms.ChannelObject("g", name, np.zeros(400)) for name in "nXZCdi"])
    case = Case(
        tuple(word.replace("{}", "cut.tdms") for word in IMPORT),
        {"cut.tdms": (place / "cut.tdms").read_bytes()[:-1]},
    )
    answer = ask_process(case, place)
    assert answer.status == 2
    judge(case, answer, place)


def test_what_would_steer_a_terminal_is_written_out(place):
    said = refused(place, SHOW, "a.yaml", b'"\\e[2J\\u202e": 1\nshape: flat\n')
    assert "\\x1b[2J" in said
    assert said.rstrip("\n").isprintable()


def test_an_array_without_end_is_refused(place):
    head = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000, 7), }"
    raw = b"\x93NUMPY\x01\x00" + struct.pack("<H", 118) + head.ljust(117) + b"\n" + bytes(800)
    refused(place, IMPORT, "a.npy", raw)


def test_an_archive_of_zeros_is_not_unpacked(place):
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        array = io.BytesIO()
        np.save(array, np.zeros(1))
        head = array.getvalue()[:-8].replace(b"(1,)", b"(999999999999,)")[:128]
        archive.writestr("t.npy", head + bytes(1000))
    refused(place, IMPORT, "a.npz", out.getvalue())


def test_a_slide_that_stood_still_is_an_axis_all_the_same(place):
    columns = trees.COLUMNS["columns"] | {"z": {"constant": 0, "unit": "m"}}
    (place / "z.yaml").write_text(json.dumps(trees.COLUMNS | {"columns": columns}))
    answer = ask(Case(("import", "log.csv", "--map", "z.yaml", "--out", "z.mcap", "--json")), place)
    assert answer.status == 0, answer
    with BagReader(place / "z.mcap") as bag:
        x = np.concatenate([block.x for _, _, block in bag.blocks(AXES_TOPIC)])
    assert x == pytest.approx(6e-3 - np.arange(len(x)) * 1e-6)


def test_a_start_before_1970_is_refused(place):
    table = b"n,d\n" + b"".join(b"%d,1e-6\n" % k for k in range(20))
    columns = {"trigger": {"name": "n"}, "distance": {"name": "d", "unit": "m"}}
    described = {"sample_period": 1e-3, "start": -1.8e9, "columns": columns}
    (place / "t.yaml").write_text(json.dumps(described))
    words = ("import", "{}", "--map", "t.yaml", "--out", "new.mcap")
    assert "before 1970" in refused(place, words, "early.csv", table)


def test_a_light_beyond_single_precision_is_no_light(place):
    table = b"n,d,i\n" + b"".join(
        b"%d,1e-6,%s\n" % (k, b"1e300" if k == 7 else b"0.8") for k in range(20)
    )
    columns = {"trigger": {"name": "n"}, "distance": {"name": "d", "unit": "m"},
               "intensity": {"name": "i", "unit": "1"}}  # fmt: skip
    (place / "i.yaml").write_text(json.dumps({"sample_period": 1e-3, "columns": columns}))
    (place / "bright.csv").write_bytes(table)
    words = ("import", "bright.csv", "--map", "i.yaml", "--out", "bright.mcap", "--json")
    assert ask(Case(words), place).status == 0
    with BagReader(place / "bright.mcap") as bag:
        light = np.concatenate([block.intensity for _, _, block in bag.blocks(DISTANCE_TOPIC)])
    assert np.flatnonzero(~np.isfinite(light)).tolist() == [7]


def test_a_surface_that_no_point_lies_on_is_told_in_a_line(place):
    """Of a height that is nowhere real, not one point is left to look at."""
    words = ("form", "good.xyz", "--nominal", "{}", "--unit", "mm", "--out", "out")
    surface = {"shape": "biconic", "radius_x": 0.1, "radius_y": 0.2, "conic_x": -1}
    assert "not converge" in refused(place, words, "b.yaml", json.dumps(surface).encode())


def test_a_line_of_megabytes_is_quoted_shortly(place):
    assert len(refused(place, IMPORT, "a.csv", b"1 " * 2_000_000)) < 700


# Descriptions.


def nested(times: int) -> dict[str, Any]:
    surface: dict[str, Any] = {"shape": "sphere", "radius": 0.5}
    for _ in range(times):
        surface = {"shape": "off_axis_section", "parent": surface, "distance": 1e-3}
    return surface


@pytest.mark.parametrize(
    ("surface", "reported"),
    [
        (nested(4), "4 turned frames within one another"),
        ({"shape": "sum", "parts": [{"shape": "flat"}] * 1000}, "1001 shapes"),
        ({"shape": "q_bfs", "aperture_radius": 6e-3, "coefficients": [0.0] * 1000}, "20 at most"),
        ({"shape": "zernike", "radius": 6e-3, "coefficients": [0.0] * 1000}, "37 at most"),
        ({"shape": "grid", "file": "folder"}, "no map at 'folder/cloud.ply'"),
        ({"shape": "grid", "file": "/dev/zero"}, "no regular file"),
    ],
)
def test_a_surface_that_would_take_hours_is_refused(place, surface, reported):
    assert reported in refused(place, SHOW, "a.yaml", json.dumps(surface).encode())


def test_a_surface_of_many_terms_is_quick(place):
    terms = [{"x": k % 21, "y": k % 19, "value": 1e-9} for k in range(1000)]
    surface = {"shape": "xy_polynomial", "radius": 6e-3, "terms": terms}
    case = Case(
        (*SHOW[:2], "a.yaml", *SHOW[3:], "--json"), {"a.yaml": json.dumps(surface).encode()}
    )
    answer = ask(case, place)
    assert answer.status == 0
    judge(case, answer, place)


@pytest.mark.parametrize("speed", ["0", "-0.0", "1e-300"])
def test_a_spindle_that_stands_makes_no_scan(place, speed):
    words = ("surface", "show", "{}", "--radius", "0.002", "--rpm", speed)
    reported = refused(place, words, "a.yaml", b"shape: flat\n")
    assert "spindle speed is" in reported


# No files at all.


@pytest.mark.timeout(20)
@pytest.mark.parametrize(
    "path",
    [
        "pipe",
        "folder",
        "/dev/zero",
        "/proc/self/mem",
        "loop",
        "none",
        "latin",
        pytest.param("n" * 300, id="long"),
    ],
)
@pytest.mark.parametrize(
    "words",
    [
        ("export", "{}", "--out", "e.xyz"),
        ("form", "good.csv", "--nominal", "{}", "--out", "out"),
        ("form", "{}", "--nominal", "surface.yaml", "--out", "out"),
        ("difference", "good.csv", "{}", "--out", "out"),
        ("import", "{}", "--map", "map.yaml", "--out", "new.mcap"),
        ("import", "log.csv", "--map", "{}", "--out", "new.mcap"),
        ("calset", "{}@x=0", "{}@x=1", "--out", "new.json"),
        ("spectrum", "{}", "--out", "out"),
        ("history", "--catalogue", "new.sqlite", "--add", "{}"),
        ("inspect", "{}", "--repair"),
        ("surface", "show", "surface.yaml", "--radius", "1e-3", "--limits", "{}"),
    ],
    ids=" ".join,
)
def test_what_is_no_file_is_refused_at_once(place, words, path):
    case = Case((*(word.replace("{}", path) for word in words), "--json"))
    answer = ask(case, place)
    assert answer.status == 2, answer
    judge(case, answer, place)


def test_a_word_with_a_null_character_is_refused(place):
    assert r"'a\x00b'" in refused(place, (*IMPORT[:-1], "a\0b"), "log.csv", b"n\n")


@pytest.mark.parametrize("out", ["/dev/null", "/dev/full", "pipe"])
def test_a_device_is_never_replaced_by_a_file(place, out):
    with pytest.raises(FileError, match="a device or a pipe"):
        save_text(place / out, "text")
    assert not (place / out).is_file()
