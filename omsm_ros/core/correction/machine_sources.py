"""Statements about the sources of uncertainty of a machine.

A statement gives the size of a source, whether it was evaluated from data or declared, and why.
Sources of single readings become ``ErrorSources``; those of the whole scan ``SystematicSource``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.calibration.calibration_set import CalibrationSet
from omsm_ros.core.correction.source_kinds import FORMER_NAMES, KINDS, source_of
from omsm_ros.core.correction.systematic import DECLARED, EVALUATED, SystematicSource
from omsm_ros.core.correction.uncertainty import SCAN_SCATTER, ErrorSources, covariance_parts
from omsm_ros.core.kinematics.kinematics import Geometry
from omsm_ros.errors import ConfigurationError, Notice
from omsm_ros.quantities import UNCERTAINTY, shown

# From a half-width or an amplitude to a standard uncertainty (GUM, 4.3).
DISTRIBUTIONS = {"normal": 1.0, "uniform": 1 / math.sqrt(3.0), "arcsine": 1 / math.sqrt(2.0)}

POINT_SOURCES = tuple(field.name for field in fields(ErrorSources))
# Sources of single readings that are also common to all points.
_ALSO_SYSTEMATIC = ("static_gain", "probe_latency", "motion_error", "pitch")
_OF_CALIBRATION = ("dynamics", "undetected_model_error")
# Sources of single readings that can be stated, and all that are independent between points.
_STATED_RANDOM = tuple(name for name in POINT_SOURCES if name not in _ALSO_SYSTEMATIC)
RANDOM = (*_STATED_RANDOM, SCAN_SCATTER)
SYSTEMATIC = tuple(KINDS)
NAMES = (*_STATED_RANDOM, *SYSTEMATIC)


@dataclass(frozen=True, kw_only=True)
class StatedSource:
    """Statement about one source.

    source: one of ``NAMES`` except those that come from a calibration alone
    value: standard uncertainty; half-width of a uniform distribution, amplitude of an arcsine
        distribution (a wave of unknown phase)
    how: EVALUATED from data or DECLARED;  reason: where the value comes from
    parameters: of its kind
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
                "correction.source", source=shown(self.source), known=sorted(allowed)
            )
        for name, value, known in (
            ("how", self.how, (EVALUATED, DECLARED)),
            ("distribution", self.distribution, tuple(DISTRIBUTIONS)),
        ):
            if value not in known:
                raise ConfigurationError(
                    "correction.choice",
                    source=self.source,
                    name=name,
                    value=shown(value),
                    known=known,
                )
        if not self.reason.strip():
            raise ConfigurationError("correction.no_reason", source=self.source)
        if self.source in POINT_SOURCES:
            ErrorSources(**{self.source: self.standard_uncertainty})
            if set(self.parameters) - {"correlation_length"}:
                raise ConfigurationError(
                    "correction.no_parameter", source=self.source, parameters=self.parameters
                )
        else:
            self.systematic()

    @property
    def standard_uncertainty(self) -> float:
        """Standard uncertainty in the unit of the source, k = 1."""
        return self.value * DISTRIBUTIONS[self.distribution]

    def systematic(self) -> SystematicSource:
        """Return the source with its sensitivity fields."""
        return source_of(
            self.source, self.standard_uncertainty, self.how, self.reason, self.parameters
        )


@dataclass(frozen=True)
class MachineSources:
    """All statements about a machine; a systematic source may have more than one."""

    stated: tuple[StatedSource, ...] = ()

    def __post_init__(self) -> None:
        names = [stated.source for stated in self.stated if stated.source in POINT_SOURCES]
        for name in names:
            if names.count(name) > 1:
                raise ConfigurationError(
                    "correction.stated_twice", source=name, times=names.count(name)
                )

    def of(self, name: str) -> tuple[StatedSource, ...]:
        """Return the statements about the source ``name``."""
        return tuple(stated for stated in self.stated if stated.source == name)

    def point_uncertainties(self) -> dict[str, float]:
        """Return standard uncertainties of single points, fields of ``ErrorSources`` by name."""
        return {
            stated.source: stated.standard_uncertainty
            for stated in self.stated
            if stated.source in POINT_SOURCES
        }

    def scan_sources(self) -> tuple[SystematicSource, ...]:
        """Return the stated sources of the whole scan."""
        return tuple(s.systematic() for s in self.stated if s.source not in POINT_SOURCES)


NOTHING_STATED = MachineSources()


def declared_sources(sizes: Mapping[str, object]) -> MachineSources:
    """Return standard uncertainties declared by name, without further parameters."""
    stated = []
    for given, size in sizes.items():
        name = FORMER_NAMES.get(given, given)
        quantity = KINDS[name].quantity if name in KINDS else UNCERTAINTY
        value = quantity.checked(size, ConfigurationError, name)
        stated.append(StatedSource(source=name, value=value, reason="declared without a reason"))
    return MachineSources(tuple(stated))


def whole_scan_sources(
    calibration: Calibration, points: ErrorSources, geometry: Geometry, stated: MachineSources
) -> tuple[SystematicSource, ...]:
    """Return all sources that act on the whole scan, of the calibration and as stated."""
    found = []
    reason: str | Notice
    members = calibration.members if isinstance(calibration, CalibrationSet) else (calibration,)
    for name, part in zip(_OF_CALIBRATION, (0, 1), strict=True):
        if any(covariance_parts(member)[part].covariance.any() for member in members):
            reason = Notice("correction.from_covariance")
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
    """Return the names of the sources of which only an upper bound is known, and which may be zero.

    These are the model error that the step test cannot detect and, without a test of the latency,
    the lag.
    """
    open_lag = not calibration.latency.resolved and not stated.of("probe_latency")
    return ("undetected_model_error", "probe_latency") if open_lag else ("undetected_model_error",)


def origin_of(
    name: str, calibration: Calibration, stated: MachineSources
) -> tuple[str, str | Notice]:
    """Return EVALUATED or DECLARED for a source of single points, and the reason."""
    if said := stated.of(name):
        return said[0].how, said[0].reason
    if name == "probe_latency":
        latency = calibration.latency
        return EVALUATED if latency.source != "declared" else DECLARED, latency.reason
    return EVALUATED, Notice("correction.from_certificate")
