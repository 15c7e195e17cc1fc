"""Where on the workpiece is the probe looking?

Chain: workpiece → C → Y → X → base → Z → B → probe. The frame of the chuck has its third axis
along the spindle, which is parallel to Z; x and y are slide positions from the spindle axis.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np

from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.errors import ConfigurationError
from omsm_ros.quantities import LENGTH, SLOPE


@dataclass(frozen=True, kw_only=True)
class Geometry:
    """Where the probe sits and looks; all zero for a probe on the spindle axis, along Z.

    centre_x, centre_y: slide positions at which the probe looks at the spindle axis [m]
    probe_x, probe_z: from the pivot of B to the point of zero distance, at b = 0 [m]
    beam_x, beam_y: slope of the beam against Z at b = 0 [1]
    abbe_arm: from the Z encoder's line to the beam [m]; what an unknown pitch of the slide
        costs over it is a term of the uncertainty
    """

    centre_x: float = 0.0
    centre_y: float = 0.0
    probe_x: float = 0.0
    probe_z: float = 0.0
    beam_x: float = 0.0
    beam_y: float = 0.0
    abbe_arm: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            quantity = SLOPE if field.name.startswith("beam") else LENGTH
            quantity.checked(getattr(self, field.name), ConfigurationError, field.name)


class WorkpiecePoints(NamedTuple):
    """Points in the workpiece frame [m], each (n,)."""

    x: FloatArray
    y: FloatArray
    height: FloatArray


def workpiece_xy(x: FloatArray, y: FloatArray, c: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Turn positions x, y [m] from the spindle axis back by the spindle angle c [rad], each (n,).

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
    """Return the surface points at which the probe looked.

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
    beam = np.array([geometry.beam_x, geometry.beam_y, 1.0])
    beam /= np.linalg.norm(beam)
    turn = np.array([-beam[1], beam[0], 0.0, 1.0 + beam[2]])
    x, y, z, w = (turn / np.linalg.norm(turn)).tolist()
    return x, y, z, w


def _reach(
    geometry: Geometry, b: FloatArray, distance: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the vector from zero distance at b = 0 to the surface point, in the machine frame [m].

    B turns about Y: ``(x, z) -> (x cos b + z sin b, z cos b - x sin b)``.
    """
    beam = np.array([geometry.beam_x, geometry.beam_y, 1.0])
    beam /= np.linalg.norm(beam)
    x, y, z = (distance * component for component in beam)
    if not b.any():
        return x, y, z
    cosine, sine = np.cos(b), np.sin(b)
    # 1 - cos b as 2 sin²(b/2): the pivot's arm may be long and b small.
    versine = 2 * np.sin(b / 2) ** 2
    return (
        x * cosine + z * sine + geometry.probe_z * sine - geometry.probe_x * versine,
        y,
        z * cosine - x * sine - geometry.probe_x * sine - geometry.probe_z * versine,
    )
