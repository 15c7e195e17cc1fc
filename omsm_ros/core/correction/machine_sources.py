"""Statements about the sources of uncertainty of a machine, and what they make of a scan.

A statement gives the size of a source, whether it was evaluated from data or declared, and why.
Sources of single readings become ``ErrorSources``; those of the whole scan ``SystematicSource``.

In the budget of a scan a source is *evaluated* from data, *declared*, *assumed* in the size that
the adjustment assumes, or *not evaluated*; then its contribution is unknown, not zero.
"""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.calibration.calibration_set import CalibrationSet
from omsm_ros.core.correction.source_kinds import (
    FORMER_NAMES,
    KINDS,
    SystematicSource,
    standard_fields,
)
from omsm_ros.core.correction.systematic import (
    ASSUMED,
    DECLARED,
    EVALUATED,
    NOT_EVALUATED,
    ScanPoints,
)
from omsm_ros.core.correction.uncertainty import SCAN_SCATTER, ErrorSources, covariance_parts
from omsm_ros.core.kinematics.kinematics import Geometry
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import ConfigurationError, Notice
from omsm_ros.quantities import UNCERTAINTY, shown

# From a half-width or an amplitude to a standard uncertainty (GUM, 4.3).
DISTRIBUTIONS = {"normal": 1.0, "uniform": 1 / math.sqrt(3.0), "arcsine": 1 / math.sqrt(2.0)}

POINT_SOURCES = tuple(field.name for field in fields(ErrorSources))
# Sources of single readings that are also common to all points.
_ALSO_SYSTEMATIC = ("static_gain", "probe_latency", "motion_error", "pitch")
OF_CALIBRATION = ("dynamics", "undetected_model_error")
# Sources of single readings that can be stated, and all that are independent between points.
_STATED_RANDOM = tuple(name for name in POINT_SOURCES if name not in _ALSO_SYSTEMATIC)
RANDOM = (*_STATED_RANDOM, SCAN_SCATTER)
SYSTEMATIC = tuple(KINDS)
NAMES = (*_STATED_RANDOM, *SYSTEMATIC)


# Words that name no measurement.
_NO_MEASUREMENT = {"none", "nothing", "unknown", "assumed", "assumption", "guess", "guessed"}


@dataclass(frozen=True, kw_only=True)
class StatedSource:
    """Statement about one source.

    source: one of ``NAMES`` except those that come from a calibration alone
    value: standard uncertainty; half-width of a uniform distribution, amplitude of an arcsine
        distribution (a wave of unknown phase)
    how: EVALUATED from data, DECLARED or ASSUMED;  reason: where the value comes from
    parameters: of its kind;  evaluation: recording, date and command, where they are stated apart
    """

    source: str
    value: float
    how: str = DECLARED
    reason: str
    distribution: str = "normal"
    parameters: Mapping[str, float] = field(default_factory=dict)
    evaluation: str = ""

    def __post_init__(self) -> None:
        allowed = [name for name in NAMES if name not in OF_CALIBRATION]
        if self.source not in allowed:
            raise ConfigurationError(
                "correction.source", source=shown(self.source), known=sorted(allowed)
            )
        for name, value, known in (
            ("how", self.how, (EVALUATED, DECLARED, ASSUMED)),
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
            own = {"correlation_length"} | ({"arm"} if self.source == "pitch" else set())
            if set(self.parameters) - own:
                raise ConfigurationError(
                    "correction.no_parameter", source=self.source, parameters=self.parameters
                )
        if self.source not in POINT_SOURCES or "arm" in self.parameters:
            self.systematic()

    @property
    def origin(self) -> str:
        """``how``, but DECLARED for an evaluation that does not say from what."""
        words = re.findall(r"[^\W\d_]{3,}", f"{self.reason} {self.evaluation}".lower())
        unsaid = self.how == EVALUATED and _NO_MEASUREMENT.issuperset(words)
        return DECLARED if unsaid else self.how

    @property
    def standard_uncertainty(self) -> float:
        """Standard uncertainty in the unit of the source, k = 1."""
        return self.value * DISTRIBUTIONS[self.distribution]

    def systematic(self) -> SystematicSource:
        """Return the source with its sensitivity fields."""
        return SystematicSource(
            self.source, self.standard_uncertainty, self.origin, self.reason, self.parameters
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

    @property
    def abbe_arm(self) -> float:
        """Arm that is stated with the pitch of Z [m], 0 without one."""
        return next((s.parameters.get("arm", 0.0) for s in self.of("pitch")), 0.0)

    def scan_sources(self) -> tuple[SystematicSource, ...]:
        """Return the stated sources of the whole scan."""
        return tuple(s.systematic() for s in self.stated if s.source not in POINT_SOURCES)


NOTHING_STATED = MachineSources()
# Sources that one scan cannot show, with the size that the adjustment of scans assumes.
ASSUMED_SIZES = {"lag_change": 1e-4, "drift_rate": 1e-9}


def with_assumed(stated: MachineSources) -> MachineSources:
    """Return ``stated`` with the sources that act in every scan, assumed where nothing is stated.

    Without them the uncertainty of one scan would contain no change since the step test.
    """
    assumed = tuple(
        StatedSource(source=name, value=size, how=ASSUMED, reason="a plausible size")
        for name, size in ASSUMED_SIZES.items()
        if not stated.of(name)
    )
    return MachineSources((*stated.stated, *assumed))


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
    for name, part in zip(OF_CALIBRATION, (0, 1), strict=True):
        between = len(members) > 1 and part == 0  # members of a set differ in their response
        if between or any(covariance_parts(member)[part].covariance.any() for member in members):
            reason = Notice("correction.from_covariance")
            found.append(SystematicSource(name, 1.0, EVALUATED, reason))
    parameters: dict[str, Mapping[str, float]] = {
        "static_gain": {"gain": calibration.static_gain},
        "pitch": {"arm": geometry.abbe_arm},
    }
    for name in _ALSO_SYSTEMATIC:
        if size := getattr(points, name):
            how, reason = origin_of(name, calibration, stated)
            found.append(SystematicSource(name, size, how, reason, parameters.get(name, {})))
    return (*found, *stated.scan_sources())


def upper_bounds(calibration: Calibration, stated: MachineSources) -> tuple[str, ...]:
    """Return the names of the sources of which only an upper bound is known, and which may be zero.

    These are the model error that the step test cannot detect, assumed sources and, without a test
    of the latency, the lag.
    """
    assumed = (said.source for said in stated.stated if said.how == ASSUMED)
    open_lag = not calibration.latency.resolved and not stated.of("probe_latency")
    return ("undetected_model_error", *assumed, *(["probe_latency"] if open_lag else []))


def origin_of(
    name: str, calibration: Calibration, stated: MachineSources
) -> tuple[str, str | Notice]:
    """Return EVALUATED or DECLARED for a source of single points, and the reason."""
    if said := stated.of(name):
        return said[0].origin, said[0].reason
    if name == "probe_latency":
        latency = calibration.latency
        if not latency.resolved:
            return EVALUATED, Notice("correction.latency_in_lag")
        return EVALUATED if latency.source != "declared" else DECLARED, latency.reason
    return EVALUATED, Notice("correction.from_certificate")


# The noise found by a step test is that of heights at standstill, which includes these sources.
_IN_NOISE = ("probe_resolution", "encoder_noise", "encoder_resolution")


@dataclass(frozen=True)
class BudgetRow:
    """One source of uncertainty.

    kind: "random", independent from point to point, or "systematic", common to the scan
    status: EVALUATED, DECLARED or NOT_EVALUATED;  reason: where the figure comes from
    standard_uncertainty, unit: of the source;  height: standard uncertainty of the heights from
        it, rms over the scan without their mean [m];  both None if not evaluated
    """

    source: str
    kind: str
    status: str
    standard_uncertainty: float | None
    unit: str
    height: float | None
    reason: str | Notice

    def entry(self) -> dict[str, Any]:
        """Return the JSON values of ``summary.json``."""
        says = str(Notice(f"correction.source_{self.source}"))
        return {**vars(self), "says": says, "reason": str(self.reason)}


@dataclass(frozen=True, eq=False, kw_only=True)
class ScanBudget:
    """Uncertainty budget of a scan.

    rows: one for each source, random ones first
    fields: by source, change of the heights of the traced points per standard uncertainty [m],
        (k, n)
    random: standard uncertainty of one height from independent sources [m]
    bounds: names of the sources of which only an upper bound is known
    """

    rows: tuple[BudgetRow, ...]
    fields: Mapping[str, FloatArray]
    random: float
    bounds: tuple[str, ...]

    @property
    def systematic(self) -> float:
        """Standard uncertainty of the heights from systematic sources, rms over the scan [m]."""
        return float(np.sqrt(sum(size**2 for size in self.heights.values())))

    @property
    def heights(self) -> dict[str, float]:
        """Standard uncertainty of the heights from each systematic source, rms [m]."""
        return {name: _height(fields) for name, fields in self.fields.items()}

    def entry(self) -> dict[str, Any]:
        """Return the JSON values of ``summary.json``."""
        return {
            "random": self.random,
            "systematic": self.systematic,
            "sources": [row.entry() for row in self.rows],
        }


def scan_budget(
    calibration: Calibration,
    sources: ErrorSources,
    random: Mapping[str, float],
    geometry: Geometry,
    stated: MachineSources,
    trace: ScanPoints,
) -> ScanBudget:
    """Return the budget of a scan.

    sources: those used in the correction;  random: rms of the heights by each source of single
        points [m];  trace: points that represent the scan, with the slopes of the surface
    """
    acting = whole_scan_sources(calibration, sources, geometry, stated)
    fields = standard_fields(acting, trace) if len(trace) else {}
    rows = [*_random_rows(calibration, sources, random, stated), *_systematic_rows(acting, fields)]
    noise = float(np.sqrt(sum(random.get(name, 0.0) ** 2 for name in RANDOM)))
    return ScanBudget(
        rows=tuple(rows), fields=fields, random=noise, bounds=upper_bounds(calibration, stated)
    )


def _random_rows(
    calibration: Calibration,
    sources: ErrorSources,
    random: Mapping[str, float],
    stated: MachineSources,
) -> Iterator[BudgetRow]:
    from_test = sources.probe_noise > 0 and not stated.of("probe_noise")
    for name in RANDOM:
        size, height = getattr(sources, name, 0.0), random.get(name)
        status: str = NOT_EVALUATED
        reason: str | Notice = ""
        if name == SCAN_SCATTER and height is not None:
            size = height
            status, reason = EVALUATED, Notice("correction.from_samples")
        elif size or stated.of(name):
            status, reason = origin_of(name, calibration, stated)
        elif name in _IN_NOISE and from_test:
            size = height = None
            status, reason = EVALUATED, Notice("correction.in_probe_noise")
        elif height:
            status, reason, size = EVALUATED, Notice("correction.from_path"), height
        else:
            size = height = None
        yield BudgetRow(name, "random", status, size, "m", height, reason)


def _systematic_rows(
    acting: Sequence[SystematicSource], fields: Mapping[str, FloatArray]
) -> Iterator[BudgetRow]:
    for name, kind in KINDS.items():
        alike = [source for source in acting if source.name == name]
        unit = kind.quantity.unit or "1"
        if not alike:
            yield BudgetRow(name, "systematic", NOT_EVALUATED, None, unit, None, "")
            continue
        size = float(np.sqrt(sum(source.standard_uncertainty**2 for source in alike)))
        reason = "; ".join(dict.fromkeys(str(source.reason) for source in alike))
        height = _height(fields[name]) if name in fields else None
        yield BudgetRow(name, "systematic", alike[0].origin, size, unit, height, reason)


def _height(fields: FloatArray) -> float:
    """Return the rms of the heights without their mean [m], for fields (k, n)."""
    moved = fields - np.mean(fields, axis=1, keepdims=True)
    return float(np.sqrt(np.mean(np.sum(moved**2, axis=0)))) if moved.size else 0.0


# Scatter of a scan by the light and texture of the part stays below this factor.
_NOISIER = 1.2


def excess_noise(budget: Mapping[str, float]) -> Notice | None:
    """Return that the readings scatter by more than their stated sources; None if they do not.

    budget: rms of the heights by each source [m]
    """
    variances = {name: budget.get(name, 0.0) ** 2 for name in RANDOM}
    beyond = variances.pop(SCAN_SCATTER)
    stated = sum(variances.values())
    if not stated > 0 or stated + beyond <= _NOISIER**2 * stated:
        return None
    scatter = (stated + beyond) ** 0.5
    return Notice("correction.noisier", scatter=scatter, stated=stated**0.5)
