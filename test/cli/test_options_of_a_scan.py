"""Effects of the options of ``omsm correct`` and related commands, against closed forms."""

import json
from dataclasses import replace

import numpy as np
import pytest

from omsm_ros import cli
from omsm_ros.io import bags, results
from omsm_ros.io.bag_writer import BagWriter

MIRROR = "shape: off_axis_paraboloid\nparent_focal_length: 25.4e-3\noff_axis_distance: 50.8e-3\n"
POLARITY_MIRRORED, SLIP, LATE_S = -1, 37, 3e-3


def bag_of(path, blocks, of_axes=lambda block: block, of_distance=lambda block: block):
    with BagWriter(path, (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)) as bag:
        for axes, distance in blocks:
            bag.write_block(of_axes(axes))
            bag.write_block(of_distance(distance))
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory, small_scan_blocks):
    """Write five seconds of a scan: 5 turns at 2 mm, 2.5 revolutions of C."""
    made = tmp_path_factory.mktemp("scan")
    bag_of(made / "scan.mcap", small_scan_blocks[:50])
    (made / "mirror.yaml").write_text(MIRROR)
    return made


@pytest.fixture
def corrected(capsys, tmp_path, folder, calibration):
    """Correct a bag of the folder; return its summary and points."""

    def correct(*more, bag="scan.mcap", status=0):
        out = tmp_path / f"out{len(list(tmp_path.iterdir()))}"
        words = ["correct", folder / bag, "--calibration", calibration, "--out", out, "--no-report"]
        assert cli.main([str(word) for word in (*words, *more, "--json")]) == status
        said = capsys.readouterr()
        if status:
            return said.err
        return json.loads(said.out), results.CloudFile(out / "cloud.ply").read()

    return correct


def test_a_probe_that_reads_the_other_way_is_turned_by_its_polarity(
    corrected, folder, small_scan_blocks
):
    usual = corrected()[1]
    bag_of(
        folder / "mirrored.mcap", small_scan_blocks[:50],
        of_distance=lambda block: replace(block, distance=-block.distance),
    )  # fmt: skip
    turned = corrected("--polarity", -1, bag="mirrored.mcap")[1]
    np.testing.assert_array_equal(turned["height"], usual["height"])
    unturned = corrected(bag="mirrored.mcap")[1]
    assert np.ptp(unturned["height"] - usual["height"]) > 1e-7


def test_the_centre_of_the_spindle_moves_the_points(corrected, tmp_path):
    (tmp_path / "geometry.yaml").write_text("centre_x: 2.0e-4\n")
    before, after = corrected()[1], corrected("--geometry", tmp_path / "geometry.yaml")[1]
    radii = [np.hypot(cloud["x"], cloud["y"]) for cloud in (before, after)]
    np.testing.assert_allclose(radii[0] - radii[1], 2e-4, atol=1e-9)
    np.testing.assert_array_equal(before["sample"], after["sample"])


def test_a_probe_latency_turns_the_points_by_what_the_spindle_does_meanwhile(corrected):
    before, after = corrected()[1], corrected("--probe-latency", 2e-3)[1]
    _, here, there = np.intersect1d(before["sample"], after["sample"], return_indices=True)
    angles = [np.arctan2(c["y"][i], c["x"][i]) for c, i in ((before, here), (after, there))]
    turned = np.angle(np.exp(1j * (angles[1] - angles[0])))
    # 30 turns a minute; the first samples have no motion before them.
    np.testing.assert_allclose(np.abs(turned[100:]), np.pi * 2e-3, rtol=0.01)
    assert np.ptp(turned[100:]) < 1e-4


def test_a_measured_pitch_is_taken_off_over_the_arm(corrected, tmp_path):
    arm, per_m = 0.05, 2e-3
    (tmp_path / "geometry.yaml").write_text(f"abbe_arm: {arm}\n")
    (tmp_path / "pitch.csv").write_text(f"z_m,pitch_rad\n-1,{-per_m}\n1,{per_m}\n")
    geometry = ("--geometry", tmp_path / "geometry.yaml")
    flat = corrected(*geometry)[1]
    pitched = corrected(*geometry, "--pitch", tmp_path / "pitch.csv")[1]
    change = pitched["height"] - flat["height"]
    slope, offset = np.polyfit(flat["height"], change, 1)
    # The height of the surface is the travel of Z, except for micrometres of the probe.
    assert abs(slope) == pytest.approx(arm * per_m, rel=0.02)
    assert np.std(change - slope * flat["height"] - offset) < 0.02 * np.std(change)
    assert "abbe_arm" in corrected("--pitch", tmp_path / "pitch.csv", status=2)


def test_a_lateral_uncertainty_costs_by_the_slope_of_the_surface(corrected, folder):
    nominal = ("--nominal", folder / "mirror.yaml")
    plain, broad = corrected(*nominal)[1], corrected(*nominal, "--lateral", 1e-6)[1]
    added = np.sqrt(np.maximum(broad["uncertainty"] ** 2.0 - plain["uncertainty"] ** 2.0, 0.0))
    # z = r² / 2R about its axis, with slope r / R; 2 f (1 + (d / 2f)²)^1.5 across and along.
    slopes = added / 1e-6 / np.hypot(plain["x"], plain["y"])
    focal, off = 25.4e-3, 50.8e-3
    secant = np.hypot(1.0, off / (2 * focal))
    steep, flat = 1 / (2 * focal * secant), 1 / (2 * focal * secant**3)
    assert np.max(slopes) == pytest.approx(steep, rel=0.1)
    assert np.min(slopes) == pytest.approx(flat, rel=0.1)
    assert "--nominal" in corrected("--lateral", 1e-6, status=2)


def slipped(summary, samples):
    """No sample is corrected and the reason is counted: a wrong pair would be µm of height."""
    account = summary["samples"]["distance"]
    assert account["corrected"] == 0
    assert account["counted"]["slipped"] > 4900
    assert any(f"slipped by {samples} samples" in text for text in summary["warnings"])


def test_counters_that_are_apart_are_put_together_by_the_offset(
    corrected, folder, small_scan_blocks
):
    bag_of(
        folder / "apart.mcap", small_scan_blocks[:50],
        of_distance=lambda block: replace(block, first_sample=block.first_sample + SLIP),
    )  # fmt: skip
    usual, found = corrected()[1], corrected("--counter-offset", -SLIP, bag="apart.mcap")[1]
    np.testing.assert_array_equal(found["height"], usual["height"])
    slipped(corrected(bag="apart.mcap")[0], SLIP)


def test_stamps_that_are_apart_are_one_trigger_within_the_tolerance(
    corrected, folder, small_scan_blocks
):
    late = round(LATE_S * 1e9)
    bag_of(
        folder / "late.mcap", small_scan_blocks[:50],
        of_axes=lambda block: replace(block, stamp_ns=block.stamp_ns + 10**9 + late),
        of_distance=lambda block: replace(block, stamp_ns=block.stamp_ns + 10**9),
    )  # fmt: skip
    usual = corrected()[1]
    reported = corrected("--stamp-tolerance", 1.2 * LATE_S, bag="late.mcap")
    np.testing.assert_array_equal(reported[1]["height"], usual["height"])
    slipped(corrected(bag="late.mcap")[0], 3)


def test_an_aperture_limits_what_is_fitted_and_a_tolerance_judges_it(corrected, folder):
    fit = ("--nominal", folder / "mirror.yaml", "--fit", "piston,tip,tilt")
    whole, cloud = corrected(*fit, "--tolerance", 1e-6)
    part, _ = corrected(*fit, "--aperture", "1.9e-3", "--tolerance", 1e-12)
    radius = np.hypot(cloud["x"], cloud["y"])
    inside = int(np.count_nonzero(radius <= 1.9e-3))
    assert 0 < inside < len(cloud)
    counted = part["form"]["points"]
    assert counted["read"] == whole["form"]["points"]["read"]
    outside = [n for name, n in counted.items() if name != "read" and "outside" in name]
    assert sum(outside) == pytest.approx(len(cloud) - inside, abs=2)
    for summary, tolerance in ((whole, 1e-6), (part, 1e-12)):
        held = summary["conformity"]
        assert held["tolerance"] == tolerance
        assert held["verdict"] == "cannot tell"
    # Some nanometres are far within the tolerance, but the scan ends before the centre.
    figures, radius = whole["figures"]["peak_to_valley"], float(radius.min())
    assert figures["value"] + 2 * figures["standard_uncertainty"] < 1e-6
    assert radius > 0.5e-3
    assert "of the aperture has no points" in whole["conformity"]["reasons"][0]
    assert "--fit auto" in corrected("--tolerance", 1e-9, status=2)


def test_what_is_known_of_the_geometry_is_kept_by_align(
    capsys, tmp_path, folder, calibration, monkeypatch
):
    from omsm_ros.cli import adjust
    from omsm_ros.errors import DataError

    asked = []

    def refuse(bag, known_calibration, radius, known):
        asked.append((radius, known))
        raise DataError("enough")

    monkeypatch.setattr(adjust, "alignment_of", refuse)
    (tmp_path / "known.yaml").write_text("abbe_arm: 0.12\nprobe_z: 0.3\n")
    words = ["align", folder / "scan.mcap", "--calibration", calibration, "--radius", "-0.05"]
    words += ["--geometry", tmp_path / "known.yaml", "--out", tmp_path / "geometry.yaml"]
    assert cli.main([str(word) for word in words]) == 2
    assert capsys.readouterr().err == "omsm: enough\n"
    ((radius, known),) = asked
    assert (radius, known.abbe_arm, known.probe_z) == (-0.05, 0.12, 0.3)
    assert not (tmp_path / "geometry.yaml").exists()


def spectrum(capsys, folder, tmp_path, calibration, *more, bag="scan.mcap"):
    out = tmp_path / f"spectrum{len(list(tmp_path.iterdir()))}"
    words = ["spectrum", folder / bag, "--calibration", calibration, "--out", out, "--no-report"]
    status = cli.main([str(word) for word in (*words, *more, "--json")])
    said = capsys.readouterr()
    return status, (json.loads(said.out) if said.out else said.err)


def test_a_spectrum_is_made_with_a_calibration_that_belongs_or_is_overridden(
    capsys, tmp_path, folder, calibration
):
    foreign = ("--settings", '{"machine": "another"}')
    status, said = spectrum(capsys, folder, tmp_path, calibration, *foreign)
    assert status == 2
    assert "another" in said
    status, found = spectrum(capsys, folder, tmp_path, calibration, *foreign, "--override")
    assert status == 0
    assert found["scans"][0]["samples"]["analysed"] > 4000


def test_a_spectrum_of_a_mirrored_probe_is_the_same_with_its_polarity(
    capsys, tmp_path, folder, calibration, small_scan_blocks
):
    bag_of(
        folder / "mirrored2.mcap", small_scan_blocks[:50],
        of_distance=lambda block: replace(block, distance=-block.distance),
    )  # fmt: skip
    usual = spectrum(capsys, folder, tmp_path, calibration)[1]["scans"][0]
    turned = spectrum(
        capsys, folder, tmp_path, calibration, "--polarity", -1, bag="mirrored2.mcap"
    )[1]["scans"][0]  # fmt: skip
    assert turned["noise"]["rms"] == pytest.approx(usual["noise"]["rms"], rel=1e-9)
    unturned = spectrum(capsys, folder, tmp_path, calibration, bag="mirrored2.mcap")
    assert unturned[0] == 2 or unturned[1]["scans"][0] != usual


def test_identify_puts_counters_together_by_the_offset(capsys, tmp_path, step_test):
    from omsm_ros.twin.cell import blocks_of

    blocks = blocks_of(step_test)
    bag_of(
        tmp_path / "apart.mcap", blocks,
        of_distance=lambda block: replace(block, first_sample=block.first_sample + SLIP),
    )  # fmt: skip
    words = ["identify", tmp_path / "apart.mcap", "--order", 2, "--json", "--out"]
    offset = ("--counter-offset", -SLIP, "--stamp-tolerance", 5e-4)
    status = cli.main([str(word) for word in (*words, tmp_path / "cal.json", *offset)])
    found = json.loads(capsys.readouterr().out)
    assert status == 0
    assert found["low_frequency_delay"] == pytest.approx(0.3397e-3, abs=5e-6)
    alone = cli.main([str(word) for word in (*words, tmp_path / "alone.json")])
    said = capsys.readouterr()
    assert alone == 2
    assert "slipped" in said.err or "rejected" in said.err


def test_a_motion_is_averaged_over_the_exposure(corrected, folder, small_scan_blocks):
    """Averaging leaves sin(π f T)/(π f T) of Z at 20 Hz; the path filter follows to 1 %."""
    frequency, amplitude, exposure = 20.0, 1e-6, 5e-3

    def swinging(block):
        time = block.sample_period * (block.first_sample + np.arange(len(block.z)))
        return replace(block, z=block.z + amplitude * np.sin(2 * np.pi * frequency * time))

    bag_of(folder / "swinging.mcap", small_scan_blocks[:50], of_axes=swinging)
    clouds = [
        corrected("--by-stamps", *more, bag="swinging.mcap")[1]
        for more in ((), ("--exposure", exposure))
    ]
    _, here, there = np.intersect1d(*(c["sample"] for c in clouds), return_indices=True)
    change = (clouds[1]["height"][there] - clouds[0]["height"][here])[200:-200]
    lost = amplitude * (1 - np.sinc(frequency * exposure))
    assert np.std(change) * np.sqrt(2) == pytest.approx(lost, rel=0.05)
