"""Commands that judge rather than correct: plan, verify, compare, predict, reversal, align."""

import json
from dataclasses import replace

import numpy as np
import pytest

from omsm_ros import cli
from omsm_ros.core.dynamics.transfer_function import TransferFunction
from omsm_ros.core.machine.trajectories import Chirp, Spiral
from omsm_ros.core.surface.nominal import PAPER_MIRROR, Flat, Sphere
from omsm_ros.storage import bags, calibration_file, cloud_file, files, machine_files, motion_file
from omsm_ros.storage.recording.bag_writer import BagWriter
from omsm_ros.twin.cell import Cell, blocks_of, record
from omsm_ros.twin.disturbances import Disturbances
from omsm_ros.twin.plant import PAPER_STATIC_GAIN
from omsm_ros.twin.probe import ProbeErrors
from omsm_ros.twin.scenario import Scenario, spiral_of

SPHERE_RADIUS_M = 0.05


def write(path, recording):
    with BagWriter(path, (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)) as bag:
        for axes, distance in blocks_of(recording, 1000):
            bag.write_axes(axes)
            bag.write_distance(distance)
    return path


@pytest.fixture(scope="module")
def calibration(tmp_path_factory, true_calibration):
    path = tmp_path_factory.mktemp("calibration") / "cal.json"
    calibration_file.save_calibration(path, true_calibration)
    return path


def facts(capsys, *arguments):
    assert cli.main([*map(str, arguments), "--json"]) == 0
    machine = json.loads(capsys.readouterr().out)
    assert cli.main([*map(str, arguments)]) == 0
    assert capsys.readouterr().out.strip()
    return machine


def test_plan_writes_what_the_machine_can_run(capsys, tmp_path):
    found = facts(capsys, "plan", "steps", "--out", tmp_path, "--count", 5)
    assert found["edges"] == 10
    table = np.loadtxt(tmp_path / "steps.csv", delimiter=",", skiprows=1)
    # Two heights tell what is not linear: three steps of 9.8 µm and two of 3 µm between them.
    assert found["heights"] == pytest.approx([9.8e-6, 3e-6])
    assert np.ptp(table[:, 1]) == pytest.approx(3 * 9.8e-6 + 2 * 3e-6)
    assert found["travel"] == pytest.approx(np.ptp(table[:, 1]))
    # Ten samples or more on every edge: nothing happens between two samples.
    assert np.abs(np.diff(table[:, 1])).max() < 9.8e-6 / 5
    assert "G21" in (tmp_path / "steps.nc").read_text()


def test_plan_writes_equal_steps_when_told(capsys, tmp_path):
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


def test_compare_sees_a_change_and_only_a_change(capsys, tmp_path, true_calibration):
    p = true_calibration.covariance.shape[0]
    spread = np.zeros((p, p))
    spread[-1, -1] = (1e-6) ** 2
    certificate = {"verdict": "accepted", "static_gain_uncertainty": 3e-6}
    old = replace(true_calibration, covariance=spread, certificate=certificate)
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
        made = replace(true_calibration, dynamics=late, covariance=spread, certificate=certificate)
        calibration_file.save_calibration(paths[-1], made)
    alike = facts(capsys, "compare", *paths[:3])
    assert alike["repeatable"]
    assert alike["count"] == 3
    assert alike["delay"]["deviation"] == pytest.approx(1e-6)
    assert len(alike["phase_deviation"]) == len(alike["frequency"])
    assert not facts(capsys, "compare", *paths)["repeatable"]


@pytest.fixture(scope="module")
def scan_bag(tmp_path_factory, small_scan):
    return write(tmp_path_factory.mktemp("scan") / "scan.mcap", small_scan)


def test_predict_says_what_the_scan_will_cost(capsys, small_scan, scan_bag, calibration):
    found = facts(capsys, "predict", scan_bag, "--calibration", calibration)
    truth = small_scan.probe_motion - small_scan.axes.z
    assert found["peak_to_valley"] == pytest.approx(np.ptp(truth), rel=0.1)
    assert found["safe"], found["message"]
    assert found["speed_factor"] > 1
    # The noise of the encoder, on the small motion of this small scan.
    assert found["outside_band_fraction"] < 0.02


def test_predict_takes_a_planned_motion(capsys, tmp_path, calibration):
    assert cli.main(["plan", "steps", "--out", str(tmp_path), "--json"]) == 0
    capsys.readouterr()
    found = facts(capsys, "predict", tmp_path / "steps.csv", "--calibration", calibration)
    # The lag of 0.34 ms times the greatest speed of an edge, 9.8 µm with a mean of 0.49 mm/s.
    assert found["peak_to_valley"] == pytest.approx(2 * 0.3397e-3 * 2 * 9.8e-6 / 20e-3, rel=0.05)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("time_s,z_m\n0,1e-6\n", "two columns"),
        ("time_s,z_m\n0,a\n1,b\n", "no table"),
        ("time_s,z_m\n0,1\n1,nan\n", r"z_m\[1\] is nan m"),
        ("time_s,z_m\n0,1\n1,1\n5,1\n", "even steps"),
        ("time_s,z_m\n2,1\n1,1\n", "step of time_s is -1.0 s"),
    ],
)
def test_a_wrong_motion_file_is_refused(tmp_path, text, named):
    path = tmp_path / "motion.csv"
    path.write_text(text)
    with pytest.raises(files.FileError, match=named):
        motion_file.load_motion(path)


def test_reversal_finds_no_latency_in_a_mechanical_lag(capsys, tmp_path, calibration):
    scans = [
        write(
            tmp_path / f"{name}.mcap",
            record(Cell(seed=seed), Spiral(PAPER_MIRROR, 6e-3, 4e-4, rpm), PAPER_MIRROR),
        )
        for name, rpm, seed in (("cw", 30.0, 5), ("ccw", -30.0, 6))
    ]
    found = facts(capsys, "reversal", *scans, "--calibration", calibration)
    assert abs(found["lag"]) < 4 * found["uncertainty"]
    assert found["uncertainty"] < 50e-6
    assert found["latency"] is False
    assert found["points"] == sum(s["axes"]["corrected"] for s in found["samples"]) > 59_900
    # Those at the ends have no neighbours, those near the axis no place on the part.
    assert 0.98 * found["points"] < found["used"] < found["points"]
    assert all(s["axes"]["received"] == 30_000 for s in found["samples"])


def test_align_finds_the_spindle(capsys, tmp_path, calibration):
    sphere = Sphere(SPHERE_RADIUS_M)
    scan = record(Cell(), Spiral(sphere, 5e-3, 4e-4, 30.0), sphere)
    # The slides read 30 and -20 µm where the probe looks at the spindle axis.
    axes = replace(scan.axes, x=scan.axes.x + 30e-6, y=scan.axes.y - 20e-6)
    bag = write(tmp_path / "sphere.mcap", replace(scan, axes=axes))
    out = tmp_path / "geometry.yaml"
    found = facts(
        capsys,
        "align",
        bag,
        "--calibration",
        calibration,
        "--radius",
        SPHERE_RADIUS_M,
        "--out",
        out,
    )
    for name, true in (("centre_x", 30e-6), ("centre_y", -20e-6)):
        assert abs(found["geometry"][name] - true) < 4 * found["uncertainty"][name]
    assert found["uncertainty"]["centre_x"] < 1e-6
    account = found["samples"]["axes"]
    assert account["received"] == 25_000
    assert account["corrected"] + account["counted"]["settling"] == 25_000
    assert found["used"] == account["corrected"]
    # Across the feed, a sphere that runs true shows an offset in second order only.
    assert found["uncertainty"]["centre_y"] > 10e-6
    assert machine_files.load_geometry(out).centre_x == found["geometry"]["centre_x"]


@pytest.mark.parametrize(
    "text", ["centre_x: far\n", "radius: 1.0\n", "centre_x: .nan\n", "[1, 2]\n", "1: 2\n"]
)
def test_a_wrong_geometry_file_is_refused(tmp_path, text):
    path = tmp_path / "geometry.yaml"
    path.write_text(text)
    with pytest.raises(files.FileError, match="geometry"):
        machine_files.load_geometry(path)


def test_correct_refuses_a_foreign_calibration_unless_told(capsys, tmp_path, scan_bag, calibration):
    arguments = ["correct", str(scan_bag), "--calibration", str(calibration), "--out"]
    foreign = ["--settings", '{"machine": "another"}', "--no-report"]
    assert cli.main([*arguments, str(tmp_path / "a"), *foreign]) == 2
    err = capsys.readouterr().err
    assert "another" in err
    assert "twin" in err
    assert not (tmp_path / "a").exists()
    assert cli.main([*arguments, str(tmp_path / "b"), *foreign, "--override", "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["admission"]["overridden"] is True
    assert any("another" in text for text in summary["warnings"])
    head = (tmp_path / "b" / "cloud.ply").read_bytes()[:512]
    assert b"OVERRIDDEN" in head


def test_streams_of_different_rates_are_joined_by_their_stamps(
    capsys, tmp_path, small_scan, calibration
):
    """Axes twice as fast, with a counter of their own and 0.3 ms ahead of the probe's clock."""
    fast = record(Cell(sample_period=0.5e-3), spiral_of(Scenario(start_radius=2e-3)), PAPER_MIRROR)
    ahead_ns = 300_000
    path = tmp_path / "two_clocks.mcap"
    with BagWriter(path, (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)) as bag:
        for axes, _ in blocks_of(fast, 1000):
            stamp, count = axes.stamp_ns + 10**9 + ahead_ns, axes.first_sample + 77
            bag.write_axes(replace(axes, stamp_ns=stamp, first_sample=count))
        for _, distance in blocks_of(small_scan, 1000):
            bag.write_distance(replace(distance, stamp_ns=distance.stamp_ns + 10**9))
    arguments = ["correct", path, "--calibration", calibration, "--out", tmp_path / "out"]
    arguments += ["--by-stamps", "--delay", "0.3e-3", "--no-report", "--json"]
    assert cli.main([*map(str, arguments)]) == 0
    account = json.loads(capsys.readouterr().out)["samples"]["distance"]
    assert account["received"] == 40_000
    assert account["corrected"] > 39_900
    assert account["corrected"] + sum(account["counted"].values()) == 40_000
    cloud = cloud_file.CloudFile(tmp_path / "out" / "cloud.ply").read()
    error = cloud["height"] - small_scan.surface_height[cloud["sample"]]
    assert np.sqrt(np.mean(error**2)) < 1.1 * np.hypot(10e-9, 10e-9 / np.sqrt(12))


@pytest.fixture(scope="module")
def late_pair(tmp_path_factory):
    """Two speeds of one part, the probe 0.1 ms late."""
    folder = tmp_path_factory.mktemp("late")
    late = Disturbances(probe=ProbeErrors(latency_s=1e-4))
    return [
        write(
            folder / f"{rpm:.0f}.mcap",
            record(
                Cell(seed=seed, disturbances=late), Spiral(PAPER_MIRROR, 12.7e-3, 1e-3, rpm),
                PAPER_MIRROR,
            ),
        )
        for rpm, seed in ((60.0, 5), (120.0, 6))
    ]  # fmt: skip


@pytest.fixture
def sum_of_lags(tmp_path, true_calibration):
    """What a step test of the late probe says."""
    g = true_calibration.dynamics
    late = TransferFunction(g.numerator, g.denominator, g.delay + 1e-4)
    covariance = np.zeros_like(true_calibration.covariance)
    covariance[-1, -1] = 1e-12
    made = replace(
        true_calibration, dynamics=late, covariance=covariance, certificate={"verdict": "accepted"}
    )
    path = tmp_path / "step.json"
    calibration_file.save_calibration(path, made)
    return path


def test_selfcal_divides_the_lag_and_correct_uses_it(capsys, tmp_path, late_pair, sum_of_lags):
    out = tmp_path / "cal.json"
    found = facts(capsys, "selfcal", *late_pair, "--calibration", sum_of_lags, "--out", out)
    latency = found["latency"]
    assert latency["source"] == "several speeds"
    assert abs(latency["delay_s"] - 1e-4) < 3 * latency["uncertainty_s"] < 6e-6
    assert found["verdict"] == "accepted"
    nominal = tmp_path / "mirror.yaml"
    nominal.write_text(
        "shape: off_axis_paraboloid\nparent_focal_length: 25.4e-3\noff_axis_distance: 50.8e-3\n"
    )
    sizes = {}
    for name, used in (("resolved", out), ("unresolved", sum_of_lags)):
        summary = facts(
            capsys, "correct", late_pair[1], "--calibration", used, "--nominal", nominal,
            "--out", tmp_path / name, "--no-report", "--settings", '{"machine": "twin"}',
        )  # fmt: skip
        sizes[name] = summary["deviation"]["corrected"]["rms"], summary["uncertainty_budget"]
        assert summary["latency"]["source"] == ("several speeds" if used == out else "unresolved")
    noise = np.hypot(10e-9, 10e-9 / np.sqrt(12))
    assert sizes["resolved"][0] < 1.2 * noise
    # The correction itself made this error, and the budget holds it.
    assert sizes["unresolved"][0] > 5 * noise
    assert sizes["unresolved"][1]["lateral_lag"] > sizes["unresolved"][0] / 2


def test_selfcal_without_a_step_test_says_what_it_cannot_tell(capsys, tmp_path, late_pair):
    out = tmp_path / "cal.json"
    arguments = ["selfcal", *map(str, late_pair), "--out", str(out)]
    arguments += ["--static-gain", str(PAPER_STATIC_GAIN), "--gain-uncertainty", "1e-4"]
    found = facts(capsys, *arguments)
    assert found["latency"]["share"] is None
    assert abs(found["lag"] - 0.3397e-3) < 3 * found["lag_uncertainty"] < 6e-6
    assert any(text.startswith("latency") for text in found["not_told"])
    assert cli.main(arguments) == 0
    assert "not told" in capsys.readouterr().out


def test_a_latency_is_declared_with_a_reason(capsys, tmp_path, calibration):
    out = tmp_path / "declared.json"
    given = ["latency", calibration, "--delay", "1e-4", "--uncertainty", "5e-6", "--out", out]
    found = facts(capsys, *given, "--reason", "data sheet")
    assert found["latency"]["source"] == "declared"
    assert calibration_file.load_calibration(out).certificate["latency"]["delay_s"] == 1e-4
    assert cli.main([*map(str, given), "--reason", " "]) == 2
    assert "needs a reason" in capsys.readouterr().err


def test_reversal_writes_what_it_found(capsys, tmp_path, sum_of_lags):
    late = Disturbances(probe=ProbeErrors(latency_s=1e-4))
    scans = [
        write(
            tmp_path / f"{rpm}.mcap",
            record(
                Cell(seed=7, disturbances=late), Spiral(PAPER_MIRROR, 12.7e-3, 1e-3, rpm),
                PAPER_MIRROR,
            ),
        )
        for rpm in (60.0, -60.0)
    ]  # fmt: skip
    out = tmp_path / "resolved.json"
    found = facts(capsys, "reversal", *scans, "--calibration", sum_of_lags, "--out", out)
    latency = calibration_file.load_calibration(out).certificate["latency"]
    assert latency["source"] == "reversal"
    assert latency["delay_s"] == pytest.approx(found["lag"])
    assert found["latency"] is None
