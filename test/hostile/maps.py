"""Maps, clouds and tables of numbers that were right before somebody damaged them."""

from __future__ import annotations

import io
import re
import struct
import zipfile
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from hostile.inputs import NUMBERS, damaged
from hypothesis import strategies as st

from omsm_ros.core.surface.height_grid import HeightGrid
from omsm_ros.io.maps.columns_file import write_columns
from omsm_ros.io.maps.grid_sag_file import write_grid_sag
from omsm_ros.io.maps.instrument_files import write_hdf5, write_x3p
from omsm_ros.io.maps.vertex_file import write_pcd, write_ply

ACROSS = 19
_NUMBER = re.compile(rb"(?<![\w.])-?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?(?![\w.])")


def write_maps(folder: Path) -> None:
    """Write one map of a part in each format, ``good.*``; millimetres where a text has no unit."""
    line = np.linspace(-3e-3, 3e-3, ACROSS)
    x, y = np.meshgrid(line, line)
    height = 1e-6 * np.sin(900 * x) + 2e-3 * x * y
    step = float(line[1] - line[0])
    grid = HeightGrid(height=height, x0=-3e-3, y0=-3e-3, dx=step, dy=step)
    names = ("x", "y", "z")
    table = np.empty(x.size, [(name, "<f8") for name in names])
    for name, values in zip(names, (x, y, height), strict=True):
        table[name] = values.ravel()
    columns = {name: table[name] for name in names}
    metres = {name if name != "z" else "height": values for name, values in columns.items()}
    write_columns(folder / "good.xyz", {n: 1e3 * v for n, v in columns.items()}, csv=False)
    write_columns(folder / "good.csv", {f"{n}_m": v for n, v in columns.items()}, csv=True)
    write_ply(folder / "good.ply", table)
    write_pcd(folder / "good.pcd", table)
    write_grid_sag(folder / "good.dat", grid)
    if "good.x3p" in FORMATS:
        write_x3p(folder / "good.x3p", grid, "a part")
    write_hdf5(folder / "good.h5", metres, "a part")
    (folder / "zygo.dat").write_bytes(metropro(np.arange(25.0).reshape(5, 5)))


def metropro(phase: np.ndarray) -> bytes:  # type: ignore[type-arg]
    """Return a phase map after the layout in the MetroPro reference guide."""
    head = bytearray(834)
    rows, columns = phase.shape
    head[:4] = bytes([0x88, 0x1B, 0x03, 0x6F])
    for form, place, value in (
        (">I", 6, len(head)), (">H", 68, columns), (">H", 70, rows), (">f", 164, 0.5),
        (">f", 168, 632.8e-9), (">f", 176, 1.0), (">f", 184, 1e-4), (">h", 218, 1),
    ):  # fmt: skip
        struct.pack_into(form, head, place, value)
    return bytes(head) + phase.astype(">i4").tobytes()


# The package that writes x3p needs Python 3.11.
FORMATS = ("good.xyz", "good.csv", "good.ply", "good.pcd", "good.dat", "good.h5", "zygo.dat",
           *["good.x3p"] * (find_spec("x3pio") is not None))  # fmt: skip


# A text that says its unit is refused where another one is stated.
SAY_METRES = ("good.csv", "good.dat")


@st.composite
def renumbered(draw: st.DrawFn, whole: bytes, within: int = 1000) -> bytes:
    """Bytes with a few of the numbers that stand as text in their beginning replaced."""
    content = whole
    for _ in range(draw(st.integers(1, 3))):
        found = list(_NUMBER.finditer(content[:within]))
        if not found:
            break
        place = draw(st.sampled_from(found))
        number = str(draw(NUMBERS)).encode()
        content = content[: place.start()] + number + content[place.end() :]
    return content


@st.composite
def repacked(draw: st.DrawFn, whole: bytes) -> bytes:
    """A zip with a member damaged, renumbered, doubled or left out."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(whole)) as old, zipfile.ZipFile(out, "w") as new:
        names = old.namelist()
        victim = draw(st.sampled_from(names))
        how = draw(st.sampled_from(["damage", "renumber", "double", "drop"]))
        for name in names:
            raw = old.read(name)
            if name == victim and how == "drop":
                continue
            if name == victim and how == "damage":
                raw = draw(damaged(raw))
            if name == victim and how == "renumber":
                raw = draw(renumbered(raw, 10_000))
            new.writestr(name, raw * 2 if name == victim and how == "double" else raw)
    return out.getvalue()


def damaged_maps(good: Mapping[str, bytes]) -> st.SearchStrategy[tuple[str, bytes]]:
    """The name of a damaged map, which may have another ending, and its bytes."""

    def of(name: str) -> st.SearchStrategy[tuple[str, bytes]]:
        ways = [damaged(good[name]), renumbered(good[name])]
        if name.endswith(".x3p"):
            ways = [*ways, repacked(good[name]), repacked(good[name])]
        endings = st.sampled_from([name.rpartition(".")[2]] * 8 + ["txt", "x3p", "bin", "opd"])
        return st.tuples(endings.map("bad.{}".format), st.one_of(ways))

    return st.sampled_from(sorted(good)).flatmap(of)


ROWS = 400


def write_tables(folder: Path) -> None:
    """Write one recording of another program in each format, ``log.*``."""
    n = np.arange(ROWS)
    columns = {
        "n": n.astype(float), "t": n * 1e-3, "X": 6.0 - n * 1e-3, "Z": 1e-3 * np.sin(n / 9),
        "C": n * 0.18, "d": -600 * np.sin(n / 9), "i": np.full(ROWS, 80.0),
    }  # fmt: skip
    table = np.column_stack(list(columns.values()))
    np.savetxt(folder / "log.csv", table, delimiter=",", header=",".join(columns), comments="")
    np.savez(folder / "log.npz", **columns)
    np.save(folder / "log.npy", table)
    from scipy.io import savemat

    savemat(folder / "log.mat", columns, do_compression=True)
    import h5py

    with h5py.File(folder / "log.h5", "w") as content:
        for name, values in columns.items():
            content[name] = values


TABLES = ("log.csv", "log.npz", "log.npy", "log.mat", "log.h5")


def damaged_tables(good: Mapping[str, bytes]) -> st.SearchStrategy[tuple[str, bytes]]:
    """The name of a damaged recording of another program, and its bytes."""

    def of(name: str) -> st.SearchStrategy[tuple[str, bytes]]:
        ways = [damaged(good[name]), renumbered(good[name], 10_000)]
        if name.endswith(".npz"):
            ways.append(repacked(good[name]))
        return st.tuples(st.just(f"bad.{name.rpartition('.')[2]}"), st.one_of(ways))

    return st.sampled_from(sorted(good)).flatmap(of)
