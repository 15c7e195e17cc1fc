"""Commands read the bag of a second cell, by its namespace or the names of its topics."""

import json

import pytest

from omsm_ros import cli
from omsm_ros.storage import bags
from omsm_ros.storage.calibration_file import save_calibration
from omsm_ros.storage.recording.bag_writer import BagWriter

TOPICS = (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)


@pytest.fixture(scope="module")
def second(tmp_path_factory, small_scan_blocks):
    """A bag of another cell, whose probe's topic has a name of its own."""
    path = tmp_path_factory.mktemp("cells") / "second.mcap"
    names = {bags.AXES_TOPIC: "/cell2/axes", bags.DISTANCE_TOPIC: "/cell2/confocal"}
    with BagWriter(path, TOPICS, names) as bag:
        for axes, distance in small_scan_blocks[:10]:
            bag.write_axes(axes)
            bag.write_distance(distance)
    return path


@pytest.mark.parametrize(
    "options",
    [
        [],
        ["--namespace", "/cell2"],
        ["--topics", "axes=/cell2/axes,confocal=/cell2/confocal"],
    ],
)
def test_a_second_cell_is_inspected_and_corrected(
    capsys, tmp_path, second, true_calibration, options
):
    assert cli.main(["inspect", str(second), "--json", *options]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [t["samples"] for t in told["topics"]] == [1000, 1000]
    assert told["faults"] == []
    save_calibration(tmp_path / "cal.json", true_calibration)
    given = ["--calibration", str(tmp_path / "cal.json"), "--out", str(tmp_path / "out")]
    assert cli.main(["correct", str(second), *given, "--no-report", "--json", *options]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["samples"]["axes"]["received"] == 1000
    assert summary["bag"] == str(second)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (["--namespace", "/cell3"], "/cell3/axes"),
        (["--topics", "axes"], "NAME=/TOPIC"),
        (["--topics", "spindle=/x"], "spindle"),
    ],
)
def test_a_cell_that_is_not_there_is_named(capsys, tmp_path, second, options, named):
    given = ["--out", str(tmp_path / "cal.json"), *options]
    assert cli.main(["identify", str(second), *given]) == 2
    assert named in capsys.readouterr().err
