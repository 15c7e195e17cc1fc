"""The certificate's files, from the function and from the command."""

from __future__ import annotations

import json

import pytest

from omsm_ros import cli
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.streams.motion_record import assemble
from omsm_ros.errors import FileError
from omsm_ros.io import bags
from omsm_ros.io.bag_writer import BagWriter
from omsm_ros.io.calibration_file import load_calibration
from omsm_ros.pipelines.identify import DCC, PAGE, write_certificate
from omsm_ros.twin.cell import blocks_of


@pytest.fixture(scope="module")
def bag(tmp_path_factory, step_test):
    path = tmp_path_factory.mktemp("bags") / "steps.mcap"
    with BagWriter(path, (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)) as writer:
        for axes, distance in blocks_of(step_test):
            writer.write_block(axes)
            writer.write_block(distance)
    return path


def test_identify_writes_the_certificate_it_is_asked_for(capsys, bag, tmp_path):
    out, folder = tmp_path / "cal.json", tmp_path / "report"
    arguments = ["identify", bag, "--out", out, "--order", 2, "--report", folder, "--json"]
    assert cli.main([str(a) for a in arguments]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["report"] == str(folder / PAGE)
    assert {p.name for p in folder.iterdir()} == {PAGE, DCC}
    identity = load_calibration(out).id
    text = (folder / PAGE).read_text(encoding="utf-8")
    assert identity in text
    assert "steps" in text


@pytest.mark.soak
def test_identify_speaks_of_the_certificate_to_people(capsys, bag, tmp_path):
    folder = tmp_path / "report"
    arguments = ["identify", bag, "--out", tmp_path / "c.json", "--order", 1, "--report", folder]
    assert cli.main([str(a) for a in arguments]) == 0
    assert str(folder / PAGE) in capsys.readouterr().out


@pytest.fixture(scope="module")
def identified(step_test):
    return identify(assemble([step_test.axes], [step_test.distance]), order=2)


def test_text_that_has_no_bytes_is_replaced(tmp_path, identified):
    write_certificate(tmp_path, identified, source="\ud800.mcap")
    assert "?.mcap" in (tmp_path / PAGE).read_text(encoding="utf-8")


def test_a_folder_that_is_a_file_is_one_clear_error(tmp_path, identified):
    (tmp_path / "taken").write_text("")
    with pytest.raises(FileError, match="taken"):
        write_certificate(tmp_path / "taken", identified)
