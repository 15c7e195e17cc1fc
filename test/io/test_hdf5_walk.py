"""A damaged HDF5 file neither holds nor ends the program that reads it."""

import os
import subprocess
from types import SimpleNamespace

import numpy as np
import pytest

from omsm_ros.errors import FileError
from omsm_ros.io import optional_libraries
from omsm_ros.io.optional_libraries import walk_in_subprocess

h5py = pytest.importorskip("h5py", reason="h5py is an optional package")


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "points.h5"
    with h5py.File(path, "w") as content:
        content.create_dataset("x", data=np.arange(10.0)).attrs["units"] = "m"
    return path


def test_a_good_file_is_let_through(file):
    walk_in_subprocess(file, "it")


def test_what_the_library_refuses_is_left_to_its_reader(tmp_path):
    path = tmp_path / "none.h5"
    path.write_bytes(b"no HDF5")
    walk_in_subprocess(path, "it")


def test_a_process_that_does_not_end_is_reported(file, monkeypatch):
    """The library in a loop: another of its name, which takes the processor for ever."""
    (file.parent / "h5py.py").write_text("while True:\n    pass\n")
    monkeypatch.setenv("PYTHONPATH", str(file.parent), prepend=os.pathsep)
    monkeypatch.setattr(optional_libraries, "LIMIT_S", 0.5)
    begun = os.times()
    with pytest.raises(FileError, match="it is not read in 1 s"):
        walk_in_subprocess(file, "it")
    now = os.times()
    took = (now.children_user + now.children_system) - (begun.children_user + begun.children_system)
    # The system counts in its own ticks.
    assert 0.5 < took < 2.5


def test_a_process_that_waits_forever_is_reported(file, monkeypatch):
    (file.parent / "h5py.py").write_text("import time\ntime.sleep(1000)\n")
    monkeypatch.setenv("PYTHONPATH", str(file.parent), prepend=os.pathsep)
    monkeypatch.setattr(optional_libraries, "_WAITING", 0.5)
    with pytest.raises(FileError, match="it is not read in 3 s"):
        walk_in_subprocess(file, "it")


def test_a_crash_of_the_process_is_reported(file, monkeypatch):
    killed = SimpleNamespace(returncode=-11)
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: killed)
    with pytest.raises(FileError, match="it ends the program"):
        walk_in_subprocess(file, "it")
