"""Time of a scan, age of its calibration and temperature, in bag, summary and page."""

from dataclasses import replace
from itertools import islice

import pytest
from certified import certified_by

from omsm_ros.core.calibration.calibration import age_at
from omsm_ros.errors import CalibrationError
from omsm_ros.io import bags
from omsm_ros.io.bag_writer import BagWriter
from omsm_ros.io.message_mapping import typestore
from omsm_ros.io.topics import TEMPERATURE_TOPIC
from omsm_ros.pipelines.measure import measure

DAY_NS = 86_400 * 10**9
NOON_NS = 1_790_000_000 * 10**9


def record(path, blocks, temperatures, start_ns=NOON_NS):
    types = typestore().types
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](0, 0), "probe")
    with BagWriter(path, (bags.AXES_TOPIC, bags.DISTANCE_TOPIC, TEMPERATURE_TOPIC)) as bag:
        for axes, distance in islice(iter(blocks), 30):
            late = start_ns - blocks[0][0].stamp_ns
            bag.write_block(replace(axes, stamp_ns=axes.stamp_ns + late))
            bag.write_block(replace(distance, stamp_ns=distance.stamp_ns + late))
        for k, value in enumerate(temperatures):
            reading = types["sensor_msgs/msg/Temperature"](header, value, 0.0)
            bag.write(TEMPERATURE_TOPIC, start_ns + k * 10**8, reading)
    return path


def dated(calibration, recorded_ns):
    certificate = certified_by({"recorded_ns": recorded_ns}, calibration.certificate)
    return replace(calibration, certificate=certified_by(certificate))


def test_summary_and_page_tell_age_and_temperature(tmp_path, small_scan_blocks, true_calibration):
    bag = record(tmp_path / "a.mcap", small_scan_blocks, [20.0, 20.3, 20.1])
    old = dated(true_calibration, NOON_NS - 3 * DAY_NS)
    summary = measure(bag, old, tmp_path / "out")
    reported = summary["conditions"]
    assert reported["recorded_ns"] == NOON_NS
    assert reported["calibration_age"] == 3 * 86_400
    assert reported["temperature"] == {
        "mean": pytest.approx(20.1333, abs=1e-3), "lowest": 20.0, "highest": 20.3,
        "change": pytest.approx(0.1),
    }  # fmt: skip
    page = (tmp_path / "out/report.html").read_text()
    assert "3.0 d" in page
    assert "20.13 °C, +0.10 K from start to end" in page
    assert "2026-09-21" in page


def test_what_nobody_recorded_is_not_known(tmp_path, small_scan_blocks, true_calibration):
    bag = record(tmp_path / "a.mcap", small_scan_blocks, [], start_ns=10**9)
    summary = measure(bag, dated(true_calibration, NOON_NS), tmp_path / "out", report=False)
    assert summary["conditions"] == {
        "recorded_ns": None, "calibration_age": None, "temperature": None,
    }  # fmt: skip


def test_a_certificate_without_a_date_has_no_age(true_calibration):
    assert age_at(dated(true_calibration, None), NOON_NS) is None


@pytest.mark.parametrize("entry", ["yesterday", 1.5, True])
def test_a_date_that_is_none_is_refused(true_calibration, entry):
    with pytest.raises(CalibrationError, match="recorded_ns is"):
        dated(true_calibration, entry)


def test_an_implausible_temperature_is_reported(tmp_path, small_scan_blocks, true_calibration):
    """One temperature is in kelvin; the scan itself is not affected."""
    bag = record(tmp_path / "a.mcap", small_scan_blocks, [293.15, 20.0])
    summary = measure(bag, true_calibration, tmp_path / "out", report=False)
    assert summary["conditions"]["temperature"]["mean"] == 20.0
    (said,) = [w for w in summary["warnings"] if "temperatures" in w]
    assert said.startswith("1 of 2 temperatures are implausible, expected from -100 to 200 °C")
