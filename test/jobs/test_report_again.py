"""The page of a finished correction is the one that the correction itself would have written."""

import re
from dataclasses import replace
from itertools import islice

import pytest

from omsm_ros import cli
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.errors import CalibrationError, FileError
from omsm_ros.jobs.measure import measure
from omsm_ros.jobs.record_twin import write_nominal
from omsm_ros.jobs.report_again import report_again
from omsm_ros.storage import bags, calibration_file
from omsm_ros.storage.recording.bag_writer import BagWriter


@pytest.fixture(scope="module")
def shop(tmp_path_factory, small_scan_blocks, true_calibration):
    folder = tmp_path_factory.mktemp("shop")
    with BagWriter(folder / "scan.mcap", (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)) as bag:
        for axes, distance in islice(iter(small_scan_blocks), 10):
            bag.write_axes(axes)
            bag.write_distance(distance)
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


def test_another_calibration_is_refused(shop, true_calibration):
    other = replace(true_calibration, settings={"machine": "another"})
    with pytest.raises(CalibrationError, match="give the one that it was corrected with"):
        report_again(shop / "result", other)


def test_a_folder_without_a_measurement_is_refused(tmp_path, true_calibration):
    with pytest.raises(FileError, match=r"no summary at .*check the path"):
        report_again(tmp_path, true_calibration)
