"""What should the next cut leave off, and where?

The deviation below a wavelength, turned about: where the part is too high along its normal by d,
the tool shall go ``d √(1 + |∇z|²)`` deeper along z. What is finer than the low-pass is noise,
texture, or faster than the axes, and stays.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from omsm_ros.core.form.deviation_map import DeviationMap, GridCells
from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.streams.blocks import BoolArray, FloatArray
from omsm_ros.core.surface.height_grid import gradient_of
from omsm_ros.errors import ConfigurationError, DataError
from omsm_ros.readable import count, quantity
from omsm_ros.units import DEGREE_RAD, MILLIMETRE_M

# Cells beside each other must see one and the same wave.
_LEAST_CELLS = 4.0


@dataclass(frozen=True, eq=False)
class Compensation:
    """Offsets of the next cut on a grid of the part's x and y.

    x, y: of the columns and rows [m];  offset: to be added to the height that is cut, along z [m],
        (r, c), NaN where nothing was measured;  uncertainty: of each, k = 1 [m]
    low_pass: wavelength of which half is compensated [m]
    before, after: rms of the deviation now, and less what is compensated; of what the points show,
        however fine, without their noise [m]
    """

    x: FloatArray
    y: FloatArray
    offset: FloatArray
    uncertainty: FloatArray
    low_pass: float
    before: float
    after: float

    def between(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the offsets [m] at x, y (n,) [m], linear between cells; NaN beside all of them."""
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
    """Return what the next cut has to add to its height.

    Raises DataError for a wavelength that is finer than four cells of the measured points.
    """
    cells = GridCells.of(map_)
    if low_pass < _LEAST_CELLS * cells.pitch:
        raise DataError(
            f"low-pass of {low_pass!r} m is finer than the points resolve, expected "
            f"{_LEAST_CELLS * cells.pitch!r} m or more; measure more points, or compensate less"
        )
    if min(len(cells.x), len(cells.y)) < 2:
        raise DataError(
            f"the points lie within one row of cells of {cells.pitch!r} m, where nothing is known "
            "across it; measure more tracks"
        )
    smooth = cells.smoothed(np.concatenate([[cells.mean], cells.effects]), low_pass)
    # Noise of the cells, averaged by the filter: its square by the square of the weights.
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
    """Return how far along z a unit along the normal is, at x, y, of their shape."""
    slopes = np.asarray(gradient_of(surface, x, y), np.float64)
    return np.asarray(np.sqrt(1 + np.sum(slopes**2, axis=0)), np.float64)


def _rms(map_: DeviationMap, deviation: FloatArray, there: BoolArray) -> float:
    """Return the rms by area of the points that are ``there`` (n,), without their noise [m]."""
    square = np.average(deviation[there] ** 2, weights=map_.area[there])
    return float(np.sqrt(max(float(square) - map_.noise**2, 0.0)))


# The offsets of the next cut where the tool will pass: along a spiral, for axes X, C and Z.

_MOST_LINES = 2_000_000
# Offsets are written to a hundredth of a nanometre, below what any axis resolves.
_HEAD = (
    "; offsets of Z for the next cut: add each to the Z of the tool path at the same X and C",
    "; positive: the tool goes away from the part, so that less is cut",
    "; X and Z in millimetres, C in degrees; part x = X cos C, part y = -X sin C",
    "G21",
    "G90",
)


@dataclass(frozen=True, eq=False)
class ToolPath:
    """Offsets on the way of the tool from the rim to the centre, each (n,).

    radius: X [m];  angle: C [rad], growing;  offset: to be added to Z [m]
    left_out: places of the spiral where nothing was measured
    """

    radius: FloatArray
    angle: FloatArray
    offset: FloatArray
    left_out: int


def spiral_offsets(found: Compensation, feed: float, per_turn: int) -> ToolPath:
    """Return the offsets along a spiral of ``feed`` [m] a turn, at ``per_turn`` places of each.

    At C the part's point under the tool at X is x = X cos C, y = −X sin C, as everywhere here.
    Raises ConfigurationError for more places than a controller takes, or less than a turn.
    """
    known_row, known_column = np.nonzero(np.isfinite(found.offset))
    rim = float(np.max(np.hypot(found.x[known_column], found.y[known_row])))
    if feed > rim:
        raise ConfigurationError(
            f"spiral of {quantity(feed, 'm')} a turn from a rim of {quantity(rim, 'm')} makes not "
            "one turn; take a narrower feed"
        )
    places = rim / feed * per_turn
    if places > _MOST_LINES:
        raise ConfigurationError(
            f"spiral of {quantity(feed, 'm')} a turn with {per_turn} places of each makes "
            f"{count(round(places))} lines, at most {count(_MOST_LINES)}; take a wider feed"
        )
    turned = np.arange(int(places) + 1) / per_turn
    radius, angle = rim - feed * turned, 2 * np.pi * turned
    offset = found.between(radius * np.cos(angle), -radius * np.sin(angle))
    there = np.isfinite(offset)
    return ToolPath(radius[there], angle[there], offset[there], int(np.sum(~there)))


def path_gcode(path: ToolPath) -> str:
    """Return the offsets as lines ``X C Z``: a table for the controller or the CAM, no motion."""
    rows = zip(
        path.radius / MILLIMETRE_M, path.angle / DEGREE_RAD, path.offset / MILLIMETRE_M, strict=True
    )
    return "\n".join([*_HEAD, *(f"X{x:.6f} C{c:.5f} Z{z:+.8f}" for x, c, z in rows)]) + "\n"
