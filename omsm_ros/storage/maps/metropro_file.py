"""Zygo MetroPro binary maps (``.dat``), after the layout that Zygo publishes with the program."""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import Any

import numpy as np

from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.core.surface.height_grid import HeightGrid
from omsm_ros.core.surface.measured_points import MeasuredPoints
from omsm_ros.errors import FileError
from omsm_ros.quantities import MAP_POINTS
from omsm_ros.storage.files import open_regular

MAGIC = b"\x88\x1b\x03"
_HEADER_BYTES = 834
_LARGEST_HEADER = 65_536
# Phase values from here on say why there is none.
_NO_DATUM = 2_147_483_640
# Steps of the phase in one fringe, by the entry "phase resolution".
_STEPS = {0: 4096, 1: 32768, 2: 131072}


def read_metropro(path: Path) -> MeasuredPoints:
    """Read the phase map as heights; the first row is the upper one.

    height = phase · wavelength · scale factor · obliquity / steps

    Raises FileError for a file that is none, was cut short, or lacks phase or its scales.
    """
    what = f"MetroPro file {str(path)!r}"
    with open_regular(path, FileError, "MetroPro file") as stream:
        head = stream.read(_HEADER_BYTES)
        if len(head) < _HEADER_BYTES or not head.startswith(MAGIC):
            raise FileError(f"{what} has no header of MetroPro, or was cut short; save it again")
        size = _at(">I", head, 6)
        columns, rows = _at(">H", head, 68), _at(">H", head, 70)
        before = _at(">H", head, 52) * _at(">H", head, 54) * _at(">H", head, 56) * 2
        if size > _LARGEST_HEADER:
            raise FileError(f"{what} says that its header has {size} bytes; save it again")
        MAP_POINTS.checked(columns * rows, FileError, f"{what}: number of points")
        stream.seek(size + before)
        raw = stream.read(4 * columns * rows)
        held = stream.seek(0, io.SEEK_END)
    if len(raw) < 4 * columns * rows:
        raise FileError(
            f"{what} has {held} bytes, too few for {columns} × {rows} points; save it again"
        )
    phase = np.frombuffer(raw, ">i4").reshape(rows, columns).astype(np.float64)
    return _points(head, phase, what)


def _points(head: bytes, phase: FloatArray, what: str) -> MeasuredPoints:
    steps = _STEPS.get(_at(">h", head, 218))
    factors = [_at(">f", head, place) for place in (164, 168, 176)]
    if steps is None or not np.all(np.isfinite(factors)) or min(map(abs, factors)) <= 0:
        raise FileError(f"{what} does not say how high a fringe is; export it again with its scale")
    scale = float(np.prod(factors)) / steps
    notes: tuple[str, ...] = ()
    if _at(">h", head, 232):
        scale, notes = -scale, ("its sign entry says 'inverted': the heights were negated",)
    pixel = _at(">f", head, 184)
    if not (np.isfinite(pixel) and pixel > 0):
        raise FileError(f"{what} has no lateral calibration; calibrate the camera and save again")
    height = np.where(phase >= _NO_DATUM, np.nan, phase * scale)
    grid = HeightGrid(height=np.flipud(height), x0=0.0, y0=0.0, dx=pixel, dy=pixel)
    return grid.points(notes)


def _at(form: str, head: bytes, place: int) -> Any:
    """Return the entry at ``place`` of the header."""
    return struct.unpack_from(form, head, place)[0]
