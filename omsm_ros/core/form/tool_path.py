"""The offsets of the next cut where the tool will pass: along a spiral, for axes X, C and Z."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from omsm_ros.core.form.compensation import Compensation
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.errors import ConfigurationError
from omsm_ros.readable import count, quantity
from omsm_ros.units import DEGREE_RAD, MILLIMETRE_M

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
