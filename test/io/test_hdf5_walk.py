"""A damaged HDF5 file neither holds nor ends the program that reads it."""

import itertools
import os
import signal

import numpy as np
import pytest

from omsm_ros.errors import FileError
from omsm_ros.io import child_process
from omsm_ros.io.child_process import walk_in_child

h5py = pytest.importorskip("h5py", reason="h5py is an optional package")


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "points.h5"
    with h5py.File(path, "w") as content:
        content.create_dataset("x", data=np.arange(10.0)).attrs["units"] = "m"
    return path


def test_a_good_file_is_let_through(file):
    walk_in_child(file, "it")


def test_what_the_library_refuses_is_reported(tmp_path):
    path = tmp_path / "none.h5"
    path.write_bytes(b"no HDF5")
    with pytest.raises(FileError, match="it cannot be read"):
        walk_in_child(path, "it")


@pytest.mark.parametrize(
    ("deed", "reported"),
    [
        (lambda *_: all(itertools.count(1)), "it was not read in 1 s"),
        (lambda *_: os.kill(os.getpid(), signal.SIGSEGV), "the program that reads it ended"),
    ],
)
def test_a_library_that_does_not_end_or_crashes_is_ended(file, monkeypatch, deed, reported):
    monkeypatch.setattr(h5py, "File", deed)
    monkeypatch.setattr(child_process, "_FILE_S", 0.3)
    with pytest.raises(FileError, match=reported):
        walk_in_child(file, "it")
