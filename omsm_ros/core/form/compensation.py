"""Offsets of the next cut from the low-pass filtered deviation, as a grid and along a spiral.

Where the part is too high by d along its normal the tool goes ``d √(1 + |∇z|²)`` deeper along z.
Shorter wavelengths are noise, texture, or too fast for the axes, and are not compensated.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy  # whose parts are loaded when they are used

from omsm_ros.core.form.deviation_map import DeviationMap, GridCells
from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.kinematics.planner import Path
from omsm_ros.core.streams.blocks import BoolArray, FloatArray
from omsm_ros.core.surface.height_grid import gradient_of
from omsm_ros.errors import ConfigurationError, DataError
from omsm_ros.units import DEGREE_RAD, MILLIMETRE_M, RPM_HZ, RPM_RAD_S

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
        at = [(v - g[0]) / (g[1] - g[0]) for v, g in ((y, self.y), (x, self.x))]
        total, weight = (
            scipy.ndimage.map_coordinates(values, at, order=1, mode="grid-constant")
            for values in (np.nan_to_num(self.offset), np.isfinite(self.offset).astype(np.float64))
        )
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
    rows, columns, weight = cells.weights(low_pass)
    averaged = rows**2 @ (cells.noise**2 * cells.present) @ columns**2 / weight**2
    spread = np.sqrt(averaged * cells.present + np.sum(smooth[1:] ** 2, axis=0))
    x, y = np.meshgrid(cells.x, cells.y)
    along_z = np.where(cells.present, _along_z(surface, x, y), np.nan)
    offset, uncertainty = -smooth[0] * along_z, spread * along_z
    found = Compensation(cells.x, cells.y, offset, uncertainty, low_pass, before=0.0, after=0.0)
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
            "form.spiral_too_long", feed=feed, per_turn=per_turn, lines=round(places),
            most=_MOST_LINES,
        )  # fmt: skip
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


# A cut that changes the form by another share of what was asked for is not repeated.
_GAINS = (0.5, 1.5)
# Cells around what was measured, in which the slope of the offsets decays.
_MARGIN = 4
# Iterations of the place where the nose of the tool touches.
_TOUCHES = 12
# Step of the difference of slopes, small against any form [m].
_STEP_M = 1e-5


def check_last_cut(found: Compensation, change: FloatArray) -> float | None:
    """Return the share of the offsets ``change`` [m] of the last cut that it made in the part.

    change: as ``found.offset``, (r, c), NaN where unknown;  None: too small to tell

    Raises DataError unless the share is near 1: reversed, the next cut would make the form worse.
    """
    both = np.isfinite(change) & np.isfinite(found.offset)
    asked, now = change[both] - np.mean(change[both]), -found.offset[both]
    # Before the last cut the deviation was the negative of what was asked for.
    made = now - np.mean(now) + asked
    if np.std(asked) < 2 * np.sqrt(np.mean(found.uncertainty[both] ** 2)):
        return None
    share = float(asked @ made / (asked @ asked))
    if not _GAINS[0] <= share <= _GAINS[1]:
        raise DataError("form.last_cut", share=share, asked=float(np.std(asked)))
    return share


class CutSurface:
    """The surface to cut: the nominal one plus ``offset`` (r, c) [m] on the grid x, y [m].

    Beyond what was measured the offset of the nearest cell holds.
    """

    def __init__(self, nominal: Surface, x: FloatArray, y: FloatArray, offset: FloatArray) -> None:
        place = scipy.ndimage.distance_transform_edt(
            ~np.isfinite(offset), return_distances=False, return_indices=True
        )
        self._nominal = nominal
        known = np.pad(offset[tuple(place)], _MARGIN, mode="edge")
        x, y = (v[0] + (v[1] - v[0]) * np.arange(-_MARGIN, len(v) + _MARGIN) for v in (x, y))
        self._offset = scipy.interpolate.RectBivariateSpline(y, x, known)
        self._limits = (x[0], x[-1], y[0], y[-1])

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height [m] at x, y [m], of their shape."""
        left, right, low, high = self._limits
        added = self._offset.ev(np.clip(y, low, high), np.clip(x, left, right))
        return np.asarray(self._nominal.height(x, y) + added, np.float64)


def cut_path(
    surface: Surface, radius: float, feed: float, rpm: float, tool_radius: float
) -> tuple[Path, float]:
    """Return the path of the tip of a round-nosed tool that cuts ``surface``, and its duration [s].

    The tool goes from ``radius`` [m] to the centre with ``feed`` [m] a turn at ``rpm``. Where the
    surface is inclined by s along X the nose touches at a distance of R s/√(1 + s²) from the tip.

    Raises ConfigurationError where the nose is blunter than the surface is hollow.
    """

    def path(time: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        c = rpm * RPM_RAD_S * time
        tip = radius - feed * rpm * RPM_HZ * time
        along_x, along_y = np.cos(c), -np.sin(c)

        def touching(away: FloatArray) -> FloatArray:
            """Return where a nose touches that has the slope of the surface at ``away``."""
            x, y = (tip + away) * along_x, (tip + away) * along_y
            slopes = gradient_of(surface, x, y)
            slope = slopes[0] * along_x + slopes[1] * along_y
            return np.asarray(tool_radius * slope / np.sqrt(1 + slope**2))

        away = np.zeros_like(tip)
        for _ in range(_TOUCHES):
            away = touching(away)
        # Where the surface is more curved than the nose, the nose touches at two places.
        if np.any(touching(away + _STEP_M) - touching(away - _STEP_M) >= 2 * _STEP_M):
            raise ConfigurationError("form.tool_too_blunt", tool_radius=tool_radius)
        height = surface.height((tip + away) * along_x, (tip + away) * along_y)
        return tip, height - tool_radius + np.sqrt(tool_radius**2 - away**2), c

    return path, radius / (feed * abs(rpm) * RPM_HZ)
