"""Structures of NumPy, MATLAB and HDF5: each of their fields is a column."""

import numpy as np
import pytest

ROWS = 50
GAP = np.linspace(-1, 9, ROWS)


def structured():
    table = np.zeros(ROWS, [("n", "i4"), ("gap", "f8"), ("who", "U3")])
    table["n"], table["gap"] = np.arange(ROWS), GAP
    return table


def written(path):
    """One record of a logger, in the file's own kind of structure; the name of its field."""
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
