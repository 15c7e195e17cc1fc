"""Offsets of the next cut from the low-pass filtered deviation, as a grid and along a spiral.

Where the part is too high by d along its normal the tool goes ``d √(1 + |∇z|²)`` deeper along z.
Shorter wavelengths are noise, texture, or too fast for the axes, and are not compensated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from omsm_ros.core.form.deviation_map import DeviationMap, GridCells
from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.streams.blocks import BoolArray, FloatArray
from omsm_ros.core.surface.height_grid import gradient_of
from omsm_ros.errors import ConfigurationError, DataError
from omsm_ros.units import DEGREE_RAD, MILLIMETRE_M

# Cells in the shortest wavelength, so that neighbouring cells resolve it.
_LEAST_CELLS = 4.0
# Lines of a tool path that controllers accept.
_MOST_LINES = 2_000_000
# Offsets are written to a hundredth of a nanometre, below the resolution of any axis.
_HEAD = (
    "; offsets of Z for the next cut: add each to the Z of the tool path at the same X and C",
    "; positive: the tool goes away from the part, so that less is cut",
    "; X and Z in millimetres, C in degrees; part x = X cos C, part y = -X sin C",
    "G21",
    "G90",
)


@dataclass(frozen=True, eq=False)
class Compensation:
    """Offsets of the next cut on a grid of the part's x and y.

    x, y: of the columns and rows [m]
    offset: to add to the height that is cut, along z [m], (r, c), NaN where nothing was measured
    uncertainty: of each offset, k = 1 [m]
    low_pass: wavelength of which half is compensated [m]
    before, after: rms deviation without noise now, and with the offsets applied [m]
    """

    x: FloatArray
    y: FloatArray
    offset: FloatArray
    uncertainty: FloatArray
    low_pass: float
    before: float
    after: float

    def between(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the offsets [m] at x, y (n,) [m], linear between cells; NaN outside of them."""
        column, row = ((v - g[0]) / (g[1] - g[0]) for v, g in ((x, self.x), (y, self.y)))
        total, weight = np.zeros(len(x)), np.zeros(len(x))
        for right in (0, 1):
            for above in (0, 1):
                c, r = np.floor(column).astype(int) + right, np.floor(row).astype(int) + above
                inside = (c >= 0) & (c < len(self.x)) & (r >= 0) & (r < len(self.y))
                value = np.full(len(x), np.nan)
                value[inside] = self.offset[r[inside], c[inside]]
                near = np.where(
                    np.isfinite(value), (1 - np.abs(column - c)) * (1 - np.abs(row - r)), 0.0
                )
                total += near * np.nan_to_num(value)
                weight += near
        return np.where(weight > 0, total / np.where(weight > 0, weight, 1.0), np.nan)


def compensation(map_: DeviationMap, surface: Surface, low_pass: float) -> Compensation:
    """Return the offsets of the next cut.

    Raises DataError for a ``low_pass`` [m] below four cells of the points, or points in one row.
    """
    cells = GridCells.of(map_)
    if low_pass < _LEAST_CELLS * cells.pitch:
        raise DataError(
            "form.low_pass_too_short", low_pass=low_pass, least=_LEAST_CELLS * cells.pitch
        )
    if min(len(cells.x), len(cells.y)) < 2:
        raise DataError("form.one_row", pitch=cells.pitch)
    smooth = cells.smoothed(np.concatenate([[cells.mean], cells.effects]), low_pass)
    averaged = np.sqrt(cells.smoothed_square(cells.noise**2, low_pass))
    spread = np.sqrt(averaged**2 + np.sum(smooth[1:] ** 2, axis=0))
    x, y = np.meshgrid(cells.x, cells.y)
    along_z = np.where(cells.present, _along_z(surface, x, y), np.nan)
    found = Compensation(
        x=cells.x,
        y=cells.y,
        offset=np.asarray(-smooth[0] * along_z),
        uncertainty=np.asarray(spread * along_z),
        low_pass=low_pass,
        before=0.0,
        after=0.0,
    )
    cut = found.between(map_.x, map_.y) / _along_z(surface, map_.x, map_.y)
    there = np.isfinite(cut)
    before = _rms(map_, map_.deviation, there)
    return replace(found, before=before, after=_rms(map_, map_.deviation + cut, there))


def _along_z(surface: Surface, x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the length along z of a unit along the normal at x, y, of their shape."""
    slopes = np.asarray(gradient_of(surface, x, y), np.float64)
    return np.asarray(np.sqrt(1 + np.sum(slopes**2, axis=0)), np.float64)


def _rms(map_: DeviationMap, deviation: FloatArray, there: BoolArray) -> float:
    """Return the area-weighted rms of the points ``there`` (n,), without their noise [m]."""
    square = np.average(deviation[there] ** 2, weights=map_.area[there])
    return float(np.sqrt(max(float(square) - map_.noise**2, 0.0)))


@dataclass(frozen=True, eq=False)
class ToolPath:
    """Offsets along the spiral of the tool from the rim to the centre, each (n,).

    radius: X [m];  angle: C [rad], growing;  offset: to add to Z [m]
    left_out: number of places without a measurement
    """

    radius: FloatArray
    angle: FloatArray
    offset: FloatArray
    left_out: int


def spiral_offsets(found: Compensation, feed: float, per_turn: int) -> ToolPath:
    """Return the offsets along a spiral of ``feed`` [m] a turn, at ``per_turn`` places of a turn.

    The tool at X and C is above x = X cos C, y = −X sin C of the part. Raises ConfigurationError
    for more places than a controller accepts, or less than a turn.
    """
    known_row, known_column = np.nonzero(np.isfinite(found.offset))
    rim = float(np.max(np.hypot(found.x[known_column], found.y[known_row])))
    if feed > rim:
        raise ConfigurationError("form.spiral_below_one_turn", feed=feed, rim=rim)
    places = rim / feed * per_turn
    if places > _MOST_LINES:
        raise ConfigurationError(
            "form.spiral_too_long",
            feed=feed,
            per_turn=per_turn,
            lines=round(places),
            most=_MOST_LINES,
        )
    turned = np.arange(int(places) + 1) / per_turn
    radius, angle = rim - feed * turned, 2 * np.pi * turned
    offset = found.between(radius * np.cos(angle), -radius * np.sin(angle))
    there = np.isfinite(offset)
    return ToolPath(radius[there], angle[there], offset[there], int(np.sum(~there)))


def path_gcode(path: ToolPath) -> str:
    """Return the offsets as lines ``X C Z``, a table for the controller or the CAM."""
    rows = zip(
        path.radius / MILLIMETRE_M, path.angle / DEGREE_RAD, path.offset / MILLIMETRE_M, strict=True
    )
    return "\n".join([*_HEAD, *(f"X{x:.6f} C{c:.5f} Z{z:+.8f}" for x, c, z in rows)]) + "\n"
