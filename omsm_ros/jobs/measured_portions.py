"""Points of a measurement in portions, with what its systematic errors do to them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from omsm_ros.core.correction.scan_fields import ScanFields
from omsm_ros.core.form.analyse import Form, analyse_form
from omsm_ros.core.machine.surface_height import Surface
from omsm_ros.core.registration.placement import Aperture, Portion, Portions
from omsm_ros.core.surface.height_grid import as_grid
from omsm_ros.core.surface.measured_points import MeasuredPoints, each_once
from omsm_ros.errors import FileError
from omsm_ros.storage.cloud_file import CloudFile
from omsm_ros.storage.fields_file import load_fields
from omsm_ros.storage.files import CLOUD, SYSTEMATIC
from omsm_ros.storage.maps.length_units import NOT_USED, LengthUnits
from omsm_ros.storage.maps.read_map import read_points

_PORTION = 131_072


@dataclass(frozen=True)
class Measurement:
    """portions: reads all points from the start;  sources: of their systematic effects, by name

    systematic: whether the effects of systematic errors are known at all
    notes: what a reader of the results should know about how the file was understood
    even: whether the points are those of an evenly spaced grid
    bounds: names of the sources of which only an upper bound is known
    missing: how many points of a map, beside these, have no height
    """

    portions: Portions
    sources: tuple[str, ...]
    systematic: bool
    notes: tuple[str, ...] = ()
    even: bool = False
    bounds: tuple[str, ...] = ()
    missing: int = 0

    def form(
        self,
        surface: Surface,
        asked: Sequence[str],
        aperture: Aperture | None = None,
        filters: tuple[float | None, float | None] = (None, None),
    ) -> Form:
        """Return the form against ``surface``, with all that is known of the points."""
        return analyse_form(
            surface,
            self.portions,
            asked,
            sources=self.sources,
            bounds=self.bounds,
            aperture=aperture,
            even=self.even,
            filters=filters,
        )


def open_measurement(path: Path, units: LengthUnits | None = None) -> Measurement:
    """Open a result folder, a cloud of ours, or a map or cloud of any other format.

    Our own clouds are read in bounded memory, with the fields that lie beside them.
    units: of a file that does not carry them. Raises FileError for what cannot be read.
    """
    file = path / CLOUD if path.is_dir() else path
    if not file.exists():
        raise FileError(
            f"no cloud at {str(file)!r}; give a cloud, a map, or the folder of a measurement"
        )
    try:
        cloud = CloudFile(file)
    except FileError:
        points = each_once(read_points(file, units))
        gridded = as_grid(points) is not None
        return Measurement(
            lambda: _slices(points), (), False, points.notes, gridded, missing=points.missing
        )
    notes = () if units in (None, LengthUnits(1.0, 1.0)) else (NOT_USED,)
    beside = file.with_name(SYSTEMATIC)
    fields = load_fields(beside) if beside.is_file() else None
    if fields is None:
        return Measurement(lambda: _portions(cloud, None), (), False, notes)
    return Measurement(
        lambda: _portions(cloud, fields), fields.names, True, notes, bounds=fields.bounds
    )


def _slices(points: MeasuredPoints) -> Iterator[Portion]:
    for first in range(0, len(points), _PORTION):
        part = slice(first, first + _PORTION)
        x, y, height = points.x[part], points.y[part], points.height[part]
        yield Portion(x, y, height, np.empty((0, len(x))))


def _portions(cloud: CloudFile, fields: ScanFields | None) -> Iterator[Portion]:
    first = 0
    for rows in cloud.portions(_PORTION):
        x, y, height = (rows[name].astype(np.float64) for name in ("x", "y", "height"))
        effects = np.empty((0, len(x))) if fields is None else fields.at(first, len(x))
        yield Portion(x, y, height, effects)
        first += len(x)
