"""Kinematics of the machine: positions of the axes and distance to points of the workpiece.

Chain: workpiece → C → Y → X → base → Z → B → probe. The workpiece frame has its third axis along
the spindle, which is parallel to Z; x and y are slide positions relative to the spindle axis.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval2d

from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import ConfigurationError
from omsm_ros.quantities import LENGTH, MAP_SPACING, SLOPE, CheckedRecord
from omsm_ros.units import MICROMETRE_M


@dataclass(frozen=True, kw_only=True)
class Geometry(CheckedRecord):
    """Position and direction of the probe; all zero for a probe on the spindle axis, along Z.

    centre_x, centre_y: slide positions at which the beam meets the spindle axis [m]
    probe_x, probe_z: from the pivot of B to the point of zero distance, at b = 0 [m]
    beam_x, beam_y: slope of the beam against Z at b = 0 [1]
    abbe_arm: from the Z encoder's line to the beam [m], through which a pitch of the slide acts
    """

    centre_x: float = LENGTH.of_field(0.0)
    centre_y: float = LENGTH.of_field(0.0)
    probe_x: float = LENGTH.of_field(0.0)
    probe_z: float = LENGTH.of_field(0.0)
    beam_x: float = SLOPE.of_field(0.0)
    beam_y: float = SLOPE.of_field(0.0)
    abbe_arm: float = LENGTH.of_field(0.0)

    @property
    def beam(self) -> FloatArray:
        """Unit vector along the beam at b = 0 (3,)."""
        beam = np.array([self.beam_x, self.beam_y, 1.0])
        return np.asarray(beam / np.linalg.norm(beam))


class WorkpiecePoints(NamedTuple):
    """Points in the workpiece frame [m], each (n,)."""

    x: FloatArray
    y: FloatArray
    height: FloatArray


def workpiece_xy(x: FloatArray, y: FloatArray, c: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return positions x, y [m] rotated back by the spindle angle c [rad], each (n,).

    ``X = x cos c + y sin c``, ``Y = -x sin c + y cos c``.
    """
    cosine, sine = np.cos(c), np.sin(c)
    return x * cosine + y * sine, y * cosine - x * sine


def workpiece_points(
    geometry: Geometry,
    slides: tuple[FloatArray, FloatArray, FloatArray],
    b: FloatArray,
    c: FloatArray,
    distance: FloatArray,
) -> WorkpiecePoints:
    """Return the surface points that the probe measured.

    slides: x, y and the probe's own z (H(z)) [m], each (n,);  b, c: [rad], (n,)
    distance: true distance along the beam, growing with the height of the surface [m], (n,)
    """
    x, y, z = slides
    along_x, along_y, along_z = _reach(geometry, b, distance)
    height = z + along_z
    return WorkpiecePoints(
        *workpiece_xy(x - geometry.centre_x + along_x, y - geometry.centre_y + along_y, c), height
    )


def beam_quaternion(geometry: Geometry) -> tuple[float, float, float, float]:
    """Return the shortest turn (x, y, z, w) of the Z axis onto the beam, at b = 0."""
    beam = geometry.beam
    turn = np.array([-beam[1], beam[0], 0.0, 1.0 + beam[2]])
    x, y, z, w = (turn / np.linalg.norm(turn)).tolist()
    return x, y, z, w


def _reach(
    geometry: Geometry, b: FloatArray, distance: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the vector from zero distance at b = 0 to the surface point, in the machine frame [m].

    B turns about Y: ``(x, z) -> (x cos b + z sin b, z cos b - x sin b)``.
    """
    x, y, z = (distance * component for component in geometry.beam)
    if not b.any():
        return x, y, z
    cosine, sine = np.cos(b), np.sin(b)
    # 1 - cos b as 2 sin²(b/2), which is exact for small b and a long arm.
    versine = 2 * np.sin(b / 2) ** 2
    return (
        x * cosine + z * sine + geometry.probe_z * sine - geometry.probe_x * versine,
        y,
        z * cosine - x * sine - geometry.probe_x * sine - geometry.probe_z * versine,
    )


@dataclass(frozen=True, eq=False)
class PitchCurve:
    """Measured pitch ``angle`` (k,) [rad] of the Z slide over ``position`` (k,) [m].

    It is interpolated linearly and constant beyond the ends. Raises ConfigurationError unless the
    positions increase.
    """

    position: FloatArray
    angle: FloatArray

    def __post_init__(self) -> None:
        if len(self.position) < 2 or np.any(np.diff(self.position) <= 0):
            raise ConfigurationError("kinematics.pitch")

    def over(self, arm: float, z: FloatArray) -> FloatArray:
        """Return the Abbe error ``arm · α`` [m] of an encoder ``arm`` [m] from the beam, (n,)."""
        return np.asarray(arm * np.interp(z, self.position, self.angle), np.float64)


# Step of central differences: the slope of a wave of 1 mm is 0.07 % too small, and rounding is far
# below a microradian.
_STEP_M = 10 * MICROMETRE_M


class Surface(Protocol):
    """A surface with a height over the plane."""

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height [m] at x, y [m], of their broadcast shape."""
        ...


def slopes_by_differences(
    surface: Surface, x: FloatArray, y: FloatArray, step: float = _STEP_M
) -> tuple[FloatArray, FloatArray]:
    """Return ∂z/∂x and ∂z/∂y [1] at x, y [m] by central differences over ``step`` [m] each way."""
    along_x = (surface.height(x + step, y) - surface.height(x - step, y)) / (2 * step)
    along_y = (surface.height(x, y + step) - surface.height(x, y - step)) / (2 * step)
    return np.asarray(along_x, np.float64), np.asarray(along_y, np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class PolynomialSurface:
    """``z = Σ table[i, j] ((x − middle_x)/scale)^i ((y − middle_y)/scale)^j``, all lengths [m]."""

    table: FloatArray
    scale: float
    middle: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def through(
        cls, x: FloatArray, y: FloatArray, height: FloatArray, degree: int
    ) -> PolynomialSurface:
        """Return the least-squares polynomial of total ``degree`` of points x, y, height (n,)."""
        middle = float(np.mean(x)), float(np.mean(y))
        scale = float(max(np.max(np.abs(x - middle[0])), np.max(np.abs(y - middle[1]))))
        scale = scale if scale > MAP_SPACING.low else 1.0  # all points at one place, up to rounding
        i, j = np.array([(i, n - i) for n in range(degree + 1) for i in range(n + 1)]).T
        u, v = (np.vander((a - m) / scale, degree + 1, increasing=True)
                for a, m in zip((x, y), middle, strict=True))  # fmt: skip
        table = np.zeros((degree + 1, degree + 1))
        table[i, j] = np.linalg.lstsq(u[:, i] * v[:, j], height, rcond=1e-10)[0]
        return cls(table, scale, middle)

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height [m] at x, y [m]."""
        return self._at(x, y, self.table)

    def gradient(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the slopes ∂z/∂x, ∂z/∂y [1]."""
        along_x, along_y = (
            np.asarray(polyder(self.table / self.scale, axis=k), np.float64) for k in range(2)
        )
        return self._at(x, y, along_x), self._at(x, y, along_y)

    def _at(self, x: FloatArray, y: FloatArray, table: FloatArray) -> FloatArray:
        u, v = np.broadcast_arrays(
            (np.asarray(x) - self.middle[0]) / self.scale,
            (np.asarray(y) - self.middle[1]) / self.scale,
        )
        return np.asarray(polyval2d(u, v, table), np.float64)
