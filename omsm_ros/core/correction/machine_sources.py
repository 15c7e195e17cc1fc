"""What is uncertain of this machine, and who says so?

One statement a source: its size, whether it was evaluated from data or declared, and why. Sources
of single readings go into ``ErrorSources``; those that act on the whole scan have fields.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields

from omsm_ros.core.calibration.calibration import Calibration, latency_of
from omsm_ros.core.calibration.calibration_set import CalibrationSet
from omsm_ros.core.correction.source_kinds import KINDS, source_of
from omsm_ros.core.correction.systematic import DECLARED, EVALUATED, SystematicSource
from omsm_ros.core.correction.uncertainty import SCAN_SCATTER, ErrorSources, covariance_parts
from omsm_ros.core.kinematics.kinematics import Geometry
from omsm_ros.errors import ConfigurationError
from omsm_ros.quantities import UNCERTAINTY, shown

# From a half-width or an amplitude to a standard uncertainty (GUM, 4.3).
DISTRIBUTIONS = {"normal": 1.0, "uniform": 1 / math.sqrt(3.0), "arcsine": 1 / math.sqrt(2.0)}

POINT_SOURCES = tuple(field.name for field in fields(ErrorSources))
# These are uncertain of each point, and of all points together.
_ALSO_SYSTEMATIC = ("static_gain", "lateral_lag", "motion_error", "pitch")
_OF_CALIBRATION = ("dynamics", "could_hide")
# What somebody can state of single readings, and all that is independent from point to point.
_STATED_RANDOM = tuple(name for name in POINT_SOURCES if name not in _ALSO_SYSTEMATIC)
RANDOM = (*_STATED_RANDOM, SCAN_SCATTER)
SYSTEMATIC = tuple(KINDS)
NAMES = (*_STATED_RANDOM, *SYSTEMATIC)


@dataclass(frozen=True, kw_only=True)
class StatedSource:
    """What somebody says of one source.

    source: one of ``NAMES`` but those that come from a calibration alone
    value: standard uncertainty; of a uniform distribution its half-width, of an arcsine (a wave
        of unknown phase) its amplitude
    how: EVALUATED from data or DECLARED;  reason: in words;  parameters: of its kind
    """

    source: str
    value: float
    how: str = DECLARED
    reason: str
    distribution: str = "normal"
    parameters: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        allowed = [name for name in NAMES if name not in _OF_CALIBRATION]
        if self.source not in allowed:
            raise ConfigurationError(
                f"uncertainty {shown(self.source)} is unknown, expected one of {sorted(allowed)}"
            )
        for name, value, known in (
            ("how", self.how, (EVALUATED, DECLARED)),
            ("distribution", self.distribution, tuple(DISTRIBUTIONS)),
        ):
            if value not in known:
                raise ConfigurationError(
                    f"{self.source}: {name} is {shown(value)}, expected one of {', '.join(known)}"
                )
        if not self.reason.strip():
            raise ConfigurationError(f"{self.source} needs a reason: say where the figure is from")
        if self.source in POINT_SOURCES:
            ErrorSources(**{self.source: self.standard_uncertainty})
            if set(self.parameters) - {"correlation_length"}:
                raise ConfigurationError(f"{self.source} has no parameter {[*self.parameters]}")
        else:
            self.systematic()

    @property
    def standard_uncertainty(self) -> float:
        """In the unit of the source, k = 1."""
        return self.value * DISTRIBUTIONS[self.distribution]

    def systematic(self) -> SystematicSource:
        """Return it as a source with fields."""
        return source_of(
            self.source, self.standard_uncertainty, self.how, self.reason, self.parameters
        )


@dataclass(frozen=True)
class MachineSources:
    """All that is stated of a machine; a name may stand more than once if it is systematic."""

    stated: tuple[StatedSource, ...] = ()

    def __post_init__(self) -> None:
        names = [stated.source for stated in self.stated if stated.source in POINT_SOURCES]
        for name in names:
            if names.count(name) > 1:
                raise ConfigurationError(
                    f"{name} is stated {names.count(name)} times; state it once"
                )

    def of(self, name: str) -> tuple[StatedSource, ...]:
        """Return what is stated of the source ``name``."""
        return tuple(stated for stated in self.stated if stated.source == name)

    def point_uncertainties(self) -> dict[str, float]:
        """Return standard uncertainties of single points, fields of ``ErrorSources`` by name."""
        return {
            stated.source: stated.standard_uncertainty
            for stated in self.stated
            if stated.source in POINT_SOURCES
        }

    def scan_sources(self) -> tuple[SystematicSource, ...]:
        """Return the systematic sources that neither a calibration nor a point has."""
        return tuple(s.systematic() for s in self.stated if s.source not in POINT_SOURCES)


NOTHING_STATED = MachineSources()


def declared_sources(sizes: Mapping[str, object]) -> MachineSources:
    """Return standard uncertainties declared by name, without further parameters."""
    stated = []
    for name, size in sizes.items():
        quantity = KINDS[name].quantity if name in KINDS else UNCERTAINTY
        value = quantity.checked(size, ConfigurationError, name)
        stated.append(StatedSource(source=name, value=value, reason="declared without a reason"))
    return MachineSources(tuple(stated))


def whole_scan_sources(
    calibration: Calibration, points: ErrorSources, geometry: Geometry, stated: MachineSources
) -> tuple[SystematicSource, ...]:
    """Return every source that acts on the whole scan: the calibration's, and what is stated."""
    found = []
    members = calibration.members if isinstance(calibration, CalibrationSet) else (calibration,)
    for name, part in zip(_OF_CALIBRATION, (0, 1), strict=True):
        if any(covariance_parts(member)[part].covariance.any() for member in members):
            reason = "covariance of the calibration"
            found.append(source_of(name, 1.0, EVALUATED, reason, {}))
    parameters: dict[str, Mapping[str, float]] = {
        "static_gain": {"gain": calibration.static_gain},
        "pitch": {"arm": geometry.abbe_arm},
    }
    for name in _ALSO_SYSTEMATIC:
        if size := getattr(points, name):
            how, reason = origin_of(name, calibration, stated)
            found.append(source_of(name, size, how, reason, parameters.get(name, {})))
    return (*found, *stated.scan_sources())


def upper_bounds(calibration: Calibration, stated: MachineSources) -> tuple[str, ...]:
    """Return the names of the sources of which it is known how large they are at most.

    A step test that does not show a term says how large it could be; where nothing divides the
    lag, any part of it could be latency. Neither need be there at all.
    """
    open_lag = not latency_of(calibration).resolved and not stated.of("lateral_lag")
    return ("could_hide", "lateral_lag") if open_lag else ("could_hide",)


def origin_of(name: str, calibration: Calibration, stated: MachineSources) -> tuple[str, str]:
    """Return whether a source of single points was evaluated or declared, and why."""
    if said := stated.of(name):
        return said[0].how, said[0].reason
    if name == "lateral_lag":
        latency = latency_of(calibration)
        return EVALUATED if latency.source != "declared" else DECLARED, latency.reason
    return EVALUATED, "certificate of the calibration"
