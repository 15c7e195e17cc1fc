"""Deviation of points from a surface in a pose, and its derivatives by the pose.

The deviation is the distance from the surface along its normal, positive where the part is too
high. Its derivative by the pose is the normal times the motion of the point in the part's frame.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, TypeAlias

import numpy as np

from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.streams.blocks import BoolArray, FloatArray, IntArray
from omsm_ros.core.streams.statistics import EvenSelection
from omsm_ros.core.surface.aperture import Aperture
from omsm_ros.core.surface.height_grid import gradient_of, unit_normal
from omsm_ros.core.surface.posed import Pose
from omsm_ros.core.surface.shape_parameters import estimated_shape, shape_columns
from omsm_ros.errors import DataError, SurfaceError

# Four points for each of the 49 columns of pose and form; on a line, of the 9 that differ there.
LEAST_POINTS, _LEAST_OF_PROFILE, _LINE_WIDTH = 200, 36, 1e-6
# A cloud of a nanometre has a wrong unit.
_LEAST_EXTENT_M = 1e-9
POSE_PARAMETERS = ("piston", "tip", "tilt", "x", "y", "clocking", "power")
"""Pose parameters of a fit: the six of a pose, and an additional curvature [1/m]."""

_SHIFTS = {"x": 0, "y": 1, "piston": 2}
_TURNS = {"tip": 0, "tilt": 1, "clocking": 2}


class PointBatch(NamedTuple):
    """Successive points of a scan in the machine's frame, each (n,) [m].

    systematic: effect (k, n) [m] of one standard uncertainty of each of k independent sources of
        systematic error on the heights
    """

    x: FloatArray
    y: FloatArray
    height: FloatArray
    systematic: FloatArray

    def chunks(self, most: int) -> Iterator[PointBatch]:
        """Yield these points in parts of at most ``most``, which fit the processor's cache."""
        for begin in range(0, len(self.x), most):
            yield PointBatch(*(v[..., begin : begin + most] for v in self))


PointBatches: TypeAlias = Callable[[], Iterable[PointBatch]]
"""Function that reads all points from the start, portion by portion; called once per pass."""


@dataclass(frozen=True, slots=True)
class Placement:
    """Pose of a part, and its curvature in excess of the nominal surface, ``power`` [1/m].

    shape: names and values of estimated parameters of the nominal surface
    """

    pose: Pose = field(default_factory=Pose)
    power: float = 0.0
    shape: tuple[tuple[str, float], ...] = ()

    def moved(self, dofs: Sequence[str], step: FloatArray) -> Placement:
        """Return the placement after a ``step`` (p,) of the pose parameters ``dofs``.

        Raises DataError for a pose outside the machine: the fit diverged.
        """
        changes = dict(zip(dofs, map(float, step), strict=True))
        power = self.power + changes.pop("power", 0.0)
        shape = tuple((n, v + changes.pop(n, 0.0)) for n, v in self.shape)
        try:
            pose = replace(self.pose, **{k: getattr(self.pose, k) + v for k, v in changes.items()})
        except SurfaceError as err:
            raise DataError("registration.no_pose") from err
        return Placement(pose, power, shape)

    def value(self, dof: str) -> float:
        """Return the value of one pose parameter [m], [rad] or [1/m]."""
        known = dict(self.shape)
        if dof in known:
            return known[dof]
        return self.power if dof == "power" else float(getattr(self.pose, dof))

    def of(self, surface: Surface) -> Surface:
        """Return the ``surface`` with the estimated parameters; DataError if there is none."""
        try:
            return estimated_shape(surface, dict(self.shape)) if self.shape else surface
        except SurfaceError as err:
            raise DataError("registration.no_pose") from err


class Placed(NamedTuple):
    """Points in the frame of the part.

    x, y: [m], (n,);  deviation: along the normal [m], (n,);  normal: of the surface there (3, n)
    from_origin: vector from the part's origin, in the machine's frame [m], (3, n)
    by_shape: derivatives of the deviation by the estimated parameters of the surface (s, n)
    """

    x: FloatArray
    y: FloatArray
    deviation: FloatArray
    normal: FloatArray
    from_origin: FloatArray
    by_shape: FloatArray

    def part(self, chosen: BoolArray | IntArray) -> Placed:
        """Return the chosen points (n,)."""
        if chosen.dtype == np.bool_ and np.all(chosen):
            return self  # a copy takes as long as the deviations
        return Placed(*(values[..., chosen] for values in self))


def placed(surface: Surface, placement: Placement, portion: PointBatch) -> Placed:
    """Return the points in the part's frame, NaN where the surface has no height.

    The foot of each point is estimated along the normal below it; the deviation is the distance
    from the tangent plane there, exact to first order in deviation times curvature.
    """
    pose, nominal, surface = placement.pose, surface, placement.of(surface)
    away = np.stack([portion.x, portion.y, portion.height])
    away -= pose.origin[:, np.newaxis]
    x, y, z = pose.rotation.T @ away
    slope_x, slope_y, height = _slopes_and_height(surface, placement.power, x, y)
    reach = (z - height) / (1 + slope_x**2 + slope_y**2)
    foot_x, foot_y = x + reach * slope_x, y + reach * slope_y
    slope_x, slope_y, height = _slopes_and_height(surface, placement.power, foot_x, foot_y)
    normal = unit_normal(slope_x, slope_y)
    deviation = (x - foot_x) * normal[0]
    deviation += (y - foot_y) * normal[1]
    deviation += (z - height) * normal[2]
    by_shape = np.empty((0, len(x)))
    if placement.shape:
        by_shape = -normal[2] * shape_columns(nominal, dict(placement.shape), foot_x, foot_y)
    return Placed(x, y, deviation, normal, away, by_shape)


def _slopes_and_height(
    surface: Surface, power: float, x: FloatArray, y: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    (slope_x, slope_y), height = gradient_of(surface, x, y), surface.height(x, y)
    if power:
        height = height + power / 2 * (x**2 + y**2)
        slope_x, slope_y = slope_x + power * x, slope_y + power * y
    return np.asarray(slope_x), np.asarray(slope_y), np.asarray(height)


def dof_columns(placement: Placement, points: Placed, dofs: Sequence[str]) -> FloatArray:
    """Return the derivatives (p, n) of the deviation by each pose parameter."""
    rates, rotation = placement.pose.rotation_rates(), placement.pose.rotation
    columns = np.empty((len(dofs), len(points.x)))
    shape = [name for name, _ in placement.shape]
    for row, name in enumerate(dofs):
        if name in _SHIFTS:
            columns[row] = -rotation[_SHIFTS[name]] @ points.normal
        elif name in _TURNS:
            moved = rates[_TURNS[name]].T @ points.from_origin
            columns[row] = np.einsum("in,in->n", points.normal, moved)
        elif name in shape:
            columns[row] = points.by_shape[shape.index(name)]
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
        raise DataError("registration.no_points")
    x, y, height = kept.rows().T
    return PointBatch(x, y, height, np.empty((0, len(x))))


def least_points(points: Placed) -> int:
    """Return how many points a fit needs at least: fewer of a profile than of a map."""
    # In the machine's frame a profile is straight, however the part is turned about it.
    sides = points.from_origin[:2]
    spans = sorted(float(np.ptp(v)) for v in sides) if len(points.x) else [1.0, 1.0]
    return _LEAST_OF_PROFILE if spans[0] <= _LINE_WIDTH * spans[1] else LEAST_POINTS


def inside_aperture(points: Placed, aperture: Aperture | None) -> Placed:
    """Return the points that have a deviation and lie within the aperture.

    Raises DataError for too few points, or an extent below a nanometre.
    """
    good = np.isfinite(points.deviation)
    if aperture is not None:
        good &= aperture.holds(points.x, points.y)
    points = points.part(good)
    if (count := len(points.x)) < (least := least_points(points)):
        raise DataError("registration.few_points", count=count, least=least)
    extent = max(float(np.ptp(v)) for v in (points.x, points.y))
    if extent < _LEAST_EXTENT_M:
        raise DataError("registration.small_extent", extent=extent)
    return points
