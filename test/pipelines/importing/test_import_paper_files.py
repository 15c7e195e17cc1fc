"""The paper's recordings as CSV, written by plain scripts: the same results as from their bags."""

import json
import subprocess
import sys

import numpy as np
import pytest

from benchmarks.twin_motions import step_test_of
from omsm_ros import cli
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.streams.motion_record import assemble
from omsm_ros.io import calibration_file, results
from omsm_ros.pipelines.record_bags import write_recording
from omsm_ros.twin.cell import blocks_of
from omsm_ros.twin.scenario import Scenario, scan_of

MAP = """
sample_period: 0.001
delimiter: ";"
decimal: ","
columns:
  x: {name: "X [mm]", unit: mm}
  y: {constant: 0}
  z: {name: "Z [mm]", unit: mm, sign: -1}
  b: {constant: 0}
  c: {name: "C [deg]", unit: deg}
  distance: {name: "gap [um]", unit: um}
"""


def write_shop_csv(path, recording):
    """Write the log of a German control: mm, degrees, Z towards the part, decimal commas."""
    axes, gap = recording.axes, recording.distance.distance
    columns = (axes.x * 1e3, -axes.z * 1e3, np.degrees(axes.c), gap * 1e6)
    with path.open("w", encoding="cp1252", newline="\r\n") as file:
        file.write("X [mm];Z [mm];C [deg];gap [um]\n")
        for row in np.column_stack(columns).tolist():
            file.write(";".join(map(repr, row)).replace(".", ",") + "\n")


def run(*arguments):
    assert cli.main([str(argument) for argument in arguments]) == 0


def imported(folder, name, recording):
    write_shop_csv(folder / f"{name}.csv", recording)
    (folder / "map.yaml").write_text(MAP)
    out = folder / f"{name}.csv.mcap"
    run("import", folder / f"{name}.csv", "--map", folder / "map.yaml", "--out", out, "--json")
    return out


def clouds(folder, calibration, bags):
    found = []
    for place, bag in enumerate(bags):
        out = folder / f"result{place}"
        run("correct", bag, "--calibration", calibration, "--out", out, "--no-report")
        found.append((results.CloudFile(out / "cloud.ply").read(), out / "summary.json"))
    return found


def assert_the_same_cloud(one, other):
    """Equal to the rounding of the units: 1e-15 of the stroke and of the turns."""
    (points, summary), (again, summary_again) = one, other
    assert len(points) == len(again)
    for name in ("x", "y", "height", "dynamic_error"):
        np.testing.assert_allclose(points[name], again[name], rtol=1e-6, atol=1e-14)
    counts = [json.loads(path.read_text())["samples"] for path in (summary, summary_again)]
    assert counts[0] == counts[1]


@pytest.mark.soak
def test_a_scan_as_csv_gives_the_cloud_of_its_bag(tmp_path, small_scan, true_calibration):
    calibration = tmp_path / "cal.json"
    calibration_file.save_calibration(calibration, true_calibration)
    bag = write_recording(tmp_path / "scan.mcap", small_scan)
    pair = clouds(tmp_path, calibration, (bag, imported(tmp_path, "scan", small_scan)))
    assert_the_same_cloud(*pair)


@pytest.mark.soak
def test_axes_at_half_the_rate_join_the_probe_by_their_stamps(tmp_path, small_scan):
    """Two loggers of different rates give the cloud of one, except for spline interpolation."""
    time = np.arange(len(small_scan.axes)) * 1e-3
    axes, gap = small_scan.axes, small_scan.distance.distance
    rows = np.column_stack([time, axes.x * 1e3, axes.z * 1e3, np.degrees(axes.c)])[::2]
    np.savetxt(tmp_path / "z.csv", rows, "%.12g", ",", header="t,X,Z,C", comments="")
    rows = np.column_stack([time, gap * 1e6])[301:]
    np.savetxt(tmp_path / "d.csv", rows, "%.12g", ",", header="t,d", comments="")
    (tmp_path / "map.yaml").write_text(
        "columns:\n  time: {name: t, unit: s}\n  x: {name: X, unit: mm}\n"
        "  z: {name: Z, unit: mm}\n  c: {name: C, unit: deg}\n  y: {constant: 0}\n"
        "  b: {constant: 0}\n  distance: {name: d, unit: um}\n"
    )
    files = (tmp_path / "z.csv", tmp_path / "d.csv")
    run("import", *files, "--map", tmp_path / "map.yaml", "--out", tmp_path / "own.mcap")
    write_recording(tmp_path / "one.mcap", small_scan)
    identified = identify(assemble(*zip(*blocks_of(step_test_of(Scenario())), strict=True), ()))
    calibration_file.save_calibration(tmp_path / "cal.json", identified.calibration)
    options = ("--calibration", tmp_path / "cal.json", "--no-report")
    run("correct", tmp_path / "own.mcap", "--out", tmp_path / "own", "--by-stamps", *options)
    run("correct", tmp_path / "one.mcap", "--out", tmp_path / "one", *options)
    own, one = (results.CloudFile(tmp_path / n / "cloud.ply").read() for n in ("own", "one"))
    place = np.searchsorted(one["sample"], own["sample"] + 301)
    inside = place < len(one)
    difference = own["height"][inside] - one["height"][place[inside]]
    assert len(difference) > 0.98 * len(one)
    assert np.std(difference) < 1e-9


@pytest.mark.soak
def test_the_paper_s_step_test_and_scan_as_csv(tmp_path):
    """254 000 points, 30 rpm, and the calibration of 20 steps."""
    steps, scan = step_test_of(Scenario()), scan_of(Scenario())
    bags = [write_recording(tmp_path / f"{n}.mcap", r) for n, r in (("a", steps), ("b", scan))]
    files = [imported(tmp_path, name, r) for name, r in (("steps", steps), ("scan", scan))]
    found = []
    for bag in (bags[0], files[0]):
        run("identify", bag, "--out", tmp_path / f"{bag.name}.json")
        found.append(calibration_file.load_calibration(tmp_path / f"{bag.name}.json"))
    frequencies = np.geomspace(0.1, found[0].valid_up_to, 50)
    responses = [c.dynamics.response(frequencies) for c in found]
    np.testing.assert_allclose(responses[0], responses[1], rtol=1e-6)
    assert_the_same_cloud(*clouds(tmp_path, tmp_path / "a.mcap.json", (bags[1], files[1])))


WRITE_ROWS = """
import sys
with open(sys.argv[1], "w") as file:
    file.write("n;X;Z;C;gap\\n")
    for i in range(int(sys.argv[2])):
        row = f"{i};{i % 977}.25;0.{i % 9973:06d};{i * 0.18:.4f};-{i % 89}.5\\n"
        file.write(row.replace(".", ","))
"""


@pytest.mark.soak
def test_ten_million_rows_in_the_memory_of_few(tmp_path):
    mapping = MAP.replace(" [mm]", "").replace(" [deg]", "").replace(" [um]", "")
    (tmp_path / "map.yaml").write_text(mapping + "  trigger: {name: n}\n")
    peaks = []
    for rows in (300_000, 10_000_000):
        table, out = tmp_path / "a.csv", tmp_path / f"{rows}.mcap"
        subprocess.run([sys.executable, "-c", WRITE_ROWS, table, str(rows)], check=True)
        command = [sys.executable, "-c", PEAK, "import", table, "--map", tmp_path / "map.yaml"]
        done = subprocess.run(
            [*command, "--out", out, "--json"], capture_output=True, text=True, check=True
        )
        reported, peak = done.stdout.splitlines()
        assert json.loads(reported)["files"][0]["rows"] == rows
        peaks.append(int(peak))
    assert peaks[1] < 1.2 * peaks[0]


PEAK = """
import resource, sys
from omsm_ros import cli
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.streams.motion_record import assemble
assert cli.main(sys.argv[1:]) == 0
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""
