"""Commands for calibrations and scans: plan, verify, compare, predict, reversal, align."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from omsm_ros import cli
from omsm_ros.core.kinematics.trajectories import Spiral
from omsm_ros.core.surface.aspheres import Sphere
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.io import bags, descriptions, files, results
from omsm_ros.io.bag_writer import BagWriter
from omsm_ros.twin.cell import Cell, blocks_of, record
from omsm_ros.twin.scenario import Scenario, spiral_of

from .written import SPHERE_RADIUS_M, facts, write


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


def test_predict_over_a_gap_judges_the_longest_run_and_names_the_rest(
    capsys, tmp_path, small_scan, calibration
):
    path, kept = tmp_path / "gap.mcap", 0
    with BagWriter(path, (bags.AXES_TOPIC,)) as bag:
        for axes, _ in blocks_of(small_scan, 1000):
            if axes.first_sample != 2000:
                bag.write_block(axes)
                kept += len(axes)
    found = facts(capsys, "predict", path, "--calibration", calibration)
    truth = (small_scan.probe_motion - small_scan.axes.z)[3000:]
    assert found["peak_to_valley"] == pytest.approx(np.ptp(truth), rel=0.1)
    assert "1 000 are missing (2000 to 2999)" in found["left_out"]
    judged = f"only {kept - 2000:,} of {kept:,} samples are judged".replace(",", " ")
    assert judged in found["left_out"]
    assert found["message"].endswith(found["left_out"])


def test_predict_judges_at_the_period_of_the_longest_run(capsys, tmp_path, small_scan, calibration):
    """The last block has another sample period, which does not affect those before."""
    path, made = tmp_path / "two.mcap", list(blocks_of(small_scan, 1000))
    made[-1] = (replace(made[-1][0], sample_period=4e-3), made[-1][1])
    with BagWriter(path, (bags.AXES_TOPIC,)) as bag:
        for axes, _ in made:
            bag.write_block(axes)
    found = facts(capsys, "predict", path, "--calibration", calibration)
    truth = (small_scan.probe_motion - small_scan.axes.z)[: -len(made[-1][0])]
    assert found["peak_to_valley"] == pytest.approx(np.ptp(truth), rel=0.1)
    assert "period" in found["left_out"]


def test_predict_takes_a_planned_motion(capsys, tmp_path, calibration):
    assert cli.main(["plan", "steps", "--out", str(tmp_path), "--json"]) == 0
    capsys.readouterr()
    found = facts(capsys, "predict", tmp_path / "steps.csv", "--calibration", calibration)
    # The lag of 0.34 ms times the greatest speed of an edge, 9.8 µm with a mean of 0.49 mm/s.
    assert found["peak_to_valley"] == pytest.approx(2 * 0.3397e-3 * 2 * 9.8e-6 / 20e-3, rel=0.05)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("time_s,z_m\n0,1e-6\n", "1 lines of numbers"),
        ("time_s,z_m\n0,a\n1,b\n", "line 2: '0,a' is no row"),
        ("time_s,z_m\n0,1\n1,nan\n", "z_m has no reading in 1 of 2 rows"),
        ("time_s,z_m\n0,1\n1,1\n5,1\n", "even steps"),
        ("time_s,z_um\n0,1\n1,1\n", "0 columns 'z_m'"),  # another unit than expected
        ("0,1\n1,1\n2,1\n", "0 columns 'time_s'"),  # without the header line
        ("time_s,z_m\n0,0,1,5\n0,1,1,5\n", "line 2: '0,0,1,5' is no row"),  # decimal commas
        ("time_s,z_m\n2,1\n1,1\n", "step of time_s is -1.0 s"),
    ],
)
def test_a_wrong_motion_file_is_refused(tmp_path, text, named):
    path = tmp_path / "motion.csv"
    path.write_text(text)
    with pytest.raises(files.FileError, match=named):
        descriptions.load_motion(path)


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
    assert descriptions.load_geometry(out).centre_x == found["geometry"]["centre_x"]


def sphere_aligned(tmp_path, calibration, radius):
    part = Sphere(SPHERE_RADIUS_M)
    bag = write(tmp_path / "s.mcap", record(Cell(), Spiral(part, 4e-3, 8e-4, 30.0), part))
    words = ("align", bag, "--calibration", calibration, "--radius", radius)
    return cli.main([str(word) for word in (*words, "--out", tmp_path / "geometry.yaml")])


def test_align_tells_the_noise_by_which_the_points_scatter(capsys, tmp_path, calibration):
    assert sphere_aligned(tmp_path, calibration, SPHERE_RADIUS_M) == 0
    said = capsys.readouterr().out
    assert "warning" not in said
    noise = float(re.search(r"of which ([\d.]+) nm noise", said)[1])
    assert noise == pytest.approx(10.5, rel=0.15)


def test_align_refuses_another_sphere_and_names_its_radius(capsys, tmp_path, calibration):
    assert sphere_aligned(tmp_path, calibration, 0.99 * SPHERE_RADIUS_M) == 2
    pattern = r"of radius ([\d.]+) mm with a standard uncertainty of ([\d.]+) µm"
    found = re.search(pattern, capsys.readouterr().err)
    radius, uncertainty = float(found[1]), 1e-3 * float(found[2])
    assert abs(radius - SPHERE_RADIUS_M * 1e3) < 3 * uncertainty < 0.05
    assert not (tmp_path / "geometry.yaml").exists()


def test_align_warns_programs_too_of_a_form_that_is_no_noise(capsys, tmp_path, calibration):
    part = Sphere(SPHERE_RADIUS_M)
    scan = record(Cell(), Spiral(part, 2e-3, 8e-4, 30.0), part)
    rippled = scan.distance.distance + 100e-9 * np.sin(40 * scan.axes.c)
    distance = replace(scan.distance, distance=rippled)
    bag = write(tmp_path / "s.mcap", replace(scan, distance=distance))
    words = ("--calibration", calibration, "--radius", SPHERE_RADIUS_M, "--out", tmp_path / "g")
    (warning,) = facts(capsys, "align", bag, *words)["warnings"]
    assert "not a sphere of that radius, or its form" in warning


@pytest.mark.soak
def test_a_pitch_that_was_measured_elsewhere_is_reported(capsys, tmp_path, scan_bag, calibration):
    (tmp_path / "g.yaml").write_text("abbe_arm: 0.05\n")
    words = ["correct", str(scan_bag), "--calibration", str(calibration), "--no-report", "--json",
             "--geometry", f"{tmp_path}/g.yaml"]  # fmt: skip
    reported = {}
    for name, low, high in (("here", -0.1, 0.1), ("elsewhere", 5.0, 6.0)):
        table = tmp_path / f"{name}.csv"
        table.write_text(f"z_m,pitch_rad\n{low},1e-6\n{high},2e-6\n")
        assert cli.main([*words, "--out", f"{tmp_path}/{name}", "--pitch", str(table)]) == 0
        reasons = json.loads(capsys.readouterr().out)["verdict"]["reasons"]
        reported[name] = [r["text"] for r in reasons if "pitch was measured" in r["text"]]
    assert reported["here"] == []
    assert "from 5.00 m to 6.00 m" in reported["elsewhere"][0]


@pytest.mark.parametrize(
    "text", ["centre_x: far\n", "radius: 1.0\n", "centre_x: .nan\n", "[1, 2]\n", "1: 2\n"]
)
def test_a_wrong_geometry_file_is_refused(tmp_path, text):
    path = tmp_path / "geometry.yaml"
    path.write_text(text)
    with pytest.raises(files.FileError, match="geometry"):
        descriptions.load_geometry(path)


def test_correct_refuses_a_foreign_calibration_unless_requested(
    capsys, tmp_path, small_scan_blocks, calibration
):
    bag = tmp_path / "scan.mcap"
    with BagWriter(bag, (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)) as writer:
        for axes, distance in small_scan_blocks[:30]:
            writer.write_block(axes)
            writer.write_block(distance)
    arguments = ["correct", str(bag), "--calibration", str(calibration), "--out"]
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


def test_streams_of_different_rates_are_joined_by_their_stamps(capsys, tmp_path, calibration):
    """Write axes of twice the rate, with their own counter, 0.3 ms ahead of the probe's clock."""
    spiral = spiral_of(Scenario(start_radius=5e-4))  # 5 turns of 0.1 mm at 30 rpm and 1 kHz
    fast, slow = (record(Cell(sample_period=p), spiral, PAPER_MIRROR) for p in (0.5e-3, 1e-3))
    ahead_ns = 300_000
    path = tmp_path / "two_clocks.mcap"
    with BagWriter(path, (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)) as bag:
        for axes, _ in blocks_of(fast, 1000):
            stamp, count = axes.stamp_ns + 10**9 + ahead_ns, axes.first_sample + 77
            bag.write_block(replace(axes, stamp_ns=stamp, first_sample=count))
        for _, distance in blocks_of(slow, 1000):
            bag.write_block(replace(distance, stamp_ns=distance.stamp_ns + 10**9))
    arguments = ["correct", path, "--calibration", calibration, "--out", tmp_path / "out"]
    arguments += ["--by-stamps", "--delay", "0.3e-3", "--no-report", "--json"]
    assert cli.main([*map(str, arguments)]) == 0
    account = json.loads(capsys.readouterr().out)["samples"]["distance"]
    assert account["received"] == 10_000
    assert account["corrected"] > 9_900
    assert account["corrected"] + sum(account["counted"].values()) == 10_000
    cloud = results.CloudFile(tmp_path / "out" / "cloud.ply").read()
    error = cloud["height"] - slow.surface_height[cloud["sample"]]
    assert np.sqrt(np.mean(error**2)) < 1.1 * np.hypot(10e-9, 10e-9 / np.sqrt(12))
