"""Tables in files of arrays: their sizes are known before they are held."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from omsm_ros.errors import FileError
from omsm_ros.io.tables.binary_table import ArrayTable

Z = np.sin(np.arange(5000) / 7)


def write_npz(path: Path, **columns: np.ndarray) -> None:
    np.savez_compressed(path, **columns)


def write_mat(path: Path, **columns: np.ndarray) -> None:
    savemat(path, columns, do_compression=True)


def write_h5(path: Path, **columns: np.ndarray) -> None:
    h5py = pytest.importorskip("h5py", reason="the extra 'formats' is not installed")
    with h5py.File(path, "w") as content:
        for name, values in columns.items():
            content.create_dataset(
                name, data=values, chunks=(1, min(values.size, 10_000)), compression="gzip"
            )


def columns_of(path: Path, *names: str) -> dict[str, np.ndarray]:
    pieces = list(ArrayTable(path).pieces(names, ()))
    return {name: np.concatenate([piece[name] for piece in pieces]) for name in names}


@pytest.mark.parametrize(("name", "write"), [("a.npz", write_npz), ("a.mat", write_mat)])
def test_an_archive_that_would_fill_memory_is_refused_before(tmp_path, name, write):
    write(tmp_path / name, z=Z, bomb=np.zeros(20_000_000))
    tracemalloc.start()
    with pytest.raises(FileError, match="would unpack to 1600"):
        ArrayTable(tmp_path / name)
    held = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert held < 10e6


@pytest.mark.parametrize(("name", "write"), [("a.npz", write_npz), ("a.mat", write_mat)])
def test_columns_that_stood_still_are_no_bomb(tmp_path, name, write):
    """A column of zeros packs a thousand times; the recording that it is in does not."""
    write(tmp_path / name, z=Z, x=np.zeros(5000), y=np.zeros(1_000_000))
    read = columns_of(tmp_path / name, "z")
    np.testing.assert_array_equal(*read.values(), Z)


def test_a_row_of_hdf5_is_a_column_read_in_parts(tmp_path):
    """As MATLAB writes it; one of zeros, 160 MB of them, is not held whole."""
    write_h5(tmp_path / "a.h5", z=Z[np.newaxis], x=2 * Z[np.newaxis])
    read = columns_of(tmp_path / "a.h5", "z", "x")
    np.testing.assert_array_equal(read["z"], Z)
    np.testing.assert_array_equal(read["x"], 2 * Z)
    write_h5(tmp_path / "b.h5", z=np.zeros((1, 20_000_000)))
    tracemalloc.start()
    for piece in ArrayTable(tmp_path / "b.h5").pieces(["z"], ()):
        assert not piece["z"].any()
    held = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert held < 50e6


def test_an_array_alone_is_mapped(tmp_path):
    np.save(tmp_path / "a.npy", np.stack([Z, 2 * Z], axis=1))
    read = columns_of(tmp_path / "a.npy", "[0]", "[1]")
    np.testing.assert_array_equal(read["[1]"], 2 * Z)
    with (tmp_path / "a.npy").open("r+b") as stream:
        stream.truncate(5000)
    with pytest.raises(FileError, match="cannot be read"):
        ArrayTable(tmp_path / "a.npy")


def test_a_name_of_two_arrays_stands_twice_so_that_it_is_refused(tmp_path):
    write_npz(tmp_path / "a.npz", **{"p": np.ones((5, 2)), "p[0]": np.zeros(5)})
    assert sorted(ArrayTable(tmp_path / "a.npz").names) == ["p[0]", "p[0]", "p[1]"]
    assert np.all(columns_of(tmp_path / "a.npz", "p[1]")["p[1]"] == 1.0)
