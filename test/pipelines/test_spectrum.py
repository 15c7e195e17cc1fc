"""``omsm spectrum`` on bags of the paper's four scans on the twin."""

import json

import numpy as np
import pytest

from omsm_ros import cli
from omsm_ros.core.kinematics.trajectories import Circle
from omsm_ros.core.ripple.source_hypotheses import ALIASED, ARTEFACT, KINDS, PART
from omsm_ros.core.surface.nominal import Flat
from omsm_ros.io import bags
from omsm_ros.io.bag_writer import BagWriter
from omsm_ros.io.results import CloudFile
from omsm_ros.pipelines.record_bags import write_recording
from omsm_ros.twin.cell import Cell, Probe, pieces, record
from omsm_ros.twin.disturbances import Disturbances, VibrationLine
from omsm_ros.twin.part import AzimuthalRipple
from omsm_ros.twin.probe import ProbeErrors
from omsm_ros.twin.sensors import AccelerationSensor

RADIUS, SECONDS = 21.6e-3, 10.0
SPEEDS = {"F1": 0.14, "F2": 1.875, "F3": 15.0}


def scan(name, rpm):
    """Write scans of marks of 15 µm; in F3 and F4 the machine vibrates at 680 Hz."""
    shaking = (VibrationLine(amplitude_m=5e-9, frequency_hz=680.0),) if rpm > 10 else ()
    errors = Disturbances(
        vibration=shaking,
        accelerometer=AccelerationSensor(sample_period_s=2.5e-4),
        probe=ProbeErrors(exposure_s=0.5e-3),
    )
    cell = Cell(seed=3, probe=Probe(noise=3e-9, resolution=1e-9), disturbances=errors)
    motion = Circle(Flat(), RADIUS, rpm, turns=SECONDS * rpm / 60)
    return record(cell, motion, AzimuthalRipple(Flat(), RADIUS))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scans")
    for name, rpm in SPEEDS.items():
        write_recording(folder / f"{name}.mcap", scan(name, rpm))
    return folder


@pytest.fixture(scope="module")
def result(folder):
    out = folder / "out"
    scans = [str(folder / f"{name}.mcap") for name in SPEEDS]
    assert cli.main(["spectrum", *scans, "--out", str(out), "--stop", "310", "330"]) == 0
    return out, json.loads((out / "spectrum.json").read_text())


def test_the_marks_the_folded_vibration_and_the_image(result):
    _, facts = result
    assert facts["schema"] == "omsm-spectrum/1"
    first, second, third = facts["scans"]
    for one in (first, second):
        (peak,) = one["peaks"]
        assert peak["kind"] == PART
        assert peak["true_wavelength"] == pytest.approx(15e-6, rel=1e-3)
    found = {round(peak["frequency"]): peak for peak in third["peaks"]}
    assert found[320]["kind"] == ALIASED
    assert found[320]["true_frequency"] == pytest.approx(680.0, abs=0.01)
    assert found[262]["kind"] == ARTEFACT
    assert facts["counts"] == {k: {PART: 2, ALIASED: 1, ARTEFACT: 1}.get(k, 0) for k in KINDS}


def test_the_sampling_is_that_of_table_1(result):
    _, facts = result
    found = [one["sampling"][0]["distance"] * 1e6 for one in facts["scans"]]
    np.testing.assert_allclose(found, [0.3167, 4.241, 33.93], rtol=1e-3)


def test_every_sample_is_accounted_for_and_no_calibration_is_no_band(result):
    _, facts = result
    assert facts["scans"]
    for one in facts["scans"]:
        assert one["samples"]["received"] == one["samples"]["analysed"] <= 10_000
        assert one["motion"]["outside_band_rms"] is None


def test_the_band_stop_says_what_it_did_and_its_cloud_has_it(result):
    out, facts = result
    stopped = facts["scans"][2]["band_stop"]
    assert stopped["phase"] == 0.0
    assert stopped["rms_after"] < 0.8 * stopped["rms_before"]
    at_320 = next(p for p in stopped["peaks"] if round(p["frequency"]) == 320)
    assert at_320["amplitude_after"] < 1e-3 * at_320["amplitude_before"]
    height = CloudFile(out / "band_stopped_3.ply").read()["height"]
    power = abs(np.fft.rfft(height - height.mean())) ** 2
    near = power[int(320 * len(height) / 1000) - 2 :][:5].max()
    assert near < 1e-3 * power.max()


def test_the_page_names_every_line(result):
    out, _ = result
    page = (out / "report.html").read_text()
    for text in (PART, ALIASED, ARTEFACT, "Accelerometer lines", "Sampling of the part"):
        assert text in page
    assert page.count("data:image/png") == 4


def test_a_bad_band_and_a_bag_without_samples_are_one_line(folder, tmp_path, capsys):
    scan_path = str(folder / "F1.mcap")
    arguments = ["spectrum", scan_path, "--out", str(tmp_path / "o"), "--no-report"]
    assert cli.main([*arguments, "--stop", "400", "600"]) == 2
    assert "half the sampling rate" in capsys.readouterr().err
    assert not (tmp_path / "o").exists()
    assert cli.main(arguments) == 0
    assert [file.name for file in (tmp_path / "o").glob("*.*ml")] == []
    with BagWriter(tmp_path / "empty.mcap", (bags.AXES_TOPIC,)):
        pass
    assert cli.main(["spectrum", str(tmp_path / "empty.mcap"), "--out", str(tmp_path / "o")]) == 2
    assert "Record the raw topics" in capsys.readouterr().err


def test_acceleration_goes_through_a_bag_unchanged(tmp_path):
    made = scan("F3", 15.0)
    path = write_recording(tmp_path / "a.mcap", made)
    with bags.BagReader(path) as bag:
        blocks = [block for _, block in bag.records(bags.ACCELERATION_TOPIC)]
    np.testing.assert_array_equal(np.concatenate([b.z for b in blocks]), made.acceleration.z)
    assert [b.first_sample for b in blocks[:2]] == [0, 1000]
    assert sum(map(len, pieces(made.acceleration, 777))) == len(made.acceleration)
