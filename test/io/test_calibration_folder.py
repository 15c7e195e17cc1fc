"""No calibration is ever overwritten, and the link names the one in force."""

from __future__ import annotations

import os
import traceback
from dataclasses import replace
from pathlib import Path

import pytest

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.errors import CalibrationError, FileError
from omsm_ros.io.calibration_file import (
    CalibrationFolder,
    load_calibration,
    load_for_others,
    save_calibration,
    since,
)

NOON_NS = 1_800_000_000_000_000_000


@pytest.fixture
def three(true_calibration: Calibration) -> list[Calibration]:
    return [replace(true_calibration, settings={"number": k}) for k in range(3)]


def test_each_has_its_file_and_the_link_the_last(tmp_path: Path, three: list[Calibration]) -> None:
    folder = CalibrationFolder(tmp_path / "cal.json")
    files = [folder.put(c, NOON_NS + k * 10**9) for k, c in enumerate(three)]
    assert len(set(files)) == 3
    for file, calibration in zip(files, three, strict=True):
        assert load_calibration(file).id == calibration.id
        assert calibration.id[:12] in file.name
    assert "20270115T08" in files[0].name
    in_force = folder.in_force()
    assert in_force is not None
    assert (in_force[0].id, in_force[1]) == (three[2].id, NOON_NS + 2 * 10**9)
    assert {p.name for p in tmp_path.iterdir()} == {"cal.json", *(file.name for file in files)}


def test_one_that_comes_back_is_linked_again(tmp_path: Path, three: list[Calibration]) -> None:
    folder = CalibrationFolder(tmp_path / "cal.json")
    first = folder.put(three[0], NOON_NS)
    before = first.read_bytes()
    folder.put(three[1], NOON_NS + 1)
    assert folder.put(three[0], NOON_NS + 2) == first
    assert first.read_bytes() == before
    assert len(list(tmp_path.glob("cal.*.json"))) == 2
    assert load_calibration(folder.link).id == three[0].id


def test_a_file_of_an_earlier_version_is_kept(tmp_path: Path, three: list[Calibration]) -> None:
    link = tmp_path / "cal.json"
    save_calibration(link, three[0])
    CalibrationFolder(link).put(three[1], NOON_NS)
    kept = {load_calibration(p).id for p in tmp_path.glob("cal.*.json")}
    assert kept == {three[0].id, three[1].id}


def test_what_is_no_calibration_is_not_moved_away(tmp_path: Path, three: list[Calibration]) -> None:
    link = tmp_path / "cal.json"
    link.write_text("my notes")
    with pytest.raises(CalibrationError):
        CalibrationFolder(link).put(three[0], NOON_NS)
    assert link.read_text() == "my notes"


def test_nothing_in_force_yet_and_a_link_to_nowhere(tmp_path: Path) -> None:
    folder = CalibrationFolder(tmp_path / "cal.json")
    assert folder.in_force() is None
    folder.link.symlink_to("gone.json")
    with pytest.raises(CalibrationError, match="no calibration"):
        folder.in_force()


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path, three: list[Calibration]) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(FileError, match="file"):
        CalibrationFolder(tmp_path / "file" / "cal.json").put(three[0], NOON_NS)


def test_since_is_the_links_own_time(tmp_path: Path, three: list[Calibration]) -> None:
    folder = CalibrationFolder(tmp_path / "cal.json")
    target = folder.put(three[0], NOON_NS)
    os.utime(target, ns=(5, 5))
    assert since(folder.link) == NOON_NS
    assert since(target) == 5
    with pytest.raises(CalibrationError):
        since(tmp_path / "none")


@pytest.mark.parametrize(
    "content",
    [
        '{"s3cret": 1}',
        '["s3cret"]',
        '"s3cret"',
        "s3cret",
        '{"schema": "s3cret"}',
        '{"schema": "omsm-calibration/1", "id": "s3cret"}',
    ],
)
def test_an_invalid_calibration_is_not_published(tmp_path: Path, content: str) -> None:
    file = tmp_path / "cal.json"
    file.write_text(content)
    with pytest.raises(CalibrationError, match="no calibration that can be used") as refused:
        load_for_others(file)
    assert "s3cret" not in "".join(traceback.format_exception(refused.value))
    with pytest.raises(CalibrationError):
        load_calibration(file)


def test_a_calibration_is_loaded_for_others_too(
    tmp_path: Path, true_calibration: Calibration
) -> None:
    save_calibration(tmp_path / "cal.json", true_calibration)
    assert load_for_others(tmp_path / "cal.json").id == true_calibration.id
