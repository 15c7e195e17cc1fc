"""``omsm plan``, ``verify`` and ``compare``."""

from dataclasses import replace

import numpy as np
import pytest
from certified import certified_by

from omsm_ros import cli
from omsm_ros.core.kinematics.trajectories import Chirp
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.surface.nominal import Flat
from omsm_ros.io import bags, calibration_file
from omsm_ros.io.bag_writer import BagWriter
from omsm_ros.twin.cell import Cell, blocks_of, record

from .written import facts, write


def test_plan_writes_what_the_machine_can_run(capsys, tmp_path):
    found = facts(capsys, "plan", "steps", "--out", tmp_path, "--count", 5)
    assert found["edges"] == 10
    table = np.loadtxt(tmp_path / "steps.csv", delimiter=",", skiprows=1)
    # Two step heights detect nonlinearity: three steps of 9.8 µm and two of 3 µm between them.
    assert found["heights"] == pytest.approx([9.8e-6, 3e-6])
    assert np.ptp(table[:, 1]) == pytest.approx(3 * 9.8e-6 + 2 * 3e-6)
    assert found["travel"] == pytest.approx(np.ptp(table[:, 1]))
    # Every edge has ten samples or more, so that no motion falls between two samples.
    assert np.abs(np.diff(table[:, 1])).max() < 9.8e-6 / 5
    assert "G21" in (tmp_path / "steps.nc").read_text()


def test_plan_writes_equal_steps_when_requested(capsys, tmp_path):
    sizes = ("--step", 9.8e-6, "--second-step", 9.8e-6)
    found = facts(capsys, "plan", "steps", "--out", tmp_path, "--count", 5, *sizes)
    table = np.loadtxt(tmp_path / "steps.csv", delimiter=",", skiprows=1)
    assert found["travel"] == pytest.approx(5 * 9.8e-6)
    assert np.ptp(table[:, 1]) == pytest.approx(5 * 9.8e-6)


def test_plan_refuses_what_the_probe_cannot_follow(capsys, tmp_path):
    assert cli.main(["plan", "steps", "--out", str(tmp_path), "--count", "50"]) == 2
    assert "range" in capsys.readouterr().err


def test_verify_on_a_chirp(capsys, tmp_path, calibration):
    chirp = Chirp(duration=10.0)
    bag = write(tmp_path / "chirp.mcap", record(Cell(), chirp, Flat()))
    found = facts(capsys, "verify", bag, "--calibration", calibration)
    # Before: growing lag, 0.12 degrees per hertz. After: the noise of the probe.
    assert found["rms_before"] > 10 * found["rms_after"]
    assert found["rms_after"] < 12e-9
    band = next(b for b in found["bands"] if b["from"] == 10)
    assert np.degrees(band["lag_before"]) == pytest.approx(0.1223 * 10.5, rel=0.03)
    assert abs(np.degrees(band["lag_after"])) < 0.02


def test_verify_refuses_what_is_no_free_path(capsys, tmp_path, calibration, small_scan):
    """Facing a part, the probe follows its surface instead of the motion of Z."""
    made = record(Cell(), Chirp(duration=5.0), Flat())
    turned = replace(made, distance=replace(made.distance, distance=-made.distance.distance))
    for name, recording, said in (
        ("scan", small_scan, "looks at a fixed target"),
        ("turned", turned, "invert its sign"),
    ):
        bag = write(tmp_path / f"{name}.mcap", recording)
        assert cli.main(["verify", str(bag), "--calibration", str(calibration)]) == 2
        assert said in capsys.readouterr().err


@pytest.mark.parametrize("ahead", [0, 37])
def test_verify_finds_the_offset_of_two_counters(capsys, tmp_path, calibration, ahead):
    """With the probe's counter ``ahead``, no sample is paired correctly without the offset."""
    path = tmp_path / "chirp.mcap"
    with BagWriter(path, (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)) as bag:
        for axes, distance in blocks_of(record(Cell(), Chirp(duration=10.0), Flat()), 100):
            bag.write_block(axes)
            bag.write_block(replace(distance, first_sample=distance.first_sample + ahead))
    known = ("verify", path, "--calibration", calibration)
    found = facts(capsys, *known, "--find-offset")
    assert found["counter_offset"]["samples"] == -ahead
    assert abs(found["counter_offset"]["fraction"]) < 0.05
    assert found["rms_after"] < 12e-9
    if ahead:
        assert cli.main([*map(str, known)]) == 2
        assert "slipped" in capsys.readouterr().err
        stated = facts(capsys, *known, "--counter-offset", -ahead)
        assert stated["rms_after"] == found["rms_after"]


def test_compare_sees_a_change_and_only_a_change(capsys, tmp_path, true_calibration):
    p = true_calibration.covariance.shape[0]
    spread = np.zeros((p, p))
    spread[-1, -1] = (1e-6) ** 2
    certificate = {"verdict": "accepted", "static_gain_uncertainty": 3e-6}
    old = replace(true_calibration, covariance=spread, certificate=certified_by(certificate))
    g = old.dynamics
    late = replace(old, dynamics=TransferFunction(g.numerator, g.denominator, g.delay + 20e-6))
    for name, made in (("old", old), ("same", replace(old, settings={})), ("late", late)):
        calibration_file.save_calibration(tmp_path / f"{name}.json", made)
    same = facts(capsys, "compare", tmp_path / "old.json", tmp_path / "same.json")
    assert not same["changed"]
    changed = facts(capsys, "compare", tmp_path / "old.json", tmp_path / "late.json")
    assert changed["changed"]
    assert changed["delay"] == pytest.approx(20e-6, rel=1e-6)
    assert changed["delay_sigmas"] == pytest.approx(20 / np.sqrt(2), rel=0.01)


def test_compare_of_three_or_more_says_how_well_they_repeat(capsys, tmp_path, true_calibration):
    p = true_calibration.covariance.shape[0]
    spread = np.zeros((p, p))
    spread[-1, -1] = (1e-6) ** 2
    g = true_calibration.dynamics
    paths = []
    for index, off in enumerate((0.0, 1e-6, 2e-6, 30e-6)):
        late = TransferFunction(g.numerator, g.denominator, g.delay + off)
        paths.append(tmp_path / f"{index}.json")
        certificate = {"verdict": "accepted"}
        made = replace(
            true_calibration,
            dynamics=late,
            covariance=spread,
            certificate=certified_by(certificate),
        )
        calibration_file.save_calibration(paths[-1], made)
    alike = facts(capsys, "compare", *paths[:3])
    assert alike["repeatable"]
    assert alike["count"] == 3
    assert alike["delay"]["deviation"] == pytest.approx(1e-6)
    assert len(alike["phase_deviation"]) == len(alike["frequency"])
    assert not facts(capsys, "compare", *paths)["repeatable"]


def test_verify_without_a_reading_says_so(capsys, tmp_path, calibration):
    made = record(Cell(seed=2), Chirp(duration=5.0), Flat())
    dark = replace(made.distance, distance=np.full(len(made.distance), np.nan))
    bag = write(tmp_path / "dark.mcap", replace(made, distance=dark))
    assert cli.main(["verify", str(bag), "--calibration", str(calibration)]) == 2
    assert "0 of 5000 samples are usable (5000 received, 5000 not ok)" in capsys.readouterr().err
