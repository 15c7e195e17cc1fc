"""Structures of NumPy, MATLAB and HDF5: each of their fields is a column."""

import struct

import numpy as np
import pytest

from omsm_ros.errors import FileError

ROWS = 50
GAP = np.linspace(-1, 9, ROWS)


def structured():
    table = np.zeros(ROWS, [("n", "i4"), ("gap", "f8"), ("who", "U3")])
    table["n"], table["gap"] = np.arange(ROWS), GAP
    return table


def written(path):
    """Write one record of a logger as a structure of the format; return the name of its field."""
    if path.suffix == ".npy":
        np.save(path, structured())
        return "gap"
    if path.suffix == ".npz":
        np.savez(path, log=structured())
    elif path.suffix == ".mat":
        fields = {"n": np.arange(ROWS), "gap": GAP, "who": "the shop"}
        pytest.importorskip("scipy.io").savemat(path, {"log": fields})
    else:
        h5py = pytest.importorskip("h5py", reason="h5py is an optional package")
        with h5py.File(path, "w") as file:
            file["log"] = structured()[["n", "gap"]]
    return "log/gap"


@pytest.mark.parametrize("name", ["a.npy", "a.npz", "a.mat", "a.h5"])
def test_a_field_of_a_structure_is_a_column(importer, name):
    field = written(importer.folder / name)
    mapping = f"sample_period: 0.001\ncolumns:\n  distance: {{name: {field}, unit: um}}\n"
    (found,) = importer(mapping, name)
    assert found.rows == ROWS
    (block,) = importer.blocks()
    assert block.distance == pytest.approx(GAP * 1e-6, abs=1e-18)


MAPPING = "sample_period: 0.001\ncolumns:\n  distance: {name: gap, unit: um}\n"


@pytest.mark.parametrize(
    ("version", "place", "value"),
    # A sparse class without sparse content, a wrong tag of the name, and VAX numbers.
    [("5", 144, 5), ("5", 176, 0x10000), ("4", 0, 2000)],
)
def test_a_matlab_file_that_ends_or_misleads_its_reader_is_refused(
    importer, version, place, value, capfd
):
    path = importer.folder / "a.mat"
    pytest.importorskip("scipy.io").savemat(path, {"n": np.arange(300.0)}, format=version)
    whole = bytearray(path.read_bytes())
    pytest.importorskip("scipy.io").savemat(path, {"gap": np.arange(300.0)}, format=version)
    importer(MAPPING, "a.mat")
    importer.out.unlink()
    whole[place : place + 4] = struct.pack("<I", value)
    path.write_bytes(whole)
    with pytest.raises(FileError, match=r"a\.mat' cannot be read: .* or as CSV") as caught:
        importer(MAPPING, "a.mat")
    assert "\n" not in str(caught.value)
    assert not importer.out.exists()
    assert capfd.readouterr().err == ""
