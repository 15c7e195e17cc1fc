"""From a measurement to the table of offsets for the next cut."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from omsm_ros.core.form.compensation import compensation
from omsm_ros.core.form.tool_path import ToolPath, path_gcode, spiral_offsets
from omsm_ros.core.machine.surface_height import Surface
from omsm_ros.core.registration.placement import Aperture
from omsm_ros.jobs.measured_portions import Measurement
from omsm_ros.readable import percent, quantity
from omsm_ros.storage.files import save_text

COMPENSATION, PATH = "compensation.csv", "compensation.nc"
# Of its standard uncertainty: an offset beyond it is there at 95 %.
_SURE = 2.0
# Of the area; with less of it sure, the cut follows the noise of the measurement.
_LEAST_SURE = 0.5
# Of the rms before; a cut that leaves more is hardly worth it.
_MOST_LEFT = 0.9
_HEAD = "x_m,y_m,offset_m,uncertainty_m\n"


def compensate_form(
    measured: Measurement,
    surface: Surface,
    out: Path,
    low_pass: float,
    asked: Sequence[str],
    aperture: Aperture | None = None,
    spiral: tuple[float, int] | None = None,
) -> dict[str, Any]:
    """Write compensation.csv into ``out``: what to add to the height of the next cut.

    low_pass: wavelength of which half is compensated [m]; the others as for ``omsm form``
    spiral: feed a turn [m] and places of each of the next cut, for compensation.nc; None: without

    Raises DataError as ``omsm form`` does, and for a wavelength finer than the points resolve.
    """
    form = measured.form(surface, asked, aperture)
    found = compensation(form.map, surface, low_pass)
    x, y = np.meshgrid(found.x, found.y)
    known = np.isfinite(found.offset)
    columns = [values[known].tolist() for values in (x, y, found.offset, found.uncertainty)]
    lines = (",".join(f"{value:.9g}" for value in row) for row in zip(*columns, strict=True))
    save_text(out / COMPENSATION, _HEAD + "\n".join(lines) + "\n")
    path = {} if spiral is None else _along(spiral_offsets(found, *spiral), out)
    sure = np.abs(found.offset[known]) > _SURE * found.uncertainty[known]
    return {
        "file": COMPENSATION,
        **path,
        "places": int(np.sum(known)),
        "low_pass": low_pass,
        "removed": list(form.registration.freedoms.fitted),
        "rms_before": found.before,
        "rms_after": found.after,
        "largest_offset": float(np.max(np.abs(found.offset[known]))),
        "largest_uncertainty": float(np.max(found.uncertainty[known])),
        "surer_than_zero": float(np.mean(sure)),
        "warnings": _warnings(float(np.mean(sure)), found.before, found.after),
        "sign": "add offset_m to the height of the surface that is cut, along z, positive away from"
        " the part; x and y are those of the nominal surface",
        "not_evaluated": [] if measured.systematic else ["systematic errors of the measurement"],
    }


def _along(path: ToolPath, out: Path) -> dict[str, Any]:
    save_text(out / PATH, path_gcode(path))
    return {"path": PATH, "path_places": len(path.offset), "path_left_out": path.left_out}


def _warnings(sure: float, before: float, after: float) -> list[str]:
    """Return what speaks against the cut."""
    found = []
    if sure < _LEAST_SURE:
        found.append(
            f"on {percent(1 - sure)} of the area the offset is less than twice its uncertainty: a "
            "cut would put errors of the measurement onto the part; measure with less, hold "
            "freedoms (--fit piston,tip,tilt), or take a longer --low-pass"
        )
    if after > _MOST_LEFT * before:
        found.append(
            f"the cut would leave {quantity(after, 'm')} rms of {quantity(before, 'm')}: the rest "
            "is finer than --low-pass"
        )
    return found
