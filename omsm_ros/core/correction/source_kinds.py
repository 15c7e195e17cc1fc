"""Kinds of systematic errors of a machine and their sensitivity fields.

``KINDS`` has one entry for each kind, with its quantity, parameters and fields. The settings file
of a machine states the sizes by these names.

Each field function returns the change of the heights [m] of n points per unit of the error, (k, n)
for its k independent components or (n,) for one. Fields of lateral shifts need the slopes.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from omsm_ros import quantities
from omsm_ros.core.correction.systematic import ScanPoints
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
    """Return the covariance exp(-(distance / ``length``)²) of a smooth curve of unit variance."""
    return lambda start, end: np.exp(-(((start - end) / length) ** 2))


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


def _across(p: ScanPoints, x: FloatArray | float, y: FloatArray | float) -> FloatArray:
    """Return the field of a shift by x, y [m] in the machine's frame."""
    one = np.ones(len(p))
    return p.height_change_of_shift(*workpiece_xy(x * one, y * one, p.c))


def _along_both(p: ScanPoints) -> FloatArray:
    """Return the fields (2, n) of a shift of the part along x and along y."""
    one, zero = np.ones(len(p)), np.zeros(len(p))
    return np.stack([p.height_change_of_shift(one, zero), p.height_change_of_shift(zero, one)])


def _across_both(p: ScanPoints, size: FloatArray | float) -> FloatArray:
    """Return the fields (2, n) of a shift by ``size`` [m] along X and along Y of the machine."""
    return np.stack([_across(p, size, 0.0), _across(p, 0.0, size)])


def _curve_components(position: FloatArray, parameters: Parameters) -> FloatArray:
    """Return components of a smooth curve over ``position`` (n,)."""
    length = parameters.get("correlation_length", float(np.ptp(position)) / 2**0.5)
    return components(smooth(length), position)


def _phases(angle: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return both phases of a wave of unknown phase."""
    return np.cos(angle), np.sin(angle)


def _rotating_shift(p: ScanPoints, parameters: Parameters) -> FloatArray:
    along, across = _phases(parameters["per_turn"] * p.c)
    return np.stack([_across(p, along, across), _across(p, -across, along)])


def _rotating_tilt(p: ScanPoints, parameters: Parameters) -> FloatArray:
    along, across = _phases(parameters["per_turn"] * p.c)
    return np.stack(
        [p.slide_x * along + p.slide_y * across, p.slide_y * along - p.slide_x * across]
    )


def _periodic(position: FloatArray, parameters: Parameters) -> FloatArray:
    return np.stack(_phases(2 * np.pi / parameters["period"] * position))


def _rows_or_empty(rows: FloatArray, p: ScanPoints) -> FloatArray:
    return rows if len(rows) else np.zeros((1, len(p)))


@dataclass(frozen=True)
class SourceKind:
    """A kind of systematic error.

    quantity: of its standard uncertainty
    fields: change of each height [m] per unit, (k, n), by the parameters
    parameters: further quantities by name, of which ``correlation_length`` may be left out
    squares: sum of the squares of the fields, (n,), where a shorter way exists
    """

    quantity: Quantity
    fields: Callable[[ScanPoints, Parameters], FloatArray]
    parameters: Mapping[str, Quantity] = field(default_factory=dict)
    needs_slope: bool = False
    squares: Callable[[ScanPoints, Parameters], FloatArray] | None = None


@dataclass(frozen=True)
class SystematicSource:
    """A source of error that is common to a whole scan.

    name: of its kind;  standard_uncertainty: of each of its independent components, k = 1
    origin: EVALUATED from data, DECLARED or ASSUMED;  reason: where the size comes from
    parameters: of its kind

    Raises ConfigurationError for implausible values and for parameters that are unknown or missing.
    """

    name: str
    standard_uncertainty: float
    origin: str
    reason: str | Notice
    parameters: Parameters = field(default_factory=dict)

    def __post_init__(self) -> None:
        name, known = self.name, self.kind.parameters
        self.kind.quantity.checked(self.standard_uncertainty, ConfigurationError, name)
        for key, size in self.parameters.items():
            if key not in known:
                raise ConfigurationError(
                    "correction.parameter", source=name, parameter=key, known=sorted(known)
                )
            known[key].checked(size, ConfigurationError, f"{name}.{key}")
        for key in known:
            if key not in self.parameters and key not in _CORRELATED:
                unit = known[key].unit or "1"
                raise ConfigurationError(
                    "correction.needs_parameter", source=name, parameter=key, unit=unit
                )

    @property
    def kind(self) -> SourceKind:
        """Kind of the source."""
        return KINDS[self.name]

    def standard_fields(self, points: ScanPoints) -> FloatArray:
        """Return the change of the heights [m] per standard uncertainty, (k, n)."""
        fields = np.atleast_2d(self.kind.fields(points, self.parameters))
        return np.asarray(self.standard_uncertainty * fields, np.float64)

    def variance(self, points: ScanPoints) -> FloatArray:
        """Return the variance of each height [m²], (n,)."""
        if self.kind.squares is None:
            return np.asarray(np.sum(self.standard_fields(points) ** 2, axis=0), np.float64)
        squares = self.kind.squares(points, self.parameters)
        return np.asarray(self.standard_uncertainty**2 * squares, np.float64)


def standard_fields(
    sources: Sequence[SystematicSource], points: ScanPoints
) -> dict[str, FloatArray]:
    """Return by name the change of the heights [m] per standard uncertainty, each (k, n).

    Components of sources with the same name are concatenated.
    """
    found: dict[str, list[FloatArray]] = {}
    for source in sources:
        found.setdefault(source.name, []).append(source.standard_fields(points))
    return {name: np.concatenate(parts) for name, parts in found.items()}


_METRES, _RADIANS = quantities.UNCERTAINTY, quantities.ANGLE_UNCERTAINTY
_SHARE, _SECONDS = quantities.GAIN_UNCERTAINTY, quantities.TIME_UNCERTAINTY
_PER_TURN = {"per_turn": quantities.PER_TURN}
_PERIOD = {"period": quantities.PERIOD}
_CORRELATED = {"correlation_length": quantities.PERIOD}

# Names in files of earlier versions.
FORMER_NAMES = {"lateral_lag": "probe_latency", "could_hide": "undetected_model_error"}

KINDS: dict[str, SourceKind] = {
    # Directions of the calibration's covariance.
    "dynamics": SourceKind(_SHARE, lambda p, _: _rows_or_empty(p.dynamics[~p.undetected], p)),
    "undetected_model_error": SourceKind(
        _SHARE, lambda p, _: _rows_or_empty(p.dynamics[p.undetected], p)
    ),
    # The scale of the distance.
    "static_gain": SourceKind(
        _SHARE, lambda p, own: -p.distance / own["gain"], {"gain": quantities.GAIN}
    ),
    # Delayed points lie further along the path.
    "probe_latency": SourceKind(_SECONDS, lambda p, _: p.z_rate),
    "lag_change": SourceKind(_SECONDS, lambda p, _: p.z_rate),
    # The direction in which Z moves.
    "motion_error": SourceKind(
        _METRES, lambda p, _: np.sign(p.z_rate), squares=lambda p, _: np.ones(len(p))
    ),
    # Tilts of the part about y and about x; the lateral shift of the points is negligible.
    "tilt": SourceKind(_RADIANS, lambda p, _: np.stack([-p.x, p.y])),
    "decentre": SourceKind(_METRES, lambda p, _: _along_both(p), needs_slope=True),
    # The turn of the part about the spindle.
    "clocking": SourceKind(
        _RADIANS, lambda p, _: p.height_change_of_shift(-p.y, p.x), needs_slope=True
    ),
    # The growth of the part in all directions.
    "expansion": SourceKind(
        _SHARE, lambda p, _: p.height + p.height_change_of_shift(p.x, p.y), needs_slope=True
    ),
    # Shifts of the zeros of X and Y.
    "centre_x": SourceKind(_METRES, lambda p, _: _across(p, 1.0, 0.0), needs_slope=True),
    "centre_y": SourceKind(_METRES, lambda p, _: _across(p, 0.0, 1.0), needs_slope=True),
    # The tilt of the beam along X and along Y, a shift proportional to the distance.
    "beam": SourceKind(_SHARE, lambda p, _: _across_both(p, p.distance), needs_slope=True),
    # The angle of X to the plane of the spindle, which makes a cone.
    "squareness": SourceKind(_RADIANS, lambda p, _: p.slide_x),
    # The angle of Z to the spindle in X and in Y, a shift proportional to Z.
    "parallelism": SourceKind(_RADIANS, lambda p, _: _across_both(p, p.z), needs_slope=True),
    # Unknown curves: over X towards the probe, over Z along X, over Z as an angle.
    "straightness_x": SourceKind(
        _METRES,
        lambda p, own: _curve_components(p.slide_x, own),
        _CORRELATED,
        squares=lambda p, _: np.ones(len(p)),
    ),
    "straightness_z": SourceKind(
        _METRES,
        # The fields of an unknown curve over Z, along X.
        lambda p, own: np.stack([_across(p, bow, 0.0) for bow in _curve_components(p.z, own)]),
        _CORRELATED,
        needs_slope=True,
        squares=lambda p, _: _across(p, 1.0, 0.0) ** 2,
    ),
    # An unknown curve over X, along X and across it.
    "positioning_x": SourceKind(
        _METRES,
        lambda p, own: np.concatenate(
            [_across_both(p, off) for off in _curve_components(p.slide_x, own)]
        ),
        _CORRELATED,
        needs_slope=True,
    ),
    "pitch": SourceKind(
        _RADIANS,
        lambda p, own: own["arm"] * _curve_components(p.z, own),
        {"arm": quantities.LENGTH, **_CORRELATED},
        squares=lambda p, own: np.full(len(p), own["arm"] ** 2),
    ),
    # Both phases of motions that are periodic in the turn.
    "spindle_axial": SourceKind(
        _METRES, lambda p, own: np.stack(_phases(own["per_turn"] * p.c)), _PER_TURN
    ),
    "spindle_radial": SourceKind(_METRES, _rotating_shift, _PER_TURN, needs_slope=True),
    "spindle_tilt": SourceKind(_RADIANS, _rotating_tilt, _PER_TURN),
    # The angle of C, which turns the reported points about the spindle.
    "c_error": SourceKind(
        _RADIANS,
        lambda p, own: p.height_change_of_shift(-p.y, p.x) * _phases(own["per_turn"] * p.c),
        _PER_TURN,
        needs_slope=True,
    ),
    "encoder_scale": SourceKind(_SHARE, lambda p, _: p.z),
    "encoder_interpolation": SourceKind(_METRES, lambda p, own: _periodic(p.z, own), _PERIOD),
    # The cube of the distance, one at the end of the range.
    "probe_linearity": SourceKind(
        _METRES,
        lambda p, own: (p.distance / own["half_range"]) ** 3,
        {"half_range": quantities.PERIOD},
    ),
    "probe_periodic": SourceKind(_METRES, lambda p, own: _periodic(p.distance, own), _PERIOD),
    # The slope in both directions, because the direction of the error is unknown.
    "probe_slope": SourceKind(
        quantities.SLOPE_ERROR, lambda p, _: _across_both(p, 1.0), needs_slope=True
    ),
    "probe_slope_square": SourceKind(
        quantities.SLOPE_ERROR, lambda p, _: np.sum(_along_both(p) ** 2, axis=0), needs_slope=True
    ),
    # Errors that grow with the time, walk, or are exponentially correlated.
    "drift_rate": SourceKind(quantities.RATE_UNCERTAINTY, lambda p, _: p.time),
    "drift_walk": SourceKind(
        quantities.WALK_UNCERTAINTY,
        lambda p, _: components(random_walk, p.time),
        squares=lambda p, _: p.time,
    ),
    "drift": SourceKind(
        _METRES,
        lambda p, own: components(fading(own["correlation_time"]), p.time),
        {"correlation_time": quantities.CORRELATION_TIME},
        squares=lambda p, _: np.ones(len(p)),
    ),
}
"""Kinds of systematic error by their names."""
