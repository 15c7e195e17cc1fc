"""What should the next cut leave off, and where?

The deviation below a wavelength, turned about: where the part is too high along its normal by d,
the tool shall go ``d √(1 + |∇z|²)`` deeper along z. What is finer than the low-pass is noise,
texture, or faster than the axes, and stays.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from omsm_ros.core.form.cells import Cells
from omsm_ros.core.form.figures import DeviationMap
from omsm_ros.core.machine.surface_height import Surface
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.core.surface.slopes import gradient_of
from omsm_ros.errors import DataError

# Cells beside each other must see one and the same wave.
_LEAST_CELLS = 4.0


@dataclass(frozen=True, eq=False)
class Compensation:
    """Offsets of the next cut on a grid of the part's x and y.

    x, y: of the columns and rows [m];  offset: to be added to the height that is cut, along z [m],
        (r, c), NaN where nothing was measured;  uncertainty: of each, k = 1 [m]
    low_pass: wavelength of which half is compensated [m]
    before, after: rms of the cells' deviation now, and less what is compensated [m]
    """

    x: FloatArray
    y: FloatArray
    offset: FloatArray
    uncertainty: FloatArray
    low_pass: float
    before: float
    after: float


def compensation(map_: DeviationMap, surface: Surface, low_pass: float) -> Compensation:
    """Return what the next cut has to add to its height.

    Raises DataError for a wavelength that is finer than four cells of the measured points.
    """
    cells = Cells.of(map_)
    if low_pass < _LEAST_CELLS * cells.pitch:
        raise DataError(
            f"low-pass of {low_pass!r} m is finer than the points resolve, expected "
            f"{_LEAST_CELLS * cells.pitch!r} m or more; measure more points, or compensate less"
        )
    smooth = cells.smoothed(np.concatenate([[cells.mean], cells.effects]), low_pass)
    # Noise of the cells, averaged by the filter: its square by the square of the weights.
    averaged = np.sqrt(cells.smoothed_square(cells.noise**2, low_pass))
    spread = np.sqrt(averaged**2 + np.sum(smooth[1:] ** 2, axis=0))
    x, y = np.meshgrid(cells.x, cells.y)
    slope_x, slope_y = gradient_of(surface, x, y)
    along_z = np.where(cells.present, np.sqrt(1 + slope_x**2 + slope_y**2), np.nan)
    here = cells.mean[cells.present]
    rest = here - smooth[0][cells.present]
    return Compensation(
        x=cells.x,
        y=cells.y,
        offset=np.asarray(-smooth[0] * along_z),
        uncertainty=np.asarray(spread * along_z),
        low_pass=low_pass,
        before=float(np.sqrt(np.mean(here**2))),
        after=float(np.sqrt(np.mean(rest**2))),
    )
