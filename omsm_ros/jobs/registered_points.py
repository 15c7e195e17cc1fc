"""A measurement in the frame of its part, registered to the nominal surface."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from omsm_ros.core.comparison.stated_errors import Fields, Measurement
from omsm_ros.core.machine.surface_height import Surface
from omsm_ros.core.registration.placement import Placed, Portion, placed
from omsm_ros.core.registration.pose_budget import Registration
from omsm_ros.core.registration.register import register
from omsm_ros.core.samples.blocks import FloatArray, IntArray
from omsm_ros.core.surface.height_grid import as_grid
from omsm_ros.core.surface.measured_points import MeasuredPoints

_PORTION = 65_536
POSE = "pose of the part"


def registered(m: Measurement, nominal: Surface, freedoms: Sequence[str]) -> Measurement:
    """Return the measurement's deviations along the normal, in the frame of its part.

    Its errors are what they are once the pose has followed them, and the pose's own are one more
    source; what lies far from the smooth form of the part, as dust, is left out and noted.

    Raises DataError for points that do not fit the surface.
    """
    points, fields = m.points, m.fields
    names = fields.names if fields is not None else ()

    def portions() -> Iterator[Portion]:
        for first in range(0, len(points), _PORTION):
            part = slice(first, first + _PORTION)
            x, y, height = points.x[part], points.y[part], points.height[part]
            effects = np.empty((0, len(x))) if fields is None else fields.at(first, len(x))
            yield Portion(x, y, height, effects)

    found = register(nominal, portions, freedoms, sources=names, even=as_grid(points) is not None)
    where = [placed(nominal, found.placement, portion) for portion in portions()]
    whole = Placed(*(np.concatenate(parts, axis=-1) for parts in zip(*where, strict=True)))
    kept = np.flatnonzero(np.isfinite(whole.deviation))
    kept = kept[found.good(whole.part(kept))]
    placed_points = whole.part(kept)
    return replace(
        m,
        points=_points(points, placed_points, kept, found),
        fields=None if fields is None else _Followed(found, placed_points, kept, fields),
        pose=_OfPose(found, placed_points),
    )


def _points(
    points: MeasuredPoints, at: Placed, kept: IntArray, found: Registration
) -> MeasuredPoints:
    note = "registered by " + ", ".join(
        f"{name} {found.placement.value(name):.4g}" for name in found.freedoms.fitted
    )
    left_out = len(points) - len(kept)
    return replace(
        points.part(kept),
        x=at.x,
        y=at.y,
        height=at.deviation,
        notes=(*points.notes, note, *([f"{left_out} points left out"] if left_out else ())),
    )


@dataclass(frozen=True, eq=False)
class _Followed:
    """Fields of a scan once the pose has followed each error, as ``omsm form`` has them."""

    found: Registration
    at_: Placed
    kept: IntArray
    fields: Fields

    @property
    def names(self) -> tuple[str, ...]:
        return self.fields.names

    def at(self, first: int, count: int) -> FloatArray:
        """Return the fields (s, count) [m] of the kept points from ``first`` on."""
        chosen = self.kept[first : first + count]
        low = int(chosen[0]) if len(chosen) else 0
        rows = self.fields.at(low, int(chosen[-1]) - low + 1 if len(chosen) else 0)
        part = _slice(self.at_, first, count)
        return self.found.effects(part, rows[:, chosen - low])[1][: len(rows)]


@dataclass(frozen=True, eq=False)
class _OfPose:
    """What the pose may be wrong by, one row an independent part of it."""

    found: Registration
    at_: Placed

    @property
    def names(self) -> tuple[str, ...]:
        return (POSE,) * (len(self.found.pose_effects) + 2 * len(self.found.held_effects))

    def at(self, first: int, count: int) -> FloatArray:
        """Return the fields (p, count) [m] of the kept points from ``first`` on."""
        part = _slice(self.at_, first, count)
        none = np.zeros((self.found.moved.shape[1] - 2 * len(self.found.held_effects), len(part.x)))
        pose, sources = self.found.effects(part, none)
        return np.concatenate([pose, sources[len(none) :]])


def _slice(at: Placed, first: int, count: int) -> Placed:
    return Placed(*(values[..., first : first + count] for values in at))
