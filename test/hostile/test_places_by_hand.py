"""Maps and clouds whose places no instrument makes, or whose heights stand in another file."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hostile import maps, trees
from hostile.bag_inputs import TOPICS
from hostile.judge import Case, ask, judge, refused
from soaked import soaked

from omsm_ros.io.bag_writer import BagWriter

EXPORT = ("export", "{}", "--unit", "m", "--out", "e.x3p")
IMPORT = ("import", "{}", "--map", "map.yaml", "--out", "new.mcap")


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("places")
    maps.write_maps(folder)
    maps.write_tables(folder)
    (folder / "map.yaml").write_text(json.dumps(trees.COLUMNS))
    (folder / "surface.yaml").write_text("shape: sphere\nradius: -0.1\n")
    os.mkfifo(folder / "pipe")
    return folder


@pytest.mark.parametrize("size", [5e-324, 1e-320, 1e-200])
def test_places_that_are_one_but_for_their_last_bits_are_no_area(place, size, recwarn):
    """Shares of their extent would be divided by zero."""
    x, y = np.meshgrid(np.arange(10.0), np.arange(10.0))
    rows = np.c_[x.ravel() * size, y.ravel() * size, np.zeros(100)].tolist()
    raw = "\n".join(" ".join(map(repr, row)) for row in rows).encode()
    assert "no area" in refused(place, EXPORT, "tiny.xyz", raw)
    words = ("form", "{}", "--nominal", "surface.yaml", "--unit", "m", "--out", "out")
    assert "points lie on the nominal surface" in refused(place, words, "tiny.xyz", raw)
    assert not list(recwarn)


@pytest.mark.parametrize(("entry", "reported"), [(2, "dx"), (3, "dy")])
@pytest.mark.parametrize("value", ["1e308", "1e-320"])
def test_a_map_of_impossible_spacing_is_refused(place, entry, reported, value, recwarn):
    first, *rest = (place / "good.dat").read_text().split("\n")
    numbers = first.split()
    numbers[entry] = value
    raw = "\n".join([" ".join(numbers), *rest]).encode()
    words = ("export", "{}", "--out", "e.x3p")
    assert f"spacing {reported} of the map" in refused(place, words, "bad.dat", raw)
    assert not list(recwarn)


def test_heights_that_a_move_explains_as_well_as_any_form_are_told(place, recwarn):
    """A plane at 45° before a mirror of another shape: pose and form are all but one."""
    turn, radius = 0.5 * np.arange(20_000), np.linspace(1e-3, 2e-5, 20_000)
    x, y = radius * np.cos(turn), radius * np.sin(turn)
    raw = "\n".join(f"{a!r} {b!r} {a!r}" for a, b in zip(x.tolist(), y.tolist(), strict=True))
    (place / "mirror.yaml").write_text(
        "shape: off_axis_paraboloid\nparent_focal_length: 0.0254\noff_axis_distance: 0.0508\n"
    )
    words = ("form", "{}", "--nominal", "mirror.yaml", "--unit", "m", "--out", "out")
    assert "the pose does not converge" in refused(place, words, "plane.xyz", raw.encode())
    assert not list(recwarn)


# HDF5.


@pytest.fixture
def table(place):
    """Write a table of ours with ``change`` made to it; its bytes."""
    h5py = pytest.importorskip("h5py", reason="the extra 'formats' is not installed")

    def made(change) -> bytes:
        with h5py.File(place / "made.h5", "w") as content:
            content.attrs["schema"] = "omsm-points/1"
            for name in ("x", "y", "height"):
                content[name] = np.linspace(0, 1e-3, 400)
            change(h5py, content)
        return (place / "made.h5").read_bytes()

    return made


def linked(h5py, content):
    del content["height"]
    content["height"] = h5py.ExternalLink("good.h5", "height")


def stored(file):
    def change(_, content):
        del content["height"]
        content.create_dataset("height", (400,), "f8", external=[(file, 0, 3200)])

    return change


def mapped(h5py, content):
    del content["height"]
    layout = h5py.VirtualLayout((400,), "f8")
    layout[:361] = h5py.VirtualSource("good.h5", "height", (361,))
    content.create_virtual_dataset("height", layout)


@pytest.mark.parametrize(
    ("change", "words"),
    [(linked, EXPORT), (stored("/dev/zero"), EXPORT), (stored("pipe"), IMPORT), (mapped, IMPORT)],
)
def test_numbers_that_stand_in_another_file_are_not_fetched(place, table, change, words):
    said = refused(place, words, "made.h5", table(change))
    assert "takes 'height' from another file" in said


def test_numbers_of_half_precision_are_held_against_the_same_bounds(place, table, recwarn):
    def change(_, content):
        content["sample"] = np.zeros(400, np.float16)
        content["uncertainty"] = np.full(400, np.inf, np.float16)

    assert "uncertainty[0] is inf m" in refused(place, EXPORT, "made.h5", table(change))
    assert not list(recwarn)


@pytest.mark.parametrize(
    ("words", "status"),
    [
        # Turns stand still along the path and leap: of its frequencies thousands are strong.
        *soaked((("spectrum", "steps.mcap", "--out", "out", "--no-report"), 0)),
        # No place has neighbours at its own radius and at others.
        (("selfcal", "scan.mcap", "steps.mcap", "--out", "new.json"), 2),
        # A radius that is nothing but for its last bits is no coordinate.
        (("spectrum", "none.mcap", "--out", "out", "--no-report"), 0),
    ],
)
def test_a_radius_in_steps_is_judged_soon(place, small_scan_blocks, words, status):
    changes = {"scan": lambda x: x, "steps": lambda x: np.round(x, 4), "none": lambda x: 1e-310 * x}
    for name, change in changes.items():
        (place / f"{name}.mcap").unlink(missing_ok=True)
        with BagWriter(place / f"{name}.mcap", TOPICS) as bag:
            for axes, distance in small_scan_blocks[:12]:
                bag.write_block(replace(axes, x=change(axes.x)))
                bag.write_block(distance)
    case = Case((*words, "--json"))
    answer = ask(case, place)
    judge(case, answer, place)
    assert answer.status == status


def test_a_surface_metres_away_leaves_rounding(place):
    """Its figures are values or none; of a variance, rounding may be less than nothing."""
    surface = {"shape": "zernike", "radius": 0.006, "indexing": "noll"}
    surface["coefficients"] = [3.15, *[1e-7] * 8]
    words = ("compensate", "good.csv", "--nominal", "a.yaml", "--low-pass", "4e-3", "--out", "out")
    case = Case(
        (*words, "--fit", "piston,tip,tilt", "--json"), {"a.yaml": json.dumps(surface).encode()}
    )
    judge(case, ask(case, place), place)
