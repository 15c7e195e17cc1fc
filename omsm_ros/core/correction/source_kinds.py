"""Which systematic errors can a machine have, and what is the sensitivity field of each?

One row of ``KINDS`` is one kind. A machine's settings file states sizes by these names, whatever
reads ``KINDS`` knows the rest: unit, further parameters, fields.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from omsm_ros import quantities
from omsm_ros.core.correction import sensitivities as of
from omsm_ros.core.correction.sensitivities import Parameters
from omsm_ros.core.correction.systematic import ScanPoints, SystematicSource
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.errors import ConfigurationError
from omsm_ros.quantities import Quantity


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
                f"{name} has no parameter {key!r}, expected one of {sorted(kind.parameters)}"
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


_METRES, _RADIANS = quantities.UNCERTAINTY, quantities.ANGLE_UNCERTAINTY
_SHARE, _SECONDS = quantities.GAIN_UNCERTAINTY, quantities.TIME_UNCERTAINTY
_PER_TURN = {"per_turn": quantities.PER_TURN}
_PERIOD = {"period": quantities.PERIOD}
_CORRELATED = {"correlation_length": quantities.PERIOD}
_LENGTH_OPTIONAL = ("correlation_length",)

KINDS: dict[str, SourceKind] = {
    "dynamics": SourceKind("noise of the step test", _SHARE, of.dynamics),
    "could_hide": SourceKind("what the step test could not show", _SHARE, of.could_hide),
    "static_gain": SourceKind(
        "static gain of the probe", _SHARE, of.static_gain, {"gain": quantities.GAIN}
    ),
    "lateral_lag": SourceKind("latency that X and C do not share", _SECONDS, of.lateral_lag),
    "lag_change": SourceKind("lag of Z since the step test", _SECONDS, of.lateral_lag),
    "motion_error": SourceKind("half the backlash of Z", _METRES, of.backlash),
    "tilt": SourceKind("tilt of the part, each way", _RADIANS, of.tilt),
    "decentre": SourceKind("shift of the part, each way", _METRES, of.decentre, needs_slope=True),
    "clocking": SourceKind("turn of the part", _RADIANS, of.clocking, needs_slope=True),
    "expansion": SourceKind("thermal strain of the part", _SHARE, of.expansion, needs_slope=True),
    "centre_x": SourceKind("zero of X at the spindle", _METRES, of.centre_x, needs_slope=True),
    "centre_y": SourceKind("zero of Y at the spindle", _METRES, of.centre_y, needs_slope=True),
    "beam": SourceKind("slope of the beam, each way", _SHARE, of.beam, needs_slope=True),
    "squareness": SourceKind("angle of X to the spindle's plane", _RADIANS, of.squareness),
    "parallelism": SourceKind(
        "angle of Z to the spindle, each way", _RADIANS, of.parallelism, needs_slope=True
    ),
    "straightness_x": SourceKind(
        "straightness of X towards the probe",
        _METRES,
        of.straightness_x,
        _CORRELATED,
        _LENGTH_OPTIONAL,
        squares=of.of_a_curve,
    ),
    "straightness_z": SourceKind(
        "straightness of Z, sideways",
        _METRES,
        of.straightness_z,
        _CORRELATED,
        _LENGTH_OPTIONAL,
        needs_slope=True,
        squares=of.of_a_lateral_curve,
    ),
    "pitch": SourceKind(
        "pitch of Z, over the Abbe arm",
        _RADIANS,
        of.pitch,
        {"arm": quantities.LENGTH, **_CORRELATED},
        _LENGTH_OPTIONAL,
        squares=of.of_pitch,
    ),
    "spindle_axial": SourceKind(
        "axial motion in step with the spindle", _METRES, of.spindle_axial, _PER_TURN
    ),
    "spindle_radial": SourceKind(
        "radial motion in step with the spindle",
        _METRES,
        of.spindle_radial,
        _PER_TURN,
        needs_slope=True,
    ),
    "spindle_tilt": SourceKind(
        "tilt in step with the spindle", _RADIANS, of.spindle_tilt, _PER_TURN
    ),
    "encoder_scale": SourceKind("scale of the Z encoder", _SHARE, of.encoder_scale),
    "encoder_interpolation": SourceKind(
        "interpolation of the Z encoder", _METRES, of.encoder_interpolation, _PERIOD
    ),
    "probe_linearity": SourceKind(
        "cubic error of the probe at the end of its range",
        _METRES,
        of.linearity,
        {"half_range": quantities.PERIOD},
    ),
    "probe_periodic": SourceKind(
        "periodic error of the probe", _METRES, of.linearity_periodic, _PERIOD
    ),
    "probe_slope": SourceKind(
        "error of the probe by the slope, each way",
        quantities.SLOPE_ERROR,
        of.slope,
        needs_slope=True,
    ),
    "probe_slope_square": SourceKind(
        "error of the probe by the square of the slope",
        quantities.SLOPE_ERROR,
        of.slope_square,
        needs_slope=True,
    ),
    "drift_rate": SourceKind("steady drift", quantities.RATE_UNCERTAINTY, of.drift_rate),
    "drift_walk": SourceKind(
        "drift as a random walk", quantities.WALK_UNCERTAINTY, of.drift_walk, squares=of.of_a_walk
    ),
    "drift": SourceKind(
        "drift that fades",
        _METRES,
        of.drift,
        {"correlation_time": quantities.CORRELATION_TIME},
        squares=of.of_a_curve,
    ),
}
"""Kinds of systematic error by their names."""
