"""What does each systematic error do to the heights of a scan, per unit of it?

Each function returns the changes of the heights [m] of n points per unit of the error, (k, n) for
its k independent components, (n,) for one. Those that shift points laterally need their slopes.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from omsm_ros.core.correction.systematic import ScanPoints
from omsm_ros.core.correction.unknown_curves import components, fading, random_walk, smooth
from omsm_ros.core.machine.kinematics import workpiece_xy
from omsm_ros.core.samples.blocks import FloatArray

Parameters = Mapping[str, float]


def tilt(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return tilts about y and about x; that a point also goes sideways is a hundredth."""
    return np.stack([-p.x, p.y])


def decentre(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return the shift of the part along x and along y."""
    one, zero = np.ones(len(p)), np.zeros(len(p))
    return np.stack([p.sideways(one, zero), p.sideways(zero, one)])


def clocking(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return the turn of the part about the spindle."""
    return p.sideways(-p.y, p.x)


def expansion(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return the growth of the part in all directions."""
    return p.height + p.sideways(p.x, p.y)


def _across(p: ScanPoints, x: FloatArray, y: FloatArray) -> FloatArray:
    """Return what a shift by x, y [m] of the machine's frame does to the heights."""
    return p.sideways(*workpiece_xy(x, y, p.c))


def centre_x(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return the shift of the zero of X."""
    return _across(p, np.ones(len(p)), np.zeros(len(p)))


def centre_y(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return the shift of the zero of Y."""
    return _across(p, np.zeros(len(p)), np.ones(len(p)))


def beam(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return the lean of the beam along X and along Y: a shift by the distance."""
    zero = np.zeros(len(p))
    return np.stack([_across(p, p.distance, zero), _across(p, zero, p.distance)])


def squareness(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return the angle of X to the plane of the spindle: a cone."""
    return p.slide_x


def parallelism(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return the angle of Z to the spindle, in X and in Y: a shift by Z."""
    zero = np.zeros(len(p))
    return np.stack([_across(p, p.z, zero), _across(p, zero, p.z)])


def straightness_x(p: ScanPoints, parameters: Parameters) -> FloatArray:
    """Return an unknown curve over X, towards the probe."""
    return _unknown_over(p.slide_x, parameters)


def straightness_z(p: ScanPoints, parameters: Parameters) -> FloatArray:
    """Return an unknown curve over Z, along X."""
    zero = np.zeros(len(p))
    return np.stack([_across(p, bow, zero) for bow in _unknown_over(p.z, parameters)])


def _unknown_over(position: FloatArray, parameters: Parameters) -> FloatArray:
    """Return components of a curve over ``position`` (n,), smooth over half of it by default."""
    length = parameters.get("correlation_length", float(np.ptp(position)) / 2)
    return components(smooth(length), position)


def _turning(p: ScanPoints, parameters: Parameters) -> tuple[FloatArray, FloatArray]:
    angle = parameters["per_turn"] * p.c
    return np.cos(angle), np.sin(angle)


def spindle_axial(p: ScanPoints, parameters: Parameters) -> FloatArray:
    """Return both phases of a wave of the height over the turn."""
    return np.stack(_turning(p, parameters))


def spindle_radial(p: ScanPoints, parameters: Parameters) -> FloatArray:
    """Return both phases of a turning shift."""
    along, across = _turning(p, parameters)
    return np.stack([_across(p, along, across), _across(p, -across, along)])


def spindle_tilt(p: ScanPoints, parameters: Parameters) -> FloatArray:
    """Return both phases of a turning tilt."""
    along, across = _turning(p, parameters)
    return np.stack(
        [p.slide_x * along + p.slide_y * across, p.slide_y * along - p.slide_x * across]
    )


def encoder_scale(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return the stretch of Z."""
    return p.z


def encoder_interpolation(p: ScanPoints, parameters: Parameters) -> FloatArray:
    """Return both phases of a wave over Z."""
    return _periodic(p.z, parameters["period"])


def pitch(p: ScanPoints, parameters: Parameters) -> FloatArray:
    """Return an unknown angle over Z times the Abbe arm."""
    return parameters["arm"] * _unknown_over(p.z, parameters)


def backlash(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return the direction in which Z moves."""
    return np.sign(p.z_rate)


def static_gain(p: ScanPoints, parameters: Parameters) -> FloatArray:
    """Return the stretch of the distance."""
    return -p.distance / parameters["gain"]


def lateral_lag(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return the rate of Z: late points lie further along the path."""
    return p.z_rate


def dynamics(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return the directions of the covariance that are of noise."""
    return _rows_or_none(p.dynamics[~p.hidden], p)


def could_hide(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return those that are of what the step test could not show."""
    return _rows_or_none(p.dynamics[p.hidden], p)


def _rows_or_none(rows: FloatArray, p: ScanPoints) -> FloatArray:
    return rows if len(rows) else np.zeros((1, len(p)))


def linearity(p: ScanPoints, parameters: Parameters) -> FloatArray:
    """Return the cube of the distance, one at the end of the range."""
    return np.asarray((p.distance / parameters["half_range"]) ** 3, np.float64)


def linearity_periodic(p: ScanPoints, parameters: Parameters) -> FloatArray:
    """Return both phases of a wave over the distance."""
    return _periodic(p.distance, parameters["period"])


def _periodic(position: FloatArray, period: float) -> FloatArray:
    angle = 2 * np.pi / period * position
    return np.stack([np.cos(angle), np.sin(angle)])


def slope(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return the slope both ways, for nobody knows in which one a beam is tilted."""
    one, zero = np.ones(len(p)), np.zeros(len(p))
    return np.stack([_across(p, one, zero), _across(p, zero, one)])


def slope_square(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return the square of the slope."""
    one, zero = np.ones(len(p)), np.zeros(len(p))
    return np.asarray(p.sideways(one, zero) ** 2 + p.sideways(zero, one) ** 2, np.float64)


def drift_rate(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return the time."""
    return p.time


def drift_walk(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return an unknown walk over time."""
    return components(random_walk, p.time)


def drift(p: ScanPoints, parameters: Parameters) -> FloatArray:
    """Return an unknown curve over time that fades."""
    return components(fading(parameters["correlation_time"]), p.time)


def of_a_walk(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return the sum of squares of a walk."""
    return p.time


def of_a_curve(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return the sum of squares of an unknown curve."""
    return np.ones(len(p))


def of_a_lateral_curve(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return the sum of squares of an unknown curve along X."""
    return np.asarray(_across(p, np.ones(len(p)), np.zeros(len(p))) ** 2, np.float64)


def of_pitch(p: ScanPoints, parameters: Parameters) -> FloatArray:
    """Return the sum of squares of an unknown pitch."""
    return np.full(len(p), parameters["arm"] ** 2)
