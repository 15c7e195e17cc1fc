"""``omsm difference`` on own results and files of other programs."""

import json

import numpy as np
import pytest

from omsm_ros.cli import main
from omsm_ros.cli.command_line import BAD_INPUT, DONE
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.io import bags
from omsm_ros.io.bag_writer import BagWriter
from omsm_ros.io.results import CloudFile
from omsm_ros.pipelines.measure import measure
from omsm_ros.twin.cell import Cell, blocks_of, record
from omsm_ros.twin.disturbances import Disturbances
from omsm_ros.twin.machine_errors import Drift, MachineErrors
from omsm_ros.twin.part import FigureError
from omsm_ros.twin.scenario import Spiral

RADIUS = 3e-3
DRIFT = Drift(ramp_m_per_s=0.2e-9, random_walk_m_per_root_s=1e-9)


def scan_into(folder, calibration, seed, rpm, feed, astigmatism):
    """Scan the mirror on the twin, with drift, and correct the bag."""
    part = FigureError(PAPER_MIRROR, RADIUS, seed=3, astigmatism=astigmatism)
    cell = Cell(seed=seed, disturbances=Disturbances(machine=MachineErrors(drift=DRIFT)))
    scan = record(cell, Spiral(PAPER_MIRROR, RADIUS, feed, rpm), part)
    bag = folder.parent / f"{folder.name}.mcap"
    with BagWriter(bag, (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)) as writer:
        for axes, distance in blocks_of(scan):
            writer.write_block(axes)
            writer.write_block(distance)
    folder.mkdir()
    measure(bag, calibration, folder, report=False)
    return folder


@pytest.fixture(scope="module")
def results(tmp_path_factory, true_calibration):
    root = tmp_path_factory.mktemp("results")
    ways = {"slow": (11, 30, 2.0e-4, 80e-9), "fast": (12, 45, 2.6e-4, 80e-9)}
    return {n: scan_into(root / n, true_calibration, *way) for n, way in ways.items()}


@pytest.fixture(scope="module")
def other(tmp_path_factory, true_calibration):
    """Scan a part with more astigmatism, as fast."""
    folder = tmp_path_factory.mktemp("other") / "scan"
    return scan_into(folder, true_calibration, 12, 45, 2.6e-4, 120e-9)


def difference(capsys, out, *arguments):
    status = main(["difference", *map(str, arguments), "--out", str(out), "--json"])
    captured = capsys.readouterr()
    return status, json.loads(captured.out) if captured.out else captured.err


def test_two_scans_of_one_part_agree(results, tmp_path, capsys):
    status, facts = difference(capsys, tmp_path / "d", results["slow"], results["fast"])
    assert status == DONE
    assert facts["verdict"] == "agree"
    assert all(abs(n["e_n"]) < 1 for n in facts["e_n"].values())
    assert all(abs(term["e_n"]) < 1 for term in facts["zernike"]["terms"])
    stored = json.loads((tmp_path / "d" / "difference.json").read_text())
    assert stored["e_n"] == facts["e_n"]
    table = np.loadtxt(tmp_path / "d" / "difference.csv", delimiter=",", skiprows=1)
    assert len(table) == facts["difference"]["places"]
    assert np.sqrt(np.mean(table[:, 2] ** 2)) == pytest.approx(facts["difference"]["rms"])


@pytest.mark.soak
def test_twenty_nanometres_of_astigmatism_differ(results, other, tmp_path, capsys):
    _, facts = difference(capsys, tmp_path / "d", results["slow"], other)
    assert facts["verdict"] == "differ"
    sizes = {(t["n"], t["m"]): t["difference"] for t in facts["zernike"]["terms"]}
    edge = (RADIUS / facts["zernike"]["aperture"]["radius"]) ** 2
    assert np.hypot(sizes[2, 2], sizes[2, -2]) * edge == pytest.approx(20e-9, rel=0.15)


def interferometer(results, path, spread=None):
    """Write the part's true heights as a map, with piston, tilt and noise of the instrument."""
    at = np.linspace(-0.9 * RADIUS, 0.9 * RADIUS, 71)
    x, y = (part.ravel() for part in np.meshgrid(at, at))
    part = FigureError(PAPER_MIRROR, RADIUS, seed=3)
    height = part.height(x, y) + 3e-6 + 20e-6 * x
    height += np.random.default_rng(5).normal(0, 0.3e-9, len(x))
    columns = [x * 1e3, y * 1e3, height * 1e9]
    np.savetxt(path, np.column_stack(columns))
    return path


@pytest.mark.soak
def test_a_map_of_another_instrument(results, other, tmp_path, capsys):
    path = interferometer(results, tmp_path / "zygo.xyz")
    status, said = difference(capsys, tmp_path / "d", results["slow"], path)
    assert status == BAD_INPUT
    assert "--unit mm" in said
    unit = ("--unit", "mm,nm")
    _, facts = difference(capsys, tmp_path / "d", results["slow"], path, *unit)
    assert facts["verdict"] == "cannot tell"
    assert "has no uncertainty; state it with " in facts["reasons"][0]
    assert facts["e_n"]["rms"]["e_n"] is None
    assert facts["zernike"] is None
    stated = (*unit, "--uncertainty", "2e-9")
    _, facts = difference(capsys, tmp_path / "d", results["slow"], path, *stated)
    assert facts["verdict"] == "agree"
    assert facts["b"]["drift_from"] == "taken at once"
    _, facts = difference(capsys, tmp_path / "d", other, path, *stated)
    assert facts["verdict"] == "differ"


@pytest.mark.soak
def test_the_nominal_surface_is_taken_off_both(results, tmp_path, capsys):
    nominal = tmp_path / "mirror.yaml"
    nominal.write_text(
        "shape: off_axis_paraboloid\nparent_focal_length: 0.0254\noff_axis_distance: 0.0508\n"
    )
    pair = (results["slow"], results["fast"])
    _, bare = difference(capsys, tmp_path / "d", *pair)
    _, facts = difference(capsys, tmp_path / "e", *pair, "--nominal", nominal)
    assert facts["verdict"] == "agree"
    assert facts["e_n"]["rms"]["a"] < 50e-9 < bare["e_n"]["rms"]["a"]
    assert facts["difference"]["rms"] == pytest.approx(bare["difference"]["rms"], rel=0.02)


@pytest.mark.soak
def test_each_may_be_registered_to_the_nominal_surface_first(results, tmp_path, capsys):
    """A paraboloid that is clamped with a tilt of 20 mrad has another height over x and y."""
    table = CloudFile(results["fast"] / "cloud.ply").read()
    x, y, height = (table[name].astype(float) for name in ("x", "y", "height"))
    turn = 20e-3
    moved = [x * np.cos(turn) - height * np.sin(turn), y, x * np.sin(turn) + height * np.cos(turn)]
    np.savetxt(tmp_path / "askew.xyz", np.column_stack(moved)[::3], header="x_m y_m z_m")
    nominal = tmp_path / "mirror.yaml"
    nominal.write_text(
        "shape: off_axis_paraboloid\nparent_focal_length: 0.0254\noff_axis_distance: 0.0508\n"
    )
    pair = (results["slow"], tmp_path / "askew.xyz", "--uncertainty", "3e-9", "--nominal", nominal)
    _, askew = difference(capsys, tmp_path / "d", *pair)
    assert askew["verdict"] == "differ"
    _, facts = difference(capsys, tmp_path / "e", *pair, "--register", "piston,tip,tilt")
    assert facts["verdict"] == "agree"
    assert facts["difference"]["rms"] < 0.7 * askew["difference"]["rms"]
    for side in ("a", "b"):
        assert facts[side]["sources"]["pose of the part"] > 0
        assert any("registered by" in note for note in facts[side]["notes"])


@pytest.mark.soak
def test_two_scans_of_one_calibration_may_be_registered_first(results, tmp_path, capsys):
    """Errors of the calibration stay common to both after the registration."""
    nominal = tmp_path / "mirror.yaml"
    nominal.write_text(
        "shape: off_axis_paraboloid\nparent_focal_length: 0.0254\noff_axis_distance: 0.0508\n"
    )
    pair = (results["slow"], results["fast"], "--nominal", nominal)
    _, plain = difference(capsys, tmp_path / "d", *pair)
    _, facts = difference(capsys, tmp_path / "e", *pair, "--register", "piston,tip,tilt")
    assert facts["verdict"] == "agree"
    assert facts["common_errors"] == plain["common_errors"] != []


@pytest.mark.soak
def test_it_speaks_to_people(results, tmp_path, capsys):
    pair = (str(results["slow"]), str(results["fast"]))
    assert main(["difference", *pair, "--out", str(tmp_path / "d")]) == DONE
    text = capsys.readouterr().out
    for expected in ("verdict", "agree", "no drift is stated", "E_n of rms", "nm"):
        assert expected in text


@pytest.mark.parametrize(
    ("arguments", "reported"),
    [
        (["--fit", "piston,roll"], "pose parameter 'roll' is unknown"),
        (["--uncertainty", "-1"], "standard uncertainty"),
        (["--nominal", "missing.yaml"], "no surface at 'missing.yaml'"),
        (["--spacing", "1e-9"], "widen "),
        (["--spacing", "2e-6"], "expected 40 401 at most"),  # it would take a minute
        (["--register", "auto"], "--register needs the surface"),
        (["--register", "roll"], "roll"),
    ],
)
def test_a_wrong_wish_is_one_line(results, tmp_path, capsys, arguments, reported):
    pair = (results["slow"], results["fast"])
    status, said = difference(capsys, tmp_path / "d", *pair, *arguments)
    assert status == BAD_INPUT
    assert reported in said
    assert len(said.splitlines()) == 1
    assert not (tmp_path / "d").exists()


def test_fields_that_are_damaged_are_reported(results, tmp_path, capsys):
    folder = tmp_path / "copy"
    folder.mkdir()
    for part in results["slow"].iterdir():
        (folder / part.name).write_bytes(part.read_bytes())
    (folder / "systematic.npz").write_bytes(b"PK\x03\x04 nothing")
    status, said = difference(capsys, tmp_path / "d", folder, results["fast"])
    assert status == BAD_INPUT
    assert "damaged" in said
