"""A damaged HDF5 file neither holds nor ends the program that reads it."""

import subprocess
from types import SimpleNamespace

import numpy as np
import pytest

from omsm_ros.errors import FileError
from omsm_ros.storage import hdf5_walk
from omsm_ros.storage.hdf5_walk import walked

h5py = pytest.importorskip("h5py", reason="h5py is an optional package")


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "points.h5"
    with h5py.File(path, "w") as content:
        content.create_dataset("x", data=np.arange(10.0)).attrs["units"] = "m"
    return path


def test_a_good_file_is_let_through(file):
    walked(file, "it")


def test_what_the_library_refuses_is_left_to_its_reader(tmp_path):
    path = tmp_path / "none.h5"
    path.write_bytes(b"no HDF5")
    walked(path, "it")


def test_one_that_does_not_end_is_told(file, monkeypatch):
    monkeypatch.setattr(hdf5_walk, "LIMIT_S", 1e-3)
    with pytest.raises(FileError, match="it is not read in"):
        walked(file, "it")


def test_one_that_ends_the_process_is_told(file, monkeypatch):
    killed = SimpleNamespace(returncode=-11)
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: killed)
    with pytest.raises(FileError, match="it ends the program"):
        walked(file, "it")
