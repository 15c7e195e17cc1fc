"""One scan by command: never verified, its figure registered, and what it contradicts is named."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from omsm_ros import cli
from omsm_ros.io import calibration_file
from omsm_ros.pipelines.record_bags import write_nominal, write_recording
from omsm_ros.twin.disturbances import Disturbances
from omsm_ros.twin.machine_errors import MachineErrors
from omsm_ros.twin.part import PartPose
from omsm_ros.twin.scenario import Scenario, planned_test_of, scan_of

SCENARIO = Scenario(seed=3, start_radius=3e-3, feed_per_turn=2.5e-4)
STATED = """\
schema: omsm-sources/1
sources:
  - {source: lag_change, value: 5.0e-6, unit: s, how: declared, reason: two step tests}
  - {source: drift_rate, value: 1.0e-10, unit: m/s, how: declared, reason: probe held still}
  - {source: probe_latency, value: 1.0e-6, unit: s, how: declared, reason: trigger}
  - {source: decentre, value: 3.0e-6, unit: m, how: declared, reason: dial gauge}
"""
ZERO = ("lag_change s", "drift_rate m/s", "drift_walk m/√s", "centre_x m", "centre_y m",
        "spindle_axial m", "straightness_x m", "probe_latency s", "encoder_scale '1'",
        "probe_slope_square m/rad")  # fmt: skip
MAP = """\
columns:
  time: {name: t, unit: s}
  x: {name: x, unit: m}
  y: {name: y, unit: m}
  z: {name: z, unit: m}
  b: {constant: 0}
  c: {name: c, unit: rad}
  distance: {name: d, unit: m, sign: SIGN}
"""


@pytest.fixture(scope="module")
def shop(tmp_path_factory, true_calibration, step_test):
    folder = tmp_path_factory.mktemp("shop")
    scan = scan_of(SCENARIO)
    write_recording(folder / "steps.mcap", step_test)
    write_recording(folder / "scan.mcap", scan)
    wrapped = np.mod(scan.axes.c + np.pi, 2 * np.pi) - np.pi
    write_recording(folder / "wrapped.mcap", replace(scan, axes=replace(scan.axes, c=wrapped)))
    write_nominal(folder / "mirror.yaml")
    (folder / "stated.yaml").write_text(STATED, encoding="utf-8")
    zeros = [
        f"  - {{source: {name}, value: 0.0, unit: {unit}, how: evaluated, reason: none"
        + (", per_turn: 2" if "spindle" in name else "") + "}"
        for name, unit in map(str.split, ZERO)
    ]  # fmt: skip
    text = "\n".join(["schema: omsm-sources/1", "sources:", *zeros])
    (folder / "zeros.yaml").write_text(text, encoding="utf-8")
    calibration_file.save_calibration(folder / "cal.json", true_calibration)
    return folder


def correct(capsys, shop, scan, *more, calibration="cal.json"):
    capsys.readouterr()
    words = ("correct", shop / scan, "--calibration", shop / calibration, "--nominal",
             shop / "mirror.yaml", "--no-report", "--out", shop / "r", "--json", *more)  # fmt: skip
    assert cli.main([*map(str, words)]) == 0
    return json.loads(capsys.readouterr().out)


def test_ten_zeros_evaluate_nothing(capsys, shop):
    silent = correct(capsys, shop, "scan.mcap")
    zeros = correct(capsys, shop, "scan.mcap", "--sources", shop / "zeros.yaml")
    for found in (silent, zeros):
        assert found["verdict"]["code"] == "not_verified"
        assert "twice the speed" in found["verdict"]["add"]["text"]
    codes = [[r["code"] for r in f["verdict"]["reasons"]] for f in (silent, zeros)]
    assert codes[0] == codes[1]
    u = [f["figures"]["peak_to_valley"]["standard_uncertainty"] for f in (silent, zeros)]
    assert u[1] == pytest.approx(u[0], rel=0.2)


@pytest.mark.soak
def test_verdict_and_form_agree_whatever_is_fitted(capsys, shop):
    """A decentre that was declared is in the figures where it was not fitted, and only there."""
    sizes = {}
    for fit in ("piston,tip,tilt", "auto"):
        words = ("--sources", shop / "stated.yaml", "--fit", fit, "--accuracy", 1e-9)
        found = correct(capsys, shop, "scan.mcap", *words)
        u = found["figures"]["peak_to_valley"]["standard_uncertainty"]
        (reason,) = (r for r in found["verdict"]["reasons"] if r["code"] == "uncertainty")
        assert reason["value"] == pytest.approx(2 * u)
        assert found["verdict"]["code"] != "verified"
        texts = " ".join(r["text"] for r in found["verdict"]["reasons"])
        assert "--fit" not in texts
        sizes[fit] = u
        assert found["verdict"]["add"]["reached"] < 2 * sizes["piston,tip,tilt"]
    assert sizes["auto"] < sizes["piston,tip,tilt"]


@pytest.mark.soak
def test_a_part_in_any_pose_has_the_figure_of_the_part(capsys, shop):
    pose = PartPose(x_m=5e-5, y_m=-3e-5, z_m=2e-6, tilt_x_rad=1e-3, tilt_y_rad=-5e-4,
                    clocking_rad=3e-3)  # fmt: skip
    posed = Disturbances(machine=MachineErrors(pose=pose))
    write_recording(shop / "posed.mcap", scan_of(SCENARIO, posed))
    words = ("--sources", shop / "stated.yaml", "--fit", "auto")
    found = {n: correct(capsys, shop, f"{n}.mcap", *words)["figures"] for n in ("scan", "posed")}
    one, other = (found[n]["peak_to_valley"] for n in ("scan", "posed"))
    spread = np.hypot(one["standard_uncertainty"], other["standard_uncertainty"])
    assert abs(one["value"] - other["value"]) < 3 * spread
    # The pose adds little to the uncertainty that one scan leaves, drift in it.
    assert other["standard_uncertainty"] < min(1.5 * one["standard_uncertainty"], 1e-7)


def test_a_step_test_is_no_scan(capsys, shop):
    words = ["correct", "steps.mcap", "--calibration", "cal.json", "--out", "spot", "--no-report",
             "--json"]  # fmt: skip
    cli.main([str(shop / w) if "." in w or w == "spot" else w for w in words])
    first, *_ = json.loads(capsys.readouterr().out)["verdict"]["reasons"]
    assert "'omsm identify'" in first["text"]


def test_pitch_without_an_arm_evaluates_nothing(capsys, shop):
    pitch = (
        "  - {source: pitch, value: 1.0e-6, unit: rad, how: evaluated, reason: autocollimator, "
        "date: 2026-03-02}\n"
    )
    (shop / "pitch.yaml").write_text(STATED + pitch, encoding="utf-8")
    words = ["correct", "scan.mcap", "--calibration", "cal.json", "--sources", "pitch.yaml",
             "--out", "pitched"]  # fmt: skip
    assert cli.main([str(shop / w) if "." in w or w == "pitched" else w for w in words]) == 2
    assert "has no arm" in capsys.readouterr().err
    (shop / "pitch.yaml").write_text(STATED + pitch.replace("rad,", "rad, arm: 0.02,"))
    found = correct(capsys, shop, "scan.mcap", "--sources", str(shop / "pitch.yaml"))
    (row,) = (s for s in found["budget"]["sources"] if s["source"] == "pitch")
    assert row["status"] == "evaluated"
    # Less than arm times pitch, as a curve of Z has no offset.
    assert 2e-9 < row["height"] < 20e-9


@pytest.mark.soak
def test_a_wrong_sign_from_tables_is_contradicted(capsys, shop):
    """The step test imported with the sign -1, the scan without, of logs that agree."""
    for name, one, sign in (
        ("steps", planned_test_of(SCENARIO), 1),
        ("scan", scan_of(SCENARIO), -1),
    ):
        a = one.axes
        columns = [np.arange(len(a)) * 1e-3, a.x, a.y, a.z, a.c, sign * one.distance.distance]
        np.savetxt(shop / f"{name}.csv", np.column_stack(columns), delimiter=",",
                   header="t,x,y,z,c,d", comments="")  # fmt: skip
    for name, sign in (("steps", -1), ("scan", -1), ("scan_wrong", 1)):
        (shop / "map.yaml").write_text(MAP.replace("SIGN", str(sign)))
        table = shop / f"{name.split('_')[0]}.csv"
        if name == "steps":  # its log has the sign of the bag: imported wrong
            (shop / "map.yaml").write_text(MAP.replace("SIGN", "-1"))
        words = ("import", table, "--map", shop / "map.yaml", "--out", shop / f"csv_{name}.mcap")
        assert cli.main([*map(str, words)]) == 0
    out = shop / "csv.json"
    assert cli.main(["identify", f"{shop}/csv_steps.mcap", "--out", str(out)]) == 0
    right = correct(capsys, shop, "csv_scan_wrong.mcap", "--polarity", -1, calibration="csv.json")
    assert right["verdict"]["code"] == "not_verified"
    wrong = correct(capsys, shop, "csv_scan.mcap", "--polarity", -1, calibration="csv.json")
    assert wrong["verdict"]["code"] == "contradicted"
    assert wrong["verdict"]["reasons"][0]["code"] == "wrong_sign"
    assert "polarity" in wrong["verdict"]["reasons"][0]["text"]


def test_a_wrapped_c_turns_as_fast_as_it_does(capsys, shop):
    words = ("predict", shop / "wrapped.mcap", "--calibration", shop / "cal.json", "--json")
    assert cli.main([*map(str, words)]) == 0
    limits = {x["name"]: x for x in json.loads(capsys.readouterr().out)["limits"]}
    assert limits["spindle speed"]["value"] == pytest.approx(30, rel=1e-3)


@pytest.mark.soak
def test_history_has_the_registered_figure(capsys, shop):
    base = str(shop / "base.sqlite")
    found = correct(capsys, shop, "scan.mcap", "--catalogue", base)["figures"]
    assert cli.main(["history", "--catalogue", base, "--json"]) == 0
    machine = json.loads(capsys.readouterr().out)["machines"][0]
    (row,) = machine["measurements"]
    assert row["deviation_rms"] == found["rms"]["value"]
    assert row["deviation_peak_to_valley"] == found["peak_to_valley"]["value"]
