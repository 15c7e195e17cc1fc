"""The command export: write a cloud or map in the format of another program."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from omsm_ros.cli.arguments import Arguments
from omsm_ros.cli.command import CliCommand, Facts, Rows, written
from omsm_ros.core.comparison.resampling import on_grid
from omsm_ros.core.surface.height_grid import as_grid
from omsm_ros.core.surface.measured_points import MeasuredPoints
from omsm_ros.errors import DataError, FileError
from omsm_ros.io.files import CLOUD
from omsm_ros.io.maps.columns_file import write_columns
from omsm_ros.io.maps.grid_sag_file import write_grid_sag
from omsm_ros.io.maps.instrument_files import write_hdf5, write_sdf, write_x3p
from omsm_ros.io.maps.read_map import read_points
from omsm_ros.io.maps.vertex_file import write_pcd, write_ply
from omsm_ros.io.results import CloudFile
from omsm_ros.messages import rows_from
from omsm_ros.quantities import SPACING
from omsm_ros.readable import count
from omsm_ros.units import LengthUnits

AS_POINTS = (".csv", ".xyz", ".h5", ".hdf5", ".ply", ".pcd")
AS_MAP = (".x3p", ".dat", ".sdf")

_MOST_ACROSS = 400
_LENGTHS = ("x", "y", "z", "height", "dynamic_error", "uncertainty")
_COMMENT = "written by omsm_ros, lengths in metres"


def export(
    source: Path, out: Path, units: LengthUnits | None = None, spacing: float | None = None,
    channel: str | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Write ``source`` to ``out``, whose suffix names the format; return facts of the file.

    units: of a source that does not state them;  spacing: of a map made of scattered points [m]
    channel: of a source of several maps

    Raises FileError for an unknown source or format.
    """
    form = out.suffix.lower()
    if form in AS_POINTS:
        file = source / CLOUD if source.is_dir() else source
        try:
            cloud = CloudFile(file)
        except FileError:
            table = _records(read_points(file, units, channel))
        else:
            table = cloud.read()
        _write_points(out, form, table)
        return {"file": str(out), "points": len(table), "columns": list(table.dtype.names or ())}
    if form in AS_MAP:
        return _write_map(out, form, read_points(source, units, channel), spacing)
    raise FileError(
        f"format {out.suffix!r} of {str(out)!r} is unknown, expected one of "
        f"{', '.join((*AS_POINTS, *AS_MAP))}"
    )


def _records(points: MeasuredPoints) -> NDArray[np.void]:
    columns: dict[str, NDArray[Any]] = {"x": points.x, "y": points.y, "z": points.height}
    if points.uncertainty is not None:
        columns["uncertainty"] = points.uncertainty
    table = np.empty(len(points), [(name, "<f8") for name in columns])
    for name, values in columns.items():
        table[name] = values
    return table


def _write_points(out: Path, form: str, table: NDArray[np.void]) -> None:
    if form == ".ply":
        return write_ply(out, table)
    if form == ".pcd":
        return write_pcd(out, table)
    names = list(table.dtype.names or ())
    if "height" in names:  # z is the same in single precision, for viewers
        names.remove("z")
    columns = {("height" if name == "z" else name): table[name] for name in names}
    if form in (".h5", ".hdf5"):
        return write_hdf5(out, columns, _COMMENT)
    if form == ".xyz":
        columns = {n: columns[n] for n in ("x", "y", "height", "uncertainty") if n in columns}
    named = {f"{n}_m" if n in _LENGTHS else n: values for n, values in columns.items()}
    return write_columns(out, named, csv=form == ".csv")


def _write_map(
    out: Path, form: str, points: MeasuredPoints, spacing: float | None
) -> dict[str, Any]:
    grid = as_grid(points) if spacing is None else None
    method, error = "none: the points are a map", 0.0
    if grid is None:
        try:
            grid, error = on_grid(points, _MOST_ACROSS, spacing)
        except DataError as err:
            raise FileError(f"cannot write {str(out)!r} as a map: {err}") from err
        method = "local quadratic regression, tricube weights"
    comment = f"{_COMMENT}; resampling: {method}, rms error at most {error:.2g} m"
    if form == ".x3p":
        write_x3p(out, grid, comment)
    elif form == ".sdf":
        write_sdf(out, grid)
    else:
        write_grid_sag(out, grid)
    return {
        "file": str(out),
        "points": len(points),
        "rows": grid.height.shape[0],
        "columns": grid.height.shape[1],
        "missing": int(np.sum(~np.isfinite(grid.height))),
        "spacing": [grid.dx, grid.dy],
        "resampling": method,
        "interpolation_error": error,
    }


def _declare_export(add: Arguments) -> None:
    add("source", Path, "a result folder, a cloud or a map of any format")
    add("--out", "FILE", required=True)
    add.shared("--unit", "--channel")
    add("--spacing", SPACING, "grid spacing for scattered points [m]")


def _export(args: argparse.Namespace) -> Facts:
    made = export(args.source, args.out, args.unit, args.spacing, args.channel)
    return {"source": str(args.source), **made}


_OF_MAP = {
    "map": "{columns} × {rows} pixels of {spacing[0]:m/4} × {spacing[1]:m/4}, {missing:count} "
    "without a height",
    "resampling": "{resampling}",
    "resampling error": "at most {interpolation_error:m/2} rms",
}


def _show_export(facts: Facts) -> Rows:
    rows = [("points", count(facts["points"]))]
    if "resampling" in facts:
        rows += rows_from(facts, _OF_MAP)
    return [*rows, written([facts["file"]])]


COMMANDS = (CliCommand("export", _declare_export, _export, _show_export),)
