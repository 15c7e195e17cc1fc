"""A table that a shop changed is read as what it is, or refused; never as something else."""

import contextlib
import io
import json

import numpy as np
import pytest
from hostile import shop

from omsm_ros import cli
from omsm_ros.io.calibration_file import save_calibration

TIME = np.arange(300) * 1e-3
ROWS = [["time_s", "z_m"], *([f"{t:.3f}", f"{1e-5 * np.sin(30 * t):.9f}"] for t in TIME)]
POINTS = [["x_m", "y_m", "height_m"]] + [
    [f"{x * 1e-4:.6f}", f"{y * 1e-4:.6f}", f"{x * y * 1e-8:.10f}"]
    for x in range(15) for y in range(15)
]  # fmt: skip


@pytest.fixture(scope="module")
def calibration(tmp_path_factory, true_calibration):
    path = tmp_path_factory.mktemp("calibration") / "cal.json"
    save_calibration(path, true_calibration)
    return path


@pytest.fixture(scope="module")
def as_written(tmp_path_factory, calibration):
    """Return status and facts of a prediction of the motion before a shop changed its table."""
    folder = tmp_path_factory.mktemp("written")
    (folder / "t.csv").write_bytes(shop.written(ROWS))
    words = ["predict", str(folder / "t.csv"), "--calibration", str(calibration), "--json"]
    with contextlib.redirect_stdout(io.StringIO()) as said:
        status = cli.main(words)
    return status, json.loads(said.getvalue())


def predicted(folder, text, calibration, capsys):
    (folder / "t.csv").write_bytes(text)
    words = ["predict", str(folder / "t.csv"), "--calibration", str(calibration), "--json"]
    status = cli.main(words)
    said = capsys.readouterr()
    return status, json.loads(said.out) if status == 0 else said.err


def exported(folder, text, capsys):
    (folder / "t.csv").write_bytes(text)
    out = folder / "out.xyz"
    status = cli.main(["export", str(folder / "t.csv"), "--out", str(out), "--json"])
    err = capsys.readouterr().err
    return status, np.loadtxt(out)[:, :3] if status == 0 else err


@pytest.mark.parametrize("way", shop.HARMLESS)
def test_what_is_harmless_changes_no_answer(way, tmp_path, calibration, as_written, capsys):
    assert predicted(tmp_path, shop.HARMLESS[way](ROWS), calibration, capsys) == as_written
    truth = np.array(POINTS[1:], float)
    status, found = exported(tmp_path, shop.HARMLESS[way](POINTS), capsys)
    assert status == 0, found
    assert found == pytest.approx(truth, rel=1e-8)


def test_a_motion_and_points_in_utf_16_are_read(tmp_path, calibration, as_written, capsys):
    motion, points = (shop.written(rows).decode().encode("utf-16") for rows in (ROWS, POINTS))
    assert predicted(tmp_path, motion, calibration, capsys) == as_written
    status, found = exported(tmp_path, points, capsys)
    assert status == 0
    assert found == pytest.approx(np.array(POINTS[1:], float), rel=1e-8)


COMMAS = "semicolons and decimal commas"


def test_points_with_decimal_commas_are_read_as_they_are(tmp_path, capsys):
    status, found = exported(tmp_path, shop.HARMFUL[COMMAS](POINTS), capsys)
    assert status == 0
    assert found == pytest.approx(np.array(POINTS[1:], float), rel=1e-8)


@pytest.mark.parametrize("way", shop.HARMFUL)
def test_what_is_another_table_is_refused(way, tmp_path, calibration, capsys):
    answers = [predicted(tmp_path, shop.HARMFUL[way](ROWS), calibration, capsys)]
    if way != COMMAS:
        answers.append(exported(tmp_path, shop.HARMFUL[way](POINTS), capsys))
    for status, said in answers:
        assert (status, said.count("\n")) == (2, 1), said
        assert "; " in said, said
