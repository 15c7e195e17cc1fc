"""Services read only below the folders that the node's parameters name."""

from pathlib import Path

import pytest

from omsm_ros.errors import BagError
from omsm_ros.io.files import resolved_within


@pytest.mark.parametrize("way", ["{}/../../etc/passwd", "/etc/passwd", "{}/link", "x" * 5000])
def test_ways_out_of_the_folder_are_refused(tmp_path: Path, way: str) -> None:
    inside = tmp_path / "cal"
    inside.mkdir()
    (inside / "link").symlink_to("/etc/passwd")
    with pytest.raises(BagError) as refused:
        resolved_within(Path(way.format(inside)), f"/nowhere:{inside}", BagError, "bag")
    assert "root:" not in str(refused.value)
    assert len(str(refused.value)) < 1000


def test_what_lies_below_is_let_in(tmp_path: Path) -> None:
    file = tmp_path / "a" / "cal.json"
    assert resolved_within(file, str(tmp_path), BagError, "bag") == file
    assert resolved_within(file, "", BagError, "bag") == file


def test_by_default_it_is_the_home_folder_and_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("home", "here", "other"):
        (tmp_path / name).mkdir()
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path / "here")
    assert (
        resolved_within(Path("~/cal.json"), "~:.", BagError, "bag")
        == tmp_path / "home" / "cal.json"
    )
    assert (
        resolved_within(Path("cal.json"), "~:.", BagError, "bag") == tmp_path / "here" / "cal.json"
    )
    with pytest.raises(BagError, match=r"outside the folders.*bag_folders"):
        resolved_within(tmp_path / "other" / "cal.json", "~:.", BagError, "bag")
