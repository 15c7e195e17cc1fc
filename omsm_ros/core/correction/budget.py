"""Uncertainty budget of a scan, and the traffic light that compares it with the accuracy asked for.

A source is *evaluated* from data, *declared*, or *not evaluated*; then its contribution is unknown,
not zero. The light is green if all sources are known and small enough. It is amber if a source is
not evaluated, and red if the uncertainty is too large or the calibration was rejected.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.calibration.certificate import REJECTED
from omsm_ros.core.correction.machine_sources import (
    RANDOM,
    MachineSources,
    origin_of,
    upper_bounds,
    whole_scan_sources,
)
from omsm_ros.core.correction.source_kinds import KINDS
from omsm_ros.core.correction.systematic import (
    EVALUATED,
    NOT_EVALUATED,
    ScanPoints,
    SystematicSource,
    standard_fields,
)
from omsm_ros.core.correction.uncertainty import SCAN_SCATTER, ErrorSources
from omsm_ros.core.kinematics.kinematics import Geometry
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import Notice

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
    rows = [
        *_random_rows(calibration, sources, random, stated),
        *_systematic_rows(acting, fields),
    ]
    noise = float(np.sqrt(sum(random.get(name, 0.0) ** 2 for name in RANDOM)))
    return ScanBudget(
        rows=tuple(rows),
        fields=fields,
        random=noise,
        bounds=upper_bounds(calibration, stated),
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


GREEN, AMBER, RED = "green", "amber", "red"

# A source below a third of the accuracy adds a twentieth to it in squares.
_NEGLIGIBLE_SHARE = 1 / 3
# Scatter of a scan by the light and texture of the part stays below this factor.
_NOISIER = 1.2
POSE = ("tilt", "decentre", "clocking")
# Groups of systematic sources; one of each group has to be stated, as zero if it does not matter.
_GROUPS: Mapping[str, tuple[str, ...]] = {
    "drift": ("drift", "drift_rate", "drift_walk"),
    "centre": ("centre_x",),
    "spindle": ("spindle_axial", "spindle_radial", "spindle_tilt"),
    "straightness": ("straightness_x",),
    "linearity": ("probe_linearity", "probe_periodic"),
    "slope_error": ("probe_slope", "probe_slope_square"),
    "z_scale": ("encoder_scale",),
    "vibration": ("vibration",),
    "lag_change": ("lag_change",),
    "z_pitch": ("pitch",),
}


@dataclass(frozen=True)
class TrafficLightReason:
    """A reason against green, and its remedy at the machine, if there is one."""

    what: str | Notice
    remedy: str | Notice = ""

    def __str__(self) -> str:
        return f"{self.what}: {self.remedy}" if self.remedy else str(self.what)


def _reason(subject: str, remedy: str = "", **values: object) -> TrafficLightReason:
    """Return the reason with the codes ``correction.subject`` and, for the remedy, ``…_remedy``."""
    remedy = f"correction.{remedy or subject}_remedy"
    return TrafficLightReason(Notice(f"correction.{subject}", **values), Notice(remedy, **values))


@dataclass(frozen=True)
class TrafficLight:
    """Traffic light of a scan.

    level: GREEN, AMBER or RED;  word: its summary;  reasons: all that speaks against green
    accuracy: asked for, k = 2 [m];  uncertainty: of the heights from systematic sources, k = 2,
        rms over the scan [m]
    """

    level: str
    word: Notice
    accuracy: float
    uncertainty: float
    reasons: tuple[TrafficLightReason, ...]

    def entry(self) -> dict[str, Any]:
        """Return the JSON values of ``summary.json``."""
        reasons = [{"what": str(r.what), "remedy": str(r.remedy)} for r in self.reasons]
        return {**vars(self), "word": str(self.word), "reasons": reasons}


def traffic_light_of(
    calibration: Calibration,
    heights: Mapping[str, float],
    stated: MachineSources,
    *,
    accuracy: float | None = None,
    pose_open: Sequence[str] = POSE,
    registered: bool = False,
    doubts: Iterable[TrafficLightReason] = (),
) -> TrafficLight:
    """Return the light of a scan.

    heights: standard uncertainty of the heights from each systematic source, rms [m]
    accuracy: asked for, k = 2 [m]; None takes the uncertainty that is stated
    pose_open: sources of the part's pose that matter; none if the scan is not compared with a
        nominal surface, or is fitted to it
    registered: True if other parameters of the pose are fitted
    doubts: further reasons against green
    """
    uncertainty = 2 * sum(size**2 for size in heights.values()) ** 0.5
    asked = uncertainty if accuracy is None else accuracy
    certificate = calibration.certificate
    reasons: list[TrafficLightReason] = []
    level = RED
    if certificate.verdict == REJECTED:
        rejections = (TrafficLightReason(str(reason)) for reason in certificate.reasons)
        reasons += [_reason("rejected", "identify"), *rejections]
    else:
        if uncertainty > asked:
            largest = max(heights, key=lambda name: heights[name])
            values = {"uncertainty": uncertainty, "accuracy": asked}
            reasons.append(
                _reason("too_large", largest=largest, part=2 * heights[largest], **values)
            )
        if certificate.verdict is None:
            reasons.append(_reason("no_certificate", "identify"))
        reasons += _latency(calibration, heights, accuracy)
        reasons += _not_evaluated(stated, pose_open, registered)
        reasons += doubts
        if uncertainty <= asked:
            level = AMBER if reasons else GREEN
    word = Notice(f"correction.{level}", valid_up_to=calibration.valid_up_to, accuracy=asked)
    return TrafficLight(level, word, asked, uncertainty, tuple(reasons))


def excess_noise_reasons(budget: Mapping[str, float]) -> Iterator[TrafficLightReason]:
    """Yield a reason if the readings scatter by more than their stated sources.

    budget: rms of the heights by each source [m]
    """
    variances = {name: budget.get(name, 0.0) ** 2 for name in RANDOM}
    beyond = variances.pop(SCAN_SCATTER)
    stated = sum(variances.values())
    if stated > 0 and stated + beyond > _NOISIER**2 * stated:
        yield _reason("noisier", scatter=(stated + beyond) ** 0.5, stated=stated**0.5)


def _latency(
    calibration: Calibration, heights: Mapping[str, float], accuracy: float | None
) -> Iterator[TrafficLightReason]:
    share = 2 * heights.get("probe_latency", 0.0)
    resolved = calibration.latency.resolved
    if not resolved and (accuracy is None or share > _NEGLIGIBLE_SHARE * accuracy):
        yield _reason("latency", uncertainty=share)


def _not_evaluated(
    stated: MachineSources, pose_open: Sequence[str], registered: bool
) -> Iterator[TrafficLightReason]:
    missing = [name for name in pose_open if not stated.of(name)]
    if missing:
        yield _reason("pose", "pose_fitted" if registered else "pose", missing=missing)
    for group, names in _GROUPS.items():
        if not any(stated.of(name) for name in names):
            yield _reason(group)
