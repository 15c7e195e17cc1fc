"""Formats of other instruments, by the library SurfaceTopography."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from omsm_ros.core.surface.height_grid import HeightGrid
from omsm_ros.core.surface.measured_points import MeasuredPoints
from omsm_ros.errors import FileError
from omsm_ros.storage.files import open_regular, said
from omsm_ros.storage.maps.length_units import LengthUnits, metres_in, needed, refuse_other
from omsm_ros.storage.maps.optional import library

MAX_FOREIGN_BYTES = 1_000_000_000


def read_foreign(path: Path, units: LengthUnits | None) -> MeasuredPoints:
    """Read a map by whatever reader of SurfaceTopography knows it; ``units`` where it has none.

    Raises FileError where none knows it, or it is no map of two directions.
    """
    what = f"map {str(path)!r}"
    open_regular(path, FileError, "map").close()
    if path.stat().st_size > MAX_FOREIGN_BYTES:
        raise FileError(f"{what} has more than {MAX_FOREIGN_BYTES} bytes; convert it to xyz")
    topography = library("SurfaceTopography", what)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of what the file lacks; we ask for it ourselves
            with topography.open_topography(str(path)) as reader:
                found = reader.topography()
            height = np.ma.filled(np.ma.asarray(found.heights(), np.float64), np.nan)
    except Exception as err:  # a reader of forty formats fails in as many ways
        raise FileError(f"{what} is of no known format, convert it to xyz: {said(err)}") from err
    if height.ndim != 2 or found.physical_sizes is None:
        raise FileError(f"{what} is no map with its size; convert it to xyz")
    metres = metres_in(str(found.unit)) if found.unit else None
    if metres:
        refuse_other(units, LengthUnits(metres, metres), what)
    scale = LengthUnits(metres, metres) if metres else needed(units, what)
    dx, dy = (size / count for size, count in zip(found.physical_sizes, height.shape, strict=True))
    return HeightGrid(
        height=height.T * scale.height,
        x0=0.0,
        y0=0.0,
        dx=dx * scale.lateral,
        dy=dy * scale.lateral,
    ).points((f"read by SurfaceTopography as {type(reader).__name__}",))
