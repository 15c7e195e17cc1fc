"""Reads and writes grid sag of optical design programs (Zemax OpticStudio ``.DAT``).

First line: columns, rows, spacing in x and y, unit (0 mm, 1 cm, 2 inch, 3 m), decentre in x and y.
Then a line for each point: height, its three derivatives, and a flag, nonzero for a missing point.
The first point is at the least x and the greatest y; x runs first, then y falls.
"""

import io
from pathlib import Path

import numpy as np

from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.surface.height_grid import HeightGrid
from omsm_ros.errors import FileError
from omsm_ros.io.files import atomic_file, open_regular
from omsm_ros.io.tables.text_table import rows_in
from omsm_ros.quantities import MAP_POINTS
from omsm_ros.units import LengthUnits, refuse_other

_UNITS_M = (1e-3, 1e-2, 0.0254, 1.0)
_METRES = 3
# Height alone, with its derivatives, and with the flag.
_NUMBERS_OF_A_POINT = (1, 4, 5)
_COMMENT = "!"
_LONGEST_LINE = 10_000


def is_grid_sag(first: str, second: str) -> bool:
    """Return whether the first two lines of a text, without comments, are those of grid sag.

    With an unknown unit, the second line must show that the text is no table.
    """
    numbers = _first_line(first)
    if numbers is None:
        return False
    lengths = len(second.split()), len(first.split())
    return numbers[4] in range(len(_UNITS_M)) or lengths[1] != lengths[0] in _NUMBERS_OF_A_POINT


def _first_line(text: str) -> tuple[float, ...] | None:
    try:
        numbers = tuple(float(part) for part in text.split())
    except ValueError:
        return None
    if len(numbers) not in (5, 7) or not np.all(np.isfinite(numbers)):
        return None
    whole = all(n == int(n) >= 5 for n in numbers[:2]) and numbers[4] == int(numbers[4])
    return numbers if whole and min(abs(numbers[2]), abs(numbers[3])) > 0 else None


def read_grid_sag(path: Path, units: LengthUnits | None = None) -> HeightGrid:
    """Read a grid sag file; a point flagged "no data" is missing.

    units: expected ones, or None

    Raises FileError for other lines, another number of points than stated, or other ``units``.
    """
    what = f"grid sag {str(path)!r}"
    with open_regular(path, FileError, "grid sag") as stream:
        text = io.TextIOWrapper(stream, encoding="utf-8-sig", errors="replace")
        line, above = text.readline(_LONGEST_LINE), 1
        while line.startswith(_COMMENT) or line.isspace():
            line, above = text.readline(_LONGEST_LINE), above + 1
        first = _first_line(line)
        if first is None:
            raise FileError(
                f"{what} must begin with columns, rows (5 or more), two spacings, unit and "
                "decentres"
            )
        if first[4] not in range(len(_UNITS_M)):
            raise FileError(
                f"{what} has unit {int(first[4])}, the fifth number of its first line, expected "
                "0 (mm), 1 (cm), 2 (inch) or 3 (m); correct it"
            )
        scale = _UNITS_M[int(first[4])]
        refuse_other(units, LengthUnits(scale, scale), what)
        columns, rows = int(first[0]), int(first[1])
        MAP_POINTS.checked(columns * rows, FileError, f"{what}: number of points")
        table = rows_in(text, what, "write a line a point", above=above, comments=_COMMENT)
    if len(table) != columns * rows:
        raise FileError(
            f"{what} says {columns} × {rows} points and has {len(table)}; write it again"
        )
    return _grid(first, table)


def _grid(first: tuple[float, ...], table: FloatArray) -> HeightGrid:
    columns, rows, unit = int(first[0]), int(first[1]), int(first[4])
    dx, dy, decentre = abs(first[2]), abs(first[3]), first[5:] or (0.0, 0.0)
    scale = _UNITS_M[unit]
    height = table[:, 0] * scale
    if table.shape[1] > 4:
        height = np.where(table[:, 4] != 0, np.nan, height)
    return HeightGrid(
        height=np.flipud(height.reshape(rows, columns)),
        x0=(decentre[0] - dx * (columns - 1) / 2) * scale,
        y0=(decentre[1] - dy * (rows - 1) / 2) * scale,
        dx=dx * scale,
        dy=dy * scale,
    )


def write_grid_sag(path: Path, grid: HeightGrid) -> None:
    """Write a map in metres, with its derivatives, zero at the edges of missing points.

    Raises FileError for fewer than five rows or columns, which readers refuse.
    """
    rows, columns = grid.height.shape
    if min(rows, columns) < 5:
        raise FileError(
            f"a grid sag file has 5 × 5 points or more, this map {columns} × {rows}; "
            "give a smaller --spacing"
        )
    slope_y, slope_x = np.gradient(grid.height, grid.dy, grid.dx)
    twist, missing = np.gradient(slope_x, grid.dy, axis=0), ~np.isfinite(grid.height)
    # Derivatives are central differences, zero next to missing points.
    own = [np.nan_to_num(part, nan=0.0) for part in (slope_x, slope_y, twist)]
    parts = [np.where(missing, 0.0, grid.height), *own, missing]
    table = np.column_stack([np.flipud(part).ravel() for part in parts])
    centre = (grid.x0 + grid.dx * (columns - 1) / 2, grid.y0 + grid.dy * (rows - 1) / 2)
    head = (columns, rows, *(f"{v:.17g}" for v in (grid.dx, grid.dy)), _METRES)
    with atomic_file(path, "w") as stream:
        stream.write(" ".join(map(str, (*head, *(f"{v:.17g}" for v in centre)))) + "\n")
        np.savetxt(stream, table, fmt=["%.17g", "%.9g", "%.9g", "%.9g", "%d"])
