"""The folder for ports is the user's own, or none."""

from __future__ import annotations

from pathlib import Path

import pytest

from omsm_ros.errors import FileError
from omsm_ros.io.files import runtime_folder


@pytest.fixture(autouse=True)
def base(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return tmp_path


def test_it_is_private_and_each_cell_has_its_own(base: Path) -> None:
    folders = {runtime_folder(name) for name in ("/omsm", "/cell2", "/hall/cell3")}
    assert len(folders) == 3
    for folder in folders:
        assert folder.is_relative_to(base)
        assert folder.stat().st_mode & 0o777 == 0o700
    assert runtime_folder("/omsm") in folders  # again


def test_a_link_in_its_place_is_not_followed(base: Path, tmp_path_factory) -> None:  # type: ignore[no-untyped-def]
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    (base / "omsm_ros").symlink_to(elsewhere)
    with pytest.raises(FileError, match="not a private folder"):
        runtime_folder("/omsm")
    assert list(elsewhere.iterdir()) == []


def test_a_folder_open_to_others_is_not_trusted(base: Path) -> None:
    (base / "omsm_ros").mkdir()
    (base / "omsm_ros").chmod(0o777)
    with pytest.raises(FileError, match="not a private folder"):
        runtime_folder()


def test_without_the_variable_it_carries_the_users_number(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    import os

    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "none"))
    assert str(os.getuid()) in str(runtime_folder())
