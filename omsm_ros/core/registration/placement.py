"""Deviation of points from a surface in a pose, and how it changes with the pose.

The deviation is the distance from the surface along its normal, positive where the part stands
higher than it should. Its derivative by the pose is exact: the normal times how the point moves in
the part's frame.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, TypeAlias

import numpy as np

from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.streams.blocks import BoolArray, FloatArray
from omsm_ros.core.streams.statistics import EvenSelection
from omsm_ros.core.surface.height_grid import gradient_of, unit_normal
from omsm_ros.core.surface.posed import Pose
from omsm_ros.errors import DataError, SurfaceError
from omsm_ros.readable import quantity

# Four for each column of the fit beside form are the least.
LEAST_POINTS = 200
# Below a nanometre there are atoms, and no form.
_LEAST_EXTENT_M = 1e-9
DEGREES_OF_FREEDOM = ("piston", "tip", "tilt", "x", "y", "clocking", "power")
"""What a fit may move: a pose's six, and the curvature [1/m] by which the part is bent more."""

_SHIFTS = {"x": 0, "y": 1, "piston": 2}
_TURNS = {"tip": 0, "tilt": 1, "clocking": 2}


class PointBatch(NamedTuple):
    """Successive points of a scan in the machine's frame, each (n,) [m].

    systematic: (k, n) [m]: by how much each of k sources of systematic error, off by its standard
        uncertainty, would shift the heights; the sources are independent of each other
    """

    x: FloatArray
    y: FloatArray
    height: FloatArray
    systematic: FloatArray


PointBatches: TypeAlias = Callable[[], Iterable[PointBatch]]
"""Reads all points from the start, portion by portion; called once for each pass."""


@dataclass(frozen=True, slots=True)
class Aperture:
    """A disc of the part's x and y: ``radius`` about (``x``, ``y``) [m]."""

    radius: float
    x: float = 0.0
    y: float = 0.0

    def holds(self, x: FloatArray, y: FloatArray) -> BoolArray:
        """Return where points lie within it, of their shape."""
        square = (x - self.x) ** 2 + (y - self.y) ** 2
        # A rim at exactly the radius is within it, whatever the rounding of a float32.
        return np.asarray(square <= (self.radius * (1 + 1e-6)) ** 2)

    def scaled(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return x and y on the unit disc."""
        return (x - self.x) / self.radius, (y - self.y) / self.radius


@dataclass(frozen=True, slots=True)
class Placement:
    """A part's pose, and the curvature that it has beyond its nominal surface [1/m]."""

    pose: Pose = field(default_factory=Pose)
    power: float = 0.0

    def moved(self, dofs: Sequence[str], step: FloatArray) -> Placement:
        """Return the placement after a ``step`` (p,) of its ``dofs``.

        Raises DataError where no part of the machine could sit: a fit strayed.
        """
        changes = dict(zip(dofs, map(float, step), strict=True))
        power = self.power + changes.pop("power", 0.0)
        try:
            pose = replace(self.pose, **{k: getattr(self.pose, k) + v for k, v in changes.items()})
        except SurfaceError as err:
            raise DataError(
                "no pose brings the points onto the nominal surface; check its parameters, the "
                "sign of its radii and the units of the cloud, or fit fewer freedoms"
            ) from err
        return Placement(pose, power)

    def value(self, dof: str) -> float:
        """Return the value of one freedom [m], [rad] or [1/m]."""
        return self.power if dof == "power" else float(getattr(self.pose, dof))


class Placed(NamedTuple):
    """Points in the frame of the part.

    x, y: [m], (n,);  deviation: along the normal [m], (n,);  normal: of the surface there (3, n)
    from_origin: of the part, in the machine's frame [m], (3, n)
    """

    x: FloatArray
    y: FloatArray
    deviation: FloatArray
    normal: FloatArray
    from_origin: FloatArray

    def part(self, chosen: BoolArray) -> Placed:
        """Return the chosen points (n,)."""
        return Placed(*(values[..., chosen] for values in self))


def placed(surface: Surface, placement: Placement, portion: PointBatch) -> Placed:
    """Return the points in the part's frame, NaN where the surface has no height.

    The foot of a point is first sought along the normal under it, then measured from its tangent
    plane: exact but for the square of deviation times curvature.
    """
    pose = placement.pose
    away = np.stack([portion.x, portion.y, portion.height]) - pose.origin[:, np.newaxis]
    x, y, z = pose.rotation.T @ away
    half_power = placement.power / 2
    slope_x, slope_y = _slopes(surface, half_power, x, y)
    above = z - surface.height(x, y) - half_power * (x**2 + y**2)
    reach = above / (1 + slope_x**2 + slope_y**2)
    foot_x, foot_y = x + reach * slope_x, y + reach * slope_y
    slope_x, slope_y = _slopes(surface, half_power, foot_x, foot_y)
    normal = unit_normal(slope_x, slope_y)
    foot_z = surface.height(foot_x, foot_y) + half_power * (foot_x**2 + foot_y**2)
    deviation = (x - foot_x) * normal[0] + (y - foot_y) * normal[1] + (z - foot_z) * normal[2]
    return Placed(x, y, np.asarray(deviation), normal, away)


def _slopes(
    surface: Surface, half_power: float, x: FloatArray, y: FloatArray
) -> tuple[FloatArray, FloatArray]:
    slope_x, slope_y = gradient_of(surface, x, y)
    return np.asarray(slope_x + 2 * half_power * x), np.asarray(slope_y + 2 * half_power * y)


def dof_columns(placement: Placement, points: Placed, dofs: Sequence[str]) -> FloatArray:
    """Return the derivatives (p, n) of the deviation by each freedom."""
    rates, rotation = placement.pose.rotation_rates(), placement.pose.rotation
    columns = np.empty((len(dofs), len(points.x)))
    for row, name in enumerate(dofs):
        if name in _SHIFTS:
            columns[row] = -rotation[_SHIFTS[name]] @ points.normal
        elif name in _TURNS:
            moved = rates[_TURNS[name]].T @ points.from_origin
            columns[row] = np.einsum("in,in->n", points.normal, moved)
        else:
            columns[row] = -0.5 * (points.x**2 + points.y**2) * points.normal[2]
    return columns


def selection(portions: PointBatches, most: int) -> PointBatch:
    """Return ``most`` points evenly chosen from all, without their systematic effects."""
    kept, count = EvenSelection(most), 0
    for portion in portions():
        kept.add(np.stack([portion.x, portion.y, portion.height], axis=1))
        count += len(portion.x)
    if not count:
        raise DataError("0 points: there is nothing to register; check the cloud")
    x, y, height = kept.rows().T
    return PointBatch(x, y, height, np.empty((0, len(x))))


def inside_aperture(points: Placed, aperture: Aperture | None) -> Placed:
    """Return the points with a deviation that lie within the aperture.

    Raises DataError for too few of them, or for points closer together than any part is large.
    """
    good = np.isfinite(points.deviation)
    if aperture is not None:
        good &= aperture.holds(points.x, points.y)
    if (count := int(np.sum(good))) < LEAST_POINTS:
        raise DataError(
            f"{count} points lie on the nominal surface, expected {LEAST_POINTS} or more; "
            "check its parameters, the aperture and the units of the cloud"
        )
    extent = max(float(np.ptp(v[good])) for v in (points.x, points.y))
    if extent < _LEAST_EXTENT_M:
        raise DataError(
            f"the points lie within {quantity(extent, 'm')} of each other; measure across the "
            "part, or check the units of the cloud"
        )
    return points.part(good)


def centred_aperture(points: Placed) -> Aperture:
    """Return the disc about the part's origin that holds all points.

    About their middle where the origin lies outside of them.
    """
    ends = [(float(v.min()), float(v.max())) for v in (points.x, points.y)]
    inside = all(low < 0 < high for low, high in ends)
    x, y = (0.0, 0.0) if inside else ((low + high) / 2 for low, high in ends)
    return Aperture(float(np.hypot(points.x - x, points.y - y).max()) or 1.0, x, y)
