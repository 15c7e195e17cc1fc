"""Inputs of which a number, a column or a direction is missing: each is told in one line."""

from __future__ import annotations

import dataclasses
import json
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from certified import certified_by
from hostile import maps, trees
from hostile.judge import Case, ask, judge

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.io.bag_writer import BagWriter
from omsm_ros.io.calibration_file import save_calibration
from omsm_ros.io.message_mapping import typestore
from omsm_ros.twin.cell import blocks_of


@pytest.fixture(scope="module")
def place(tmp_path_factory, step_test, true_calibration: Calibration) -> Path:
    folder = tmp_path_factory.mktemp("in_a_line")
    maps.write_maps(folder)
    maps.write_tables(folder)
    save_calibration(folder / "cal.json", true_calibration)
    (folder / "surface.yaml").write_text("shape: sphere\nradius: -0.1\n")
    with BagWriter(folder / "steps.mcap", ("/omsm/axes", "/omsm/confocal")) as bag:
        for axes, distance in blocks_of(step_test):
            bag.write_block(axes)
            bag.write_block(distance)
    return folder


def refused(place: Path, *words: str, **files: str) -> str:
    named = {name.replace("_", "."): text.encode() for name, text in files.items()}
    case = Case((*words, "--json"), named)
    answer = ask(case, place)
    assert answer.status == 2, answer
    judge(case, answer, place)
    return answer.err


def test_axes_without_z_are_no_axes(place):
    columns = {name: how for name, how in trees.COLUMNS["columns"].items() if name != "z"}
    text = json.dumps(trees.COLUMNS | {"columns": columns})
    words = ("import", "log.csv", "--map", "bad.yaml", "--out", "new.mcap")
    assert "no column for z" in refused(place, *words, bad_yaml=text)


@pytest.mark.parametrize(
    ("more", "reported"),
    [
        ({"delimiter": ""}, "has 0 characters, expected at least 1"),
        ({"delimiter": ";;"}, "has 2 characters, expected at most 1"),
        ({"zone": "noon"}, "'noon', expected pattern '^(Z|"),
    ],
)
def test_a_text_of_another_form_is_told_with_what_is_wanted(place, more, reported):
    words = ("import", "log.csv", "--map", "bad.yaml", "--out", "new.mcap")
    assert reported in refused(place, *words, bad_yaml=json.dumps(trees.COLUMNS | more))


def test_a_start_beyond_all_time_is_refused(place):
    text = json.dumps(trees.COLUMNS | {"start": 1.7e308})
    words = ("import", "log.csv", "--map", "bad.yaml", "--out", "new.mcap")
    assert "start is 1.7e+308 s" in refused(place, *words, bad_yaml=text)


def test_scattered_points_are_no_grid_and_the_remedy_works(place):
    pytest.importorskip("x3pio", reason="x3p is written from Python 3.11 on")
    random = np.random.default_rng(1)
    lines = "".join(f"{x:.6f} {y:.6f} 0.001\n" for x, y in random.uniform(-3, 3, (9000, 2)))
    grid = "shape: grid\nfile: {}\nunit: mm\n"
    words = ("surface", "show", "bad.yaml", "--radius", "0.002")
    said = refused(place, *words, bad_yaml=grid.format("bad.xyz"), bad_xyz=lines)
    assert "'omsm export --spacing'" in said
    made = ("export", "bad.xyz", "--unit", "mm", "--spacing", "3e-4", "--out", "even.x3p", "--json")
    assert ask(Case(made), place).status == 0
    shown = Case((*words, "--json"), {"bad.yaml": b"shape: grid\nfile: even.x3p\n"})
    assert ask(shown, place).status == 0


def test_a_strip_of_points_is_compensated_nowhere(place):
    """Beside a single row of cells nothing tells how the form goes on."""
    angle = np.linspace(0, 300, 3000)
    rows = np.stack([3 * np.sin(angle), 1e-9 * np.cos(7 * angle), 0 * angle], axis=1)
    lines = "".join(" ".join(f"{v:.12g}" for v in row) + "\n" for row in rows)
    words = ("compensate", "bad.xyz", "--nominal", "bad.yaml", "--unit", "mm", "--out", "out")
    more = ("--low-pass", "4e-3", "--fit", "piston")
    said = refused(place, *words, *more, bad_xyz=lines, bad_yaml="shape: flat\n")
    assert "measure more tracks" in said


@pytest.mark.parametrize("hold", ["band-limited", "zero-order", "first-order"])
@pytest.mark.parametrize(("name", "size"), [("output", 0.0), ("output", 1e-300), ("input", 0.0)])
def test_what_does_not_change_tells_nothing(place, hold, name, size):
    random = np.random.default_rng(2)
    sizes = (size, 1.0) if name == "input" else (1.0, size)
    u, y = random.normal(size=(2, 600)) * np.array(sizes)[:, np.newaxis]
    lines = "u,y\n" + "".join(f"{a:.9g},{b:.9g}\n" for a, b in zip(u, y, strict=True))
    words = ("identify", "bad.csv", "--input", "u", "--output", "y", "--period", "1e-3")
    said = refused(place, *words, "--order", "1", "--hold", hold, "--out", "m.json", bad_csv=lines)
    assert f"the {name} changes by" in said


def test_messages_that_are_no_bytes_are_damage(place):
    from rosbags.rosbag2 import Reader, StoragePlugin, Writer

    with (
        Reader(place / "steps.mcap") as source,
        Writer(place / "rb", version=9, storage_plugin=StoragePlugin.SQLITE3) as bag,
    ):
        for connection, stamp, raw in source.messages():
            known = {c.topic: c for c in bag.connections}
            out = known.get(connection.topic) or bag.add_connection(
                connection.topic, connection.msgtype, typestore=typestore()
            )
            bag.write(out, stamp, raw)
    (found,) = (place / "rb").glob("*.db3")
    assert ask(Case(("predict", "rb", "--calibration", "cal.json", "--json")), place).status == 0
    with closing(sqlite3.connect(found)) as base, base:
        base.execute("UPDATE messages SET data = 5")
    said = refused(place, "predict", "rb", "--calibration", "cal.json")
    assert "a message is 5, not bytes" in said


def test_a_step_test_is_no_scan_of_a_sphere(place):
    """Every point is the same place: the centre may be anywhere."""
    words = ("align", "steps.mcap", "--calibration", "cal.json", "--radius", "0.1")
    assert "hardly moved" in refused(place, *words, "--out", "g.yaml")
    assert not (place / "g.yaml").exists()


def test_a_covariance_of_noise_is_one_too(place, true_calibration):
    p = len(true_calibration.covariance)
    noise = [1.7e308 if k == 3 else 0.0 for k in range(p * p)]
    changed = dataclasses.replace(
        true_calibration,
        certificate=certified_by({"noise_covariance": noise}, true_calibration.certificate),
    )
    save_calibration(place / "odd.json", changed)
    assert "not symmetric" in refused(place, "compare", "cal.json", "odd.json")


def test_an_option_whose_value_is_two_dashes_has_none(place):
    words = ("surface", "show", "surface.yaml", "--radius", "0.002", "--feed=--")
    assert "'--feed=--' has no value" in refused(place, *words)


@pytest.mark.parametrize("hold", ["zero-order", "band-limited"])
def test_one_wild_value_of_a_table_overflows_nothing(place, hold):
    """An input that is nothing but for one value, where the output is as large as may be."""
    u, y = 1e-300 * np.arange(599.0), 1e-6 * np.sin(0.11 * np.arange(599))
    u[254] = 0.6
    words = ("identify", "t.csv", "--input", "u", "--output", "y", "--period", "1e-3")
    words = (*words, "--order", "2", "--hold", hold, "--out", "new.json")
    for largest in (-9e49, -9e97):
        y[254] = largest
        text = "u,y\n" + "\n".join(
            f"{a!r},{b!r}" for a, b in zip(u.tolist(), y.tolist(), strict=True)
        )
        if largest < -1e50:
            assert "expected a number from -1e+50 to 1e+50" in refused(place, *words, t_csv=text)
        else:
            case = Case((*words, "--json"), {"t.csv": text.encode()})
            judge(case, ask(case, place), place)
