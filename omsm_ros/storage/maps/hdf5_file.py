"""HDF5: our own tables of points, and the maps of Zygo Mx (``.datx``)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.surface.height_grid import HeightGrid
from omsm_ros.core.surface.measured_points import MeasuredPoints, measured
from omsm_ros.errors import FileError
from omsm_ros.quantities import MAP_POINTS, shown
from omsm_ros.storage.files import open_regular, said, whole_file
from omsm_ros.storage.hdf5_walk import walked
from omsm_ros.storage.maps.length_units import metres_in
from omsm_ros.storage.maps.optional import library

MAGIC = b"\x89HDF\r\n\x1a\n"
SCHEMA = "omsm-points/1"
_NO_LENGTHS = ("sample", "intensity")
_DATX_SURFACES = "Data/Surface"


def read_hdf5(path: Path) -> MeasuredPoints:
    """Read a table of ours, or the first surface of a ``.datx``; both carry their units.

    Raises FileError for other HDF5 files, and for those that are damaged.
    """
    what = f"HDF5 file {str(path)!r}"
    h5py = library("h5py", what)
    with open_regular(path, FileError, "HDF5 file") as stream:
        walked(path, what)
        try:
            with h5py.File(stream, "r") as content:
                if content.attrs.get("schema") == SCHEMA:
                    return _table(content, what)
                if _DATX_SURFACES in content:
                    return _datx(h5py, content, what)
        except FileError:
            raise
        except Exception as err:  # whatever the library makes of a damaged file
            raise FileError(f"{what} cannot be read: {said(err)}; write it again") from err
    raise FileError(f"{what} is neither a table of ours nor a .datx of Zygo; convert it to xyz")


def _table(content: Any, what: str) -> MeasuredPoints:
    column: dict[str, NDArray[Any]] = {}
    for name in ("x", "y", "height", "uncertainty", "sample"):
        if name in content:
            column[name] = _array(content[name], what, 1)
    if gone := {"x", "y", "height"} - set(column):
        raise FileError(f"{what} has no column {min(gone)!r}; write it again")
    lengths = {name: len(values) for name, values in column.items()}
    if len(set(lengths.values())) > 1:
        raise FileError(f"{what} has columns of different lengths {lengths}; write it again")
    return measured(
        column["x"],
        column["y"],
        column["height"],
        column.get("uncertainty"),
        sample=column.get("sample"),
    )


def _array(dataset: Any, what: str, axes: int) -> NDArray[Any]:
    shape = getattr(dataset, "shape", ())
    if len(shape) != axes:
        raise FileError(f"{what} holds an array of shape {shape!r}, expected {axes} of them")
    if dataset.dtype.kind not in "fiu":
        raise FileError(f"{what} holds an array of {shown(str(dataset.dtype))}, expected numbers")
    MAP_POINTS.checked(math.prod(shape), FileError, f"{what}: number of points")
    return np.asarray(dataset[()])


def _datx(h5py: Any, content: Any, what: str) -> MeasuredPoints:
    group = content[_DATX_SURFACES]
    surfaces = [group[name] for name in group if isinstance(group[name], h5py.Dataset)]
    if not surfaces:
        raise FileError(f"{what} holds no surface; save it with one")
    surface = surfaces[0]
    height = _array(surface, what, 2).astype(np.float64)
    no_data = surface.attrs.get("No Data")
    if no_data is not None:
        height[height >= float(np.ravel(no_data)[0])] = np.nan
    dx, dy = (_pixel(surface, f"{axis} Converter", what) for axis in "XY")
    # The first row is the upper one of the camera.
    scaled = np.flipud(height) * _datx_scale(surface, what)
    notes = (f"the first of its {len(surfaces)} surfaces",) if len(surfaces) > 1 else ()
    return HeightGrid(height=scaled, x0=0.0, y0=0.0, dx=dx, dy=dy).points(notes)


def _datx_scale(surface: Any, what: str) -> float:
    """Return the length of one unit of the heights [m]."""
    unit = np.ravel(surface.attrs["Unit"])[0]
    name = unit.decode("utf-8", "replace") if isinstance(unit, bytes) else str(unit)
    if (metres := metres_in(name)) is not None:
        return metres
    if name.lower() not in ("fringes", "waves", "fringewaves"):
        raise FileError(f"{what} has heights in {name!r}, expected a length or fringes")
    keys = ("Wavelength", "Interferometric Scale Factor", "Obliquity Factor")
    return float(np.prod([np.ravel(surface.attrs[key])[0] for key in keys]))


def _pixel(surface: Any, key: str, what: str) -> float:
    """Return the distance of pixels [m]: the second number of a converter from pixels."""
    category, base, *_, numbers = np.ravel(surface.attrs[key])[0]
    if (category, base) != (b"LateralCat", b"Pixels") or not numbers[1] > 0:
        raise FileError(f"{what} has no lateral calibration; calibrate the camera and save again")
    return float(numbers[1])


def write_hdf5(path: Path, columns: Mapping[str, NDArray[np.generic]], comment: str) -> None:
    """Write columns (n,) as datasets with their ``units``, lengths in metres."""
    h5py = library("h5py", f"writing {str(path)!r}")
    with whole_file(path, "w+b") as stream, h5py.File(stream, "w") as content:
        content.attrs["schema"] = SCHEMA
        content.attrs["comment"] = comment
        for name, values in columns.items():
            dataset = content.create_dataset(name, data=values)
            dataset.attrs["units"] = "1" if name in _NO_LENGTHS else "m"
