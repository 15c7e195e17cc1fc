"""A second process is refused until the first one has ended."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from omsm_ros.errors import ConfigurationError, FileError
from omsm_ros.io.files import exclusive_lock

HOLDER = (
    "import sys, time; from pathlib import Path; from omsm_ros.io.files import exclusive_lock\n"
    "with exclusive_lock(Path(sys.argv[1])):\n"
    "    print('held', flush=True); time.sleep(60)\n"
)


def test_a_second_one_is_refused_and_a_later_one_is_not(tmp_path: Path) -> None:
    path = tmp_path / "port"
    with (
        exclusive_lock(path),
        pytest.raises(ConfigurationError, match="in use"),
        exclusive_lock(path),
    ):
        pass
    with exclusive_lock(path):
        pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("path", ["", ".", "..", "/", "a/.."])
def test_what_names_no_file_is_refused(path: str) -> None:
    with pytest.raises(ConfigurationError, match="names no file"), exclusive_lock(Path(path)):
        pass


def test_who_was_killed_holds_nothing(tmp_path: Path) -> None:
    path = tmp_path / "port"
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(path)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    with pytest.raises(ConfigurationError), exclusive_lock(path):
        pass
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    with exclusive_lock(path):
        pass


def test_a_link_laid_in_its_place_is_not_followed(tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    (tmp_path / ".port.lock").symlink_to(victim)
    with pytest.raises(FileError), exclusive_lock(tmp_path / "port"):
        pass
    assert not victim.exists()


def test_a_folder_that_is_none_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="none"), exclusive_lock(tmp_path / "none" / "port"):
        pass
