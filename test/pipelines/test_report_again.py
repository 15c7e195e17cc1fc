"""The report written later equals the one that the correction writes itself."""

import json
import re
import shutil
from dataclasses import replace
from itertools import islice

import pytest

from omsm_ros import cli
from omsm_ros.core.correction.correct import CorrectionOptions
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.errors import CalibrationError, ConfigurationError, FileError
from omsm_ros.io import bags, calibration_file
from omsm_ros.io.bag_writer import BagWriter
from omsm_ros.pipelines.correct import Admission
from omsm_ros.pipelines.measure import measure
from omsm_ros.pipelines.publish import report_again
from omsm_ros.pipelines.record_bags import write_nominal


@pytest.fixture(scope="module")
def shop(tmp_path_factory, small_scan_blocks, true_calibration):
    folder = tmp_path_factory.mktemp("shop")
    with BagWriter(folder / "scan.mcap", (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)) as bag:
        for axes, distance in islice(iter(small_scan_blocks), 10):
            bag.write_block(axes)
            bag.write_block(distance)
    write_nominal(folder / "mirror.yaml")
    calibration_file.save_calibration(folder / "cal.json", true_calibration)
    measure(folder / "scan.mcap", true_calibration, folder / "result", nominal=PAPER_MIRROR)
    return folder


def without_date(page):
    return re.sub(r"\d{4}-\d\d-\d\d \d\d:\d\d UTC", "", page)


def test_it_is_the_page_of_the_correction(shop, capsys):
    page = shop / "result" / "report.html"
    first = page.read_text()
    page.unlink()
    arguments = ["--calibration", str(shop / "cal.json"), "--nominal", str(shop / "mirror.yaml")]
    assert cli.main(["report", str(shop / "result"), *arguments]) == 0
    assert str(page) in capsys.readouterr().out
    assert without_date(page.read_text()) == without_date(first)


def test_another_nominal_surface_is_refused(shop, tmp_path, capsys):
    folder = shutil.copytree(shop / "result", tmp_path / "result")
    (tmp_path / "other.yaml").write_text("shape: sphere\nradius: 0.1\n")
    given = ["--calibration", str(shop / "cal.json"), "--nominal", str(tmp_path / "other.yaml")]
    before = (folder / "report.html").read_bytes()
    assert cli.main(["report", str(folder), *given]) == 2
    assert "from that of the correction" in capsys.readouterr().err
    assert (folder / "report.html").read_bytes() == before


def test_a_rate_that_was_overridden_is_drawn_over_its_own_time(
    tmp_path, small_scan_blocks, true_calibration
):
    with BagWriter(tmp_path / "scan.mcap", (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)) as bag:
        for axes, distance in islice(iter(small_scan_blocks), 10):
            slower = {"sample_period": 2e-3, "stamp_ns": 2 * axes.stamp_ns}
            bag.write_block(replace(axes, **slower))
            bag.write_block(replace(distance, **slower))
    measure(
        tmp_path / "scan.mcap", true_calibration, tmp_path / "out",
        options=CorrectionOptions(accept_other_rate=True), admission=Admission(override=True),
    )  # fmt: skip
    page = tmp_path / "out" / "report.html"
    first = page.read_text()
    report_again(tmp_path / "out", true_calibration)
    assert without_date(page.read_text()) == without_date(first)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["sample_period"] == 2e-3


def test_another_calibration_is_refused(shop, true_calibration):
    other = replace(true_calibration, settings={"machine": "another"})
    with pytest.raises(CalibrationError, match="give the calibration of the correction"):
        report_again(shop / "result", other)


def test_deviations_are_not_drawn_as_heights(shop, true_calibration):
    with pytest.raises(ConfigurationError, match=r"nominal surface.*--nominal"):
        report_again(shop / "result", true_calibration)


def test_a_folder_without_a_measurement_is_refused(tmp_path, true_calibration):
    with pytest.raises(FileError, match=r"no summary at .*check the path"):
        report_again(tmp_path, true_calibration)


@pytest.mark.parametrize(
    ("path", "value", "reported"),
    [
        (["dynamic_error_before"], 1e-9, "dynamic_error_before is 1e-09, expected names and"),
        (["deviation", "corrected"], {"rms": 1e-9}, "peak_to_valley is required"),
        (["verdict", "code"], "green", "verdict.code is 'green', expected one of"),
        (["verdict", "reasons", 0], 100, r"verdict.reasons[0] is 100, expected names and values"),
        (["budget", "sources", 0], {"source": "tilt"}, "says is required"),
        (["prediction", "limits", 0, "speed_factor"], None, "is None, expected a number"),
        (["samples", "axes", "received"], -1, "samples.axes.received is -1, expected 0 to"),
        (["samples", "axes", "counted"], {"lost": "many"}, "lost is 'many', expected a whole"),
        (["conditions", "recorded_ns"], 1e300, "recorded_ns is 1e+300, expected -2.1"),
        (["uncertainty", "median"], 1e300, "uncertainty.median is 1e+300, expected -1e+50"),
        (["warnings"], "slow", "warnings is 'slow', expected a list"),
    ],
)
def test_a_summary_that_was_changed_is_refused(shop, tmp_path, capsys, path, value, reported):
    folder = shutil.copytree(shop / "result", tmp_path / "result")
    summary = json.loads((folder / "summary.json").read_text())
    place = summary
    for name in path[:-1]:
        place = place[name]
    place[path[-1]] = value
    (folder / "summary.json").write_text(json.dumps(summary))
    before = (folder / "report.html").read_bytes()
    assert cli.main(["report", str(folder), "--calibration", str(shop / "cal.json")]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert reported in err
    assert (folder / "report.html").read_bytes() == before
