"""From a measurement to the table of offsets for the next cut."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from omsm_ros.core.form.compensation import compensation
from omsm_ros.core.machine.surface_height import Surface
from omsm_ros.core.surface.placement import Aperture
from omsm_ros.jobs.measured_portions import Measurement
from omsm_ros.storage.files import save_text

COMPENSATION = "compensation.csv"
_HEAD = "x_m,y_m,offset_m,uncertainty_m\n"


def compensate_form(
    measured: Measurement,
    surface: Surface,
    out: Path,
    low_pass: float,
    asked: Sequence[str],
    aperture: Aperture | None = None,
) -> dict[str, Any]:
    """Write compensation.csv into ``out``: what to add to the height of the next cut.

    low_pass: wavelength of which half is compensated [m]; the others as for ``omsm form``

    Raises DataError as ``omsm form`` does, and for a wavelength that is finer than the points tell.
    """
    form = measured.form(surface, asked, aperture)
    found = compensation(form.map, surface, low_pass)
    x, y = np.meshgrid(found.x, found.y)
    known = np.isfinite(found.offset)
    columns = [values[known].tolist() for values in (x, y, found.offset, found.uncertainty)]
    lines = (",".join(f"{value:.9g}" for value in row) for row in zip(*columns, strict=True))
    save_text(out / COMPENSATION, _HEAD + "\n".join(lines) + "\n")
    return {
        "file": COMPENSATION,
        "places": int(np.sum(known)),
        "low_pass": low_pass,
        "removed": list(form.registration.freedoms.fitted),
        "rms_before": found.before,
        "rms_after": found.after,
        "largest_offset": float(np.max(np.abs(found.offset[known]))),
        "largest_uncertainty": float(np.max(found.uncertainty[known])),
        "sign": "add offset_m to the height of the surface that is cut, along z, positive away from"
        " the part; x and y are those of the nominal surface",
        "not_evaluated": [] if measured.systematic else ["systematic errors of the measurement"],
    }
