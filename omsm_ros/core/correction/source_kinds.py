"""Which systematic errors can a machine have, and what is the sensitivity field of each?

One row of ``KINDS`` is one kind. A machine's settings file states sizes by these names, whatever
reads ``KINDS`` knows the rest: unit, further parameters, fields.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from omsm_ros import quantities
from omsm_ros.core.correction.systematic import ScanPoints, SystematicSource
from omsm_ros.core.correction.unknown_curves import components, fading, random_walk, smooth
from omsm_ros.core.machine.kinematics import workpiece_xy
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.errors import ConfigurationError
from omsm_ros.quantities import Quantity

Parameters = Mapping[str, float]


@dataclass(frozen=True)
class SourceKind:
    """A kind of systematic error.

    says: what its standard uncertainty is of;  quantity: of that, with its unit
    fields: change of each height [m] per unit, (k, n), by the parameters
    parameters: further quantities by name;  optional: those that may be left out
    squares: sum of the squares of the fields, (n,), where that is had with less work
    """

    says: str
    quantity: Quantity
    fields: Callable[[ScanPoints, Parameters], FloatArray]
    parameters: Mapping[str, Quantity] = field(default_factory=dict)
    optional: tuple[str, ...] = ()
    needs_slope: bool = False
    squares: Callable[[ScanPoints, Parameters], FloatArray] | None = None


def source_of(
    name: str, value: float, origin: str, reason: str, parameters: Parameters
) -> SystematicSource:
    """Return the source of kind ``name`` with standard uncertainty ``value``.

    Raises ConfigurationError for values or parameters that the kind does not have.
    """
    kind = KINDS[name]
    kind.quantity.checked(value, ConfigurationError, name)
    for key, size in parameters.items():
        if key not in kind.parameters:
            raise ConfigurationError(
                f"{name} has no parameter {key!r}, expected of {sorted(kind.parameters)}"
            )
        kind.parameters[key].checked(size, ConfigurationError, f"{name}.{key}")
    for key in kind.parameters:
        if key not in parameters and key not in kind.optional:
            unit = kind.parameters[key].unit
            raise ConfigurationError(f"{name} needs {key} [{unit or '1'}]; state it beside value")
    squares = kind.squares
    return SystematicSource(
        name=name,
        unit=kind.quantity.unit or "1",
        standard_uncertainty=float(value),
        fields=lambda points: np.atleast_2d(kind.fields(points, parameters)),
        origin=origin,
        reason=reason,
        needs_slope=kind.needs_slope,
        squares=None if squares is None else lambda points: squares(points, parameters),
    )


# ------------------------------------------------------------------------ pose of the part


def _tilt(p: ScanPoints, _: Parameters) -> FloatArray:
    """About y and about x; that a tilted point also goes sideways is a hundredth of it."""
    return np.stack([-p.x, p.y])


def _decentre(p: ScanPoints, _: Parameters) -> FloatArray:
    one, zero = np.ones(len(p)), np.zeros(len(p))
    return np.stack([p.sideways(one, zero), p.sideways(zero, one)])


def _clocking(p: ScanPoints, _: Parameters) -> FloatArray:
    return p.sideways(-p.y, p.x)


def _expansion(p: ScanPoints, _: Parameters) -> FloatArray:
    return p.height + p.sideways(p.x, p.y)


# -------------------------------------------------------------------------------- machine


def _across(p: ScanPoints, x: FloatArray, y: FloatArray) -> FloatArray:
    """Return what a shift by x, y [m] of the machine's frame does to the heights."""
    return p.sideways(*workpiece_xy(x, y, p.c))


def _centre_x(p: ScanPoints, _: Parameters) -> FloatArray:
    return _across(p, np.ones(len(p)), np.zeros(len(p)))


def _centre_y(p: ScanPoints, _: Parameters) -> FloatArray:
    return _across(p, np.zeros(len(p)), np.ones(len(p)))


def _beam(p: ScanPoints, _: Parameters) -> FloatArray:
    zero = np.zeros(len(p))
    return np.stack([_across(p, p.distance, zero), _across(p, zero, p.distance)])


def _squareness(p: ScanPoints, _: Parameters) -> FloatArray:
    return p.slide_x


def _parallelism(p: ScanPoints, _: Parameters) -> FloatArray:
    zero = np.zeros(len(p))
    return np.stack([_across(p, p.z, zero), _across(p, zero, p.z)])


def _straightness_x(p: ScanPoints, parameters: Parameters) -> FloatArray:
    return _unknown_over(p.slide_x, parameters)


def _straightness_z(p: ScanPoints, parameters: Parameters) -> FloatArray:
    zero = np.zeros(len(p))
    return np.stack([_across(p, bow, zero) for bow in _unknown_over(p.z, parameters)])


def _unknown_over(position: FloatArray, parameters: Parameters) -> FloatArray:
    """Return components of a curve over ``position`` (n,), smooth over half of it if not told."""
    length = parameters.get("correlation_length", float(np.ptp(position)) / 2)
    return components(smooth(length), position)


def _turning(p: ScanPoints, parameters: Parameters) -> tuple[FloatArray, FloatArray]:
    angle = parameters["per_turn"] * p.c
    return np.cos(angle), np.sin(angle)


def _spindle_axial(p: ScanPoints, parameters: Parameters) -> FloatArray:
    return np.stack(_turning(p, parameters))


def _spindle_radial(p: ScanPoints, parameters: Parameters) -> FloatArray:
    along, across = _turning(p, parameters)
    return np.stack([_across(p, along, across), _across(p, -across, along)])


def _spindle_tilt(p: ScanPoints, parameters: Parameters) -> FloatArray:
    along, across = _turning(p, parameters)
    return np.stack(
        [p.slide_x * along + p.slide_y * across, p.slide_y * along - p.slide_x * across]
    )


def _encoder_scale(p: ScanPoints, _: Parameters) -> FloatArray:
    return p.z


def _encoder_interpolation(p: ScanPoints, parameters: Parameters) -> FloatArray:
    return _periodic(p.z, parameters["period"])


def _pitch(p: ScanPoints, parameters: Parameters) -> FloatArray:
    return parameters["arm"] * _unknown_over(p.z, parameters)


def _backlash(p: ScanPoints, _: Parameters) -> FloatArray:
    return np.sign(p.z_rate)


# ---------------------------------------------------------------------------------- probe


def _static_gain(p: ScanPoints, parameters: Parameters) -> FloatArray:
    return -p.distance / parameters["gain"]


def _lateral_lag(p: ScanPoints, _: Parameters) -> FloatArray:
    return p.z_rate


def _dynamics(p: ScanPoints, _: Parameters) -> FloatArray:
    return _rows_or_none(p.dynamics[~p.hidden], p)


def _could_hide(p: ScanPoints, _: Parameters) -> FloatArray:
    return _rows_or_none(p.dynamics[p.hidden], p)


def _rows_or_none(rows: FloatArray, p: ScanPoints) -> FloatArray:
    return rows if len(rows) else np.zeros((1, len(p)))


def _linearity(p: ScanPoints, parameters: Parameters) -> FloatArray:
    return np.asarray((p.distance / parameters["half_range"]) ** 3, np.float64)


def _linearity_periodic(p: ScanPoints, parameters: Parameters) -> FloatArray:
    return _periodic(p.distance, parameters["period"])


def _periodic(position: FloatArray, period: float) -> FloatArray:
    angle = 2 * np.pi / period * position
    return np.stack([np.cos(angle), np.sin(angle)])


def _slope(p: ScanPoints, _: Parameters) -> FloatArray:
    """Both directions of the machine, for nobody knows in which one a beam is tilted."""
    one, zero = np.ones(len(p)), np.zeros(len(p))
    return np.stack([_across(p, one, zero), _across(p, zero, one)])


def _slope_square(p: ScanPoints, _: Parameters) -> FloatArray:
    one, zero = np.ones(len(p)), np.zeros(len(p))
    return np.asarray(p.sideways(one, zero) ** 2 + p.sideways(zero, one) ** 2, np.float64)


# ---------------------------------------------------------------------------------- drift


def _drift_rate(p: ScanPoints, _: Parameters) -> FloatArray:
    return p.time


def _drift_walk(p: ScanPoints, _: Parameters) -> FloatArray:
    return components(random_walk, p.time)


def _drift(p: ScanPoints, parameters: Parameters) -> FloatArray:
    return components(fading(parameters["correlation_time"]), p.time)


# ----------------------------------------------- sums of squares of an unknown curve's fields


def _of_a_walk(p: ScanPoints, _: Parameters) -> FloatArray:
    return p.time


def _of_a_curve(p: ScanPoints, _: Parameters) -> FloatArray:
    return np.ones(len(p))


def _of_a_curve_sideways(p: ScanPoints, _: Parameters) -> FloatArray:
    return np.asarray(_across(p, np.ones(len(p)), np.zeros(len(p))) ** 2, np.float64)


def _of_pitch(p: ScanPoints, parameters: Parameters) -> FloatArray:
    return np.full(len(p), parameters["arm"] ** 2)


_METRES, _RADIANS = quantities.UNCERTAINTY, quantities.ANGLE_UNCERTAINTY
_SHARE, _SECONDS = quantities.GAIN_UNCERTAINTY, quantities.TIME_UNCERTAINTY
_PER_TURN = {"per_turn": quantities.PER_TURN}
_PERIOD = {"period": quantities.PERIOD}
_CORRELATED = {"correlation_length": quantities.PERIOD}
_LENGTH_OPTIONAL = ("correlation_length",)

KINDS: dict[str, SourceKind] = {
    "dynamics": SourceKind("noise of the step test", _SHARE, _dynamics),
    "could_hide": SourceKind("what the step test could not show", _SHARE, _could_hide),
    "static_gain": SourceKind(
        "static gain of the probe", _SHARE, _static_gain, {"gain": quantities.GAIN}
    ),
    "lateral_lag": SourceKind("latency that X and C do not share", _SECONDS, _lateral_lag),
    "motion_error": SourceKind("half the backlash of Z", _METRES, _backlash),
    "tilt": SourceKind("tilt of the part, each way", _RADIANS, _tilt),
    "decentre": SourceKind("shift of the part, each way", _METRES, _decentre, needs_slope=True),
    "clocking": SourceKind("turn of the part", _RADIANS, _clocking, needs_slope=True),
    "expansion": SourceKind("thermal strain of the part", _SHARE, _expansion, needs_slope=True),
    "centre_x": SourceKind("zero of X at the spindle", _METRES, _centre_x, needs_slope=True),
    "centre_y": SourceKind("zero of Y at the spindle", _METRES, _centre_y, needs_slope=True),
    "beam": SourceKind("slope of the beam, each way", _SHARE, _beam, needs_slope=True),
    "squareness": SourceKind("angle of X to the spindle's plane", _RADIANS, _squareness),
    "parallelism": SourceKind(
        "angle of Z to the spindle, each way", _RADIANS, _parallelism, needs_slope=True
    ),
    "straightness_x": SourceKind(
        "straightness of X towards the probe",
        _METRES,
        _straightness_x,
        _CORRELATED,
        _LENGTH_OPTIONAL,
        squares=_of_a_curve,
    ),
    "straightness_z": SourceKind(
        "straightness of Z, sideways",
        _METRES,
        _straightness_z,
        _CORRELATED,
        _LENGTH_OPTIONAL,
        needs_slope=True,
        squares=_of_a_curve_sideways,
    ),
    "pitch": SourceKind(
        "pitch of Z, over the Abbe arm",
        _RADIANS,
        _pitch,
        {"arm": quantities.LENGTH, **_CORRELATED},
        _LENGTH_OPTIONAL,
        squares=_of_pitch,
    ),
    "spindle_axial": SourceKind(
        "axial motion in step with the spindle", _METRES, _spindle_axial, _PER_TURN
    ),
    "spindle_radial": SourceKind(
        "radial motion in step with the spindle",
        _METRES,
        _spindle_radial,
        _PER_TURN,
        needs_slope=True,
    ),
    "spindle_tilt": SourceKind("tilt in step with the spindle", _RADIANS, _spindle_tilt, _PER_TURN),
    "encoder_scale": SourceKind("scale of the Z encoder", _SHARE, _encoder_scale),
    "encoder_interpolation": SourceKind(
        "interpolation of the Z encoder", _METRES, _encoder_interpolation, _PERIOD
    ),
    "probe_linearity": SourceKind(
        "cubic error of the probe at the end of its range",
        _METRES,
        _linearity,
        {"half_range": quantities.PERIOD},
    ),
    "probe_periodic": SourceKind(
        "periodic error of the probe", _METRES, _linearity_periodic, _PERIOD
    ),
    "probe_slope": SourceKind(
        "error of the probe by the slope, each way",
        quantities.SLOPE_ERROR,
        _slope,
        needs_slope=True,
    ),
    "probe_slope_square": SourceKind(
        "error of the probe by the square of the slope",
        quantities.SLOPE_ERROR,
        _slope_square,
        needs_slope=True,
    ),
    "drift_rate": SourceKind("steady drift", quantities.RATE_UNCERTAINTY, _drift_rate),
    "drift_walk": SourceKind(
        "drift as a random walk", quantities.WALK_UNCERTAINTY, _drift_walk, squares=_of_a_walk
    ),
    "drift": SourceKind(
        "drift that fades",
        _METRES,
        _drift,
        {"correlation_time": quantities.CORRELATION_TIME},
        squares=_of_a_curve,
    ),
}
"""Kinds of systematic error by their names."""
