"""Commands read the bag of a second cell, selected by namespace or topic names."""

import argparse
import json
from pathlib import Path

import pytest

from omsm_ros import cli
from omsm_ros.cli.command_line import parser_of
from omsm_ros.cli.words import WORDS
from omsm_ros.io import bags
from omsm_ros.io.bag_writer import BagWriter
from omsm_ros.io.calibration_file import save_calibration

TOPICS = (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)


@pytest.fixture(scope="module")
def second(tmp_path_factory, small_scan_blocks):
    """Write a bag of another cell with another name of the probe's topic."""
    path = tmp_path_factory.mktemp("cells") / "second.mcap"
    names = {bags.AXES_TOPIC: "/cell2/axes", bags.DISTANCE_TOPIC: "/cell2/confocal"}
    with BagWriter(path, TOPICS, names) as bag:
        for axes, distance in small_scan_blocks[:10]:
            bag.write_block(axes)
            bag.write_block(distance)
    return path


@pytest.mark.parametrize(
    "options",
    [[], ["--namespace", "/cell2"], ["--topics", "axes=/cell2/axes,confocal=/cell2/confocal"]],
)
def test_a_second_cell_is_inspected_and_corrected(
    capsys, tmp_path, second, true_calibration, options
):
    assert cli.main(["inspect", str(second), "--json", *options]) == 0
    reported = json.loads(capsys.readouterr().out)
    assert [t["samples"] for t in reported["topics"]] == [1000, 1000]
    assert reported["faults"] == []
    save_calibration(tmp_path / "cal.json", true_calibration)
    given = ["--calibration", str(tmp_path / "cal.json"), "--out", str(tmp_path / "out")]
    assert cli.main(["correct", str(second), *given, "--no-report", "--json", *options]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["samples"]["axes"]["received"] == 1000
    assert summary["bag"] == str(second)


# Every command that reads a bag, with the arguments that it needs to start.
OF_A_BAG = {
    "inspect": [],
    "correct": ["--calibration", "CAL", "--out", "OUT"],
    "identify": ["--out", "OUT"],
    "verify": ["--calibration", "CAL"],
    "predict": ["--calibration", "CAL"],
    "align": ["--calibration", "CAL", "--radius", "0.1", "--out", "OUT"],
    "selfcal": ["BAG", "--calibration", "CAL", "--out", "OUT"],
    "reversal": ["BAG", "--calibration", "CAL"],
    "adjust": ["--calibration", "CAL", "--out", "OUT"],
    "spectrum": ["--out", "OUT"],
    "form": ["--calibration", "CAL", "--nominal", "SURFACE", "--out", "OUT"],
    "sources still": ["--calibration", "CAL", "--out", "OUT"],
}
SURFACE = Path(__file__).parents[2] / "config" / "paper_mirror.yaml"


def of_a_bag(command, bag, folder):
    places = {"BAG": bag, "CAL": folder / "cal.json", "OUT": folder / "out", "SURFACE": SURFACE}
    return [
        *command.split(),
        str(bag),
        *(str(places.get(word, word)) for word in OF_A_BAG[command]),
    ]


@pytest.mark.parametrize("command", OF_A_BAG)
def test_every_command_of_a_bag_looks_for_the_cell_that_is_asked_for(
    capsys, tmp_path, second, true_calibration, command
):
    save_calibration(tmp_path / "cal.json", true_calibration)
    asked = of_a_bag(command, second, tmp_path)
    status = cli.main([*asked, "--namespace", "/cell3"])
    reported = capsys.readouterr()
    if command == "inspect":  # it lists the cell's topics, of which there are none
        assert status == 0
        assert "nothing on '/cell3/axes'" in reported.out
    else:
        assert status == 2
        assert "/cell3/" in reported.err


def test_no_command_of_a_bag_is_forgotten():
    actions = parser_of(WORDS)._actions
    (words,) = (a for a in actions if isinstance(a, argparse._SubParsersAction))
    with_cells = {
        name
        for name, sub in words.choices.items()
        if any(action.dest == "namespace" for action in sub._actions)
    }
    assert with_cells == {command.split()[0] for command in OF_A_BAG}


@pytest.mark.parametrize(
    ("command", "file", "options"),
    [
        ("predict", "motion.csv", []),
        ("identify", "record.csv", ["--input", "u", "--output", "y", "--period", "0.001"]),
        ("form", "cloud.ply", []),
    ],
)
def test_what_is_no_bag_has_no_cells(capsys, tmp_path, true_calibration, command, file, options):
    save_calibration(tmp_path / "cal.json", true_calibration)
    asked = of_a_bag(command, tmp_path / file, tmp_path)
    if command == "form":  # with a calibration it would be a scan
        place = asked.index("--calibration")
        del asked[place : place + 2]
    assert cli.main([*asked, *options, "--namespace", "/cell2"]) == 2
    assert "has no cells" in capsys.readouterr().err


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
