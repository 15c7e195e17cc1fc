"""Kinds of systematic errors of a machine and their sensitivity fields.

``KINDS`` has one entry for each kind, with its quantity, parameters and fields. The settings file
of a machine states the sizes by these names.

Each field function returns the change of the heights [m] of n points per unit of the error, (k, n)
for its k independent components or (n,) for one. Fields of lateral shifts need the slopes.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from omsm_ros import quantities
from omsm_ros.core.correction.systematic import ScanPoints, SystematicSource
from omsm_ros.core.kinematics.kinematics import workpiece_xy
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import ConfigurationError, Notice
from omsm_ros.quantities import Quantity

Kernel = Callable[[FloatArray, FloatArray], FloatArray]
Parameters = Mapping[str, float]

# Nodes between which the components of an unknown curve are interpolated; the shortest wave of
# those kept has a few nodes.
_NODES = 128
# Share of the variance that may be left out, 0.5 % of the standard deviation.
_LEFT_OUT = 0.01


def random_walk(start: FloatArray, end: FloatArray) -> FloatArray:
    """Return the covariance of a random walk with unit variance after one unit, zero at zero."""
    return np.minimum(start, end)


def fading(length: float) -> Kernel:
    """Return the covariance exp(-distance / ``length``) of a curve of unit variance."""
    return lambda start, end: np.exp(-np.abs(start - end) / length)


def smooth(length: float) -> Kernel:
    """Return the covariance of a smooth curve of unit variance, correlated over ``length``."""
    return lambda start, end: np.exp(-0.5 * ((start - end) / length) ** 2)


def components(kernel: Kernel, where: FloatArray) -> FloatArray:
    """Return independent components (k, n) of an unknown curve at ``where`` (n,).

    Only the covariance of the curve is known. Its Karhunen-Loève components are the eigenvectors
    of the covariance; their squares add up to the variance of the curve, less 1 % at most.
    """
    first, last = float(np.min(where)), float(np.max(where))
    if last == first:
        size = float(np.sqrt(kernel(where[:1], where[:1])[0]))
        return np.full((1, len(where)), size)
    nodes = np.linspace(first, last, _NODES)
    values, vectors = np.linalg.eigh(kernel(nodes[:, np.newaxis], nodes[np.newaxis]))
    values, vectors = np.maximum(values[::-1], 0.0), vectors[:, ::-1]
    share = np.cumsum(values) / max(float(values.sum()), np.finfo(np.float64).tiny)
    kept = min(int(np.searchsorted(share, 1 - _LEFT_OUT)) + 1, _NODES)
    return np.stack(
        [
            np.interp(where, nodes, np.sqrt(value) * vector)
            for value, vector in zip(values[:kept], vectors.T[:kept], strict=True)
        ]
    )


def tilt(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return tilts about y and about x; the lateral shift of the points is negligible."""
    return np.stack([-p.x, p.y])


def decentre(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return the shift of the part along x and along y."""
    one, zero = np.ones(len(p)), np.zeros(len(p))
    return np.stack([p.height_change_of_shift(one, zero), p.height_change_of_shift(zero, one)])


def clocking(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return the turn of the part about the spindle."""
    return p.height_change_of_shift(-p.y, p.x)


def expansion(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return the growth of the part in all directions."""
    return p.height + p.height_change_of_shift(p.x, p.y)


def _across(p: ScanPoints, x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the field of a shift by x, y [m] in the machine's frame."""
    return p.height_change_of_shift(*workpiece_xy(x, y, p.c))


def centre_x(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return the shift of the zero of X."""
    return _across(p, np.ones(len(p)), np.zeros(len(p)))


def centre_y(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return the shift of the zero of Y."""
    return _across(p, np.zeros(len(p)), np.ones(len(p)))


def beam(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return the tilt of the beam along X and along Y, a shift proportional to the distance."""
    zero = np.zeros(len(p))
    return np.stack([_across(p, p.distance, zero), _across(p, zero, p.distance)])


def squareness(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return the angle of X to the plane of the spindle, which makes a cone."""
    return p.slide_x


def parallelism(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return the angle of Z to the spindle in X and in Y, a shift proportional to Z."""
    zero = np.zeros(len(p))
    return np.stack([_across(p, p.z, zero), _across(p, zero, p.z)])


def straightness_x(p: ScanPoints, parameters: Parameters) -> FloatArray:
    """Return an unknown curve over X, towards the probe."""
    return _curve_components(p.slide_x, parameters)


def straightness_z(p: ScanPoints, parameters: Parameters) -> FloatArray:
    """Return an unknown curve over Z, along X."""
    zero = np.zeros(len(p))
    return np.stack([_across(p, bow, zero) for bow in _curve_components(p.z, parameters)])


def _curve_components(position: FloatArray, parameters: Parameters) -> FloatArray:
    """Return components of a smooth curve over ``position`` (n,)."""
    length = parameters.get("correlation_length", float(np.ptp(position)) / 2)
    return components(smooth(length), position)


def _turning(p: ScanPoints, parameters: Parameters) -> tuple[FloatArray, FloatArray]:
    angle = parameters["per_turn"] * p.c
    return np.cos(angle), np.sin(angle)


def spindle_axial(p: ScanPoints, parameters: Parameters) -> FloatArray:
    """Return both phases of an axial motion that is periodic in the turn."""
    return np.stack(_turning(p, parameters))


def spindle_radial(p: ScanPoints, parameters: Parameters) -> FloatArray:
    """Return both phases of a rotating shift."""
    along, across = _turning(p, parameters)
    return np.stack([_across(p, along, across), _across(p, -across, along)])


def spindle_tilt(p: ScanPoints, parameters: Parameters) -> FloatArray:
    """Return both phases of a rotating tilt."""
    along, across = _turning(p, parameters)
    return np.stack(
        [p.slide_x * along + p.slide_y * across, p.slide_y * along - p.slide_x * across]
    )


def encoder_scale(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return the scale of Z."""
    return p.z


def encoder_interpolation(p: ScanPoints, parameters: Parameters) -> FloatArray:
    """Return both phases of a wave over Z."""
    return _periodic(p.z, parameters["period"])


def pitch(p: ScanPoints, parameters: Parameters) -> FloatArray:
    """Return an unknown angle over Z times the Abbe arm."""
    return parameters["arm"] * _curve_components(p.z, parameters)


def backlash(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return the direction in which Z moves."""
    return np.sign(p.z_rate)


def static_gain(p: ScanPoints, parameters: Parameters) -> FloatArray:
    """Return the scale of the distance."""
    return -p.distance / parameters["gain"]


def probe_latency(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return the rate of Z: delayed points lie further along the path."""
    return p.z_rate


def dynamics(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return the directions of the covariance from noise."""
    return _rows_or_empty(p.dynamics[~p.undetected], p)


def undetected_error(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return the directions of the covariance from undetected model error."""
    return _rows_or_empty(p.dynamics[p.undetected], p)


def _rows_or_empty(rows: FloatArray, p: ScanPoints) -> FloatArray:
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
    """Return the slope in both directions, because the direction of the error is unknown."""
    one, zero = np.ones(len(p)), np.zeros(len(p))
    return np.stack([_across(p, one, zero), _across(p, zero, one)])


def slope_square(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return the square of the slope."""
    one, zero = np.ones(len(p)), np.zeros(len(p))
    return np.asarray(
        p.height_change_of_shift(one, zero) ** 2 + p.height_change_of_shift(zero, one) ** 2,
        np.float64,
    )


def drift_rate(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return the time."""
    return p.time


def drift_walk(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return an unknown walk over time."""
    return components(random_walk, p.time)


def drift(p: ScanPoints, parameters: Parameters) -> FloatArray:
    """Return an unknown, exponentially correlated curve over time."""
    return components(fading(parameters["correlation_time"]), p.time)


def random_walk_variance(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return the sum of squares of a random walk."""
    return p.time


def curve_variance(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return the sum of squares of an unknown curve."""
    return np.ones(len(p))


def lateral_curve_variance(p: ScanPoints, _: Parameters) -> FloatArray:
    """Return the sum of squares of an unknown curve along X."""
    return np.asarray(_across(p, np.ones(len(p)), np.zeros(len(p))) ** 2, np.float64)


def pitch_variance(p: ScanPoints, parameters: Parameters) -> FloatArray:
    """Return the sum of squares of an unknown pitch."""
    return np.full(len(p), parameters["arm"] ** 2)


@dataclass(frozen=True)
class SourceKind:
    """A kind of systematic error.

    quantity: of its standard uncertainty
    fields: change of each height [m] per unit, (k, n), by the parameters
    parameters: further quantities by name;  optional: those that may be left out
    squares: sum of the squares of the fields, (n,), where a shorter way exists
    """

    quantity: Quantity
    fields: Callable[[ScanPoints, Parameters], FloatArray]
    parameters: Mapping[str, Quantity] = field(default_factory=dict)
    optional: tuple[str, ...] = ()
    needs_slope: bool = False
    squares: Callable[[ScanPoints, Parameters], FloatArray] | None = None


def source_of(
    name: str, value: float, origin: str, reason: str | Notice, parameters: Parameters
) -> SystematicSource:
    """Return the source of kind ``name`` with standard uncertainty ``value``.

    Raises ConfigurationError for implausible values and for parameters that are unknown or missing.
    """
    kind = KINDS[name]
    kind.quantity.checked(value, ConfigurationError, name)
    for key, size in parameters.items():
        if key not in kind.parameters:
            raise ConfigurationError(
                "correction.parameter", source=name, parameter=key, known=sorted(kind.parameters)
            )
        kind.parameters[key].checked(size, ConfigurationError, f"{name}.{key}")
    for key in kind.parameters:
        if key not in parameters and key not in kind.optional:
            unit = kind.parameters[key].unit or "1"
            raise ConfigurationError(
                "correction.needs_parameter", source=name, parameter=key, unit=unit
            )
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

# Names in files of earlier versions.
FORMER_NAMES = {"lateral_lag": "probe_latency", "could_hide": "undetected_model_error"}

KINDS: dict[str, SourceKind] = {
    "dynamics": SourceKind(_SHARE, dynamics),
    "undetected_model_error": SourceKind(_SHARE, undetected_error),
    "static_gain": SourceKind(_SHARE, static_gain, {"gain": quantities.GAIN}),
    "probe_latency": SourceKind(_SECONDS, probe_latency),
    "lag_change": SourceKind(_SECONDS, probe_latency),
    "motion_error": SourceKind(_METRES, backlash),
    "tilt": SourceKind(_RADIANS, tilt),
    "decentre": SourceKind(_METRES, decentre, needs_slope=True),
    "clocking": SourceKind(_RADIANS, clocking, needs_slope=True),
    "expansion": SourceKind(_SHARE, expansion, needs_slope=True),
    "centre_x": SourceKind(_METRES, centre_x, needs_slope=True),
    "centre_y": SourceKind(_METRES, centre_y, needs_slope=True),
    "beam": SourceKind(_SHARE, beam, needs_slope=True),
    "squareness": SourceKind(_RADIANS, squareness),
    "parallelism": SourceKind(_RADIANS, parallelism, needs_slope=True),
    "straightness_x": SourceKind(
        _METRES, straightness_x, _CORRELATED, _LENGTH_OPTIONAL, squares=curve_variance
    ),
    "straightness_z": SourceKind(
        _METRES,
        straightness_z,
        _CORRELATED,
        _LENGTH_OPTIONAL,
        needs_slope=True,
        squares=lateral_curve_variance,
    ),
    "pitch": SourceKind(
        _RADIANS,
        pitch,
        {"arm": quantities.LENGTH, **_CORRELATED},
        _LENGTH_OPTIONAL,
        squares=pitch_variance,
    ),
    "spindle_axial": SourceKind(_METRES, spindle_axial, _PER_TURN),
    "spindle_radial": SourceKind(_METRES, spindle_radial, _PER_TURN, needs_slope=True),
    "spindle_tilt": SourceKind(_RADIANS, spindle_tilt, _PER_TURN),
    "encoder_scale": SourceKind(_SHARE, encoder_scale),
    "encoder_interpolation": SourceKind(_METRES, encoder_interpolation, _PERIOD),
    "probe_linearity": SourceKind(_METRES, linearity, {"half_range": quantities.PERIOD}),
    "probe_periodic": SourceKind(_METRES, linearity_periodic, _PERIOD),
    "probe_slope": SourceKind(quantities.SLOPE_ERROR, slope, needs_slope=True),
    "probe_slope_square": SourceKind(quantities.SLOPE_ERROR, slope_square, needs_slope=True),
    "drift_rate": SourceKind(quantities.RATE_UNCERTAINTY, drift_rate),
    "drift_walk": SourceKind(quantities.WALK_UNCERTAINTY, drift_walk, squares=random_walk_variance),
    "drift": SourceKind(
        _METRES, drift, {"correlation_time": quantities.CORRELATION_TIME}, squares=curve_variance
    ),
}
"""Kinds of systematic error by their names."""
