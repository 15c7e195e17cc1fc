"""What is the uncertainty of a scan made of? Every source, also those that nobody has looked at.

A source is *evaluated* from data, *declared* by somebody, or *not evaluated*: then its share is
not zero but unknown, and the budget says so.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from omsm_ros.core.calibration.calibration import (
    REJECTED,
    REMEDY,
    Calibration,
    latency_of,
    verdict_of,
)
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
from omsm_ros.readable import quantity

_RANDOM_DESCRIPTIONS = {each.name: each.metadata["says"] for each in fields(ErrorSources)} | {
    SCAN_SCATTER: "scatter of this scan beyond what is stated"
}
# The noise that a step test tells is that of encoder plus probe at rest: it holds these.
_HELD = ("probe_resolution", "encoder_noise", "encoder_resolution")
_BOUND_BY_NOISE = "held by probe_noise, which is the scatter of heights at rest"


@dataclass(frozen=True)
class BudgetRow:
    """One source.

    kind: "random", independent from point to point, or "systematic", common to the scan
    status: EVALUATED, DECLARED or NOT_EVALUATED;  reason: in words
    standard_uncertainty, unit: of the source;  height: what it does to the heights, rms over the
        scan without their mean [m];  both None where it was not evaluated
    """

    source: str
    says: str
    kind: str
    status: str
    standard_uncertainty: float | None
    unit: str
    height: float | None
    reason: str

    def entry(self) -> dict[str, Any]:
        """Return the JSON values of ``summary.json``."""
        return asdict(self)


@dataclass(frozen=True, eq=False, kw_only=True)
class ScanBudget:
    """All that is known of the errors of a scan.

    rows: one a source, random ones first
    points: that stand for the scan
    fields: by source, change of the heights of ``points`` per standard uncertainty [m], (k, n)
    random: standard uncertainty of one height from what is independent [m]
    seen: points of the whole scan
    bounds: names of the sources of which only an upper bound is known
    """

    rows: tuple[BudgetRow, ...]
    points: ScanPoints
    fields: Mapping[str, FloatArray]
    random: float
    seen: int
    bounds: tuple[str, ...]

    @property
    def systematic(self) -> float:
        """Standard uncertainty of the heights from what they share, rms over the scan [m]."""
        return float(np.sqrt(sum(size**2 for size in self.heights.values())))

    @property
    def heights(self) -> dict[str, float]:
        """What each systematic source does to the heights, rms [m]."""
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
    seen: int,
) -> ScanBudget:
    """Return the budget of a scan.

    sources: in force;  random: rms of the heights by each source of single points [m]
    trace: some points of ``seen``, with the slopes of the surface
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
        points=trace,
        fields=fields,
        random=noise,
        seen=seen,
        bounds=upper_bounds(calibration, stated),
    )


def _random_rows(
    calibration: Calibration,
    sources: ErrorSources,
    random: Mapping[str, float],
    stated: MachineSources,
) -> Iterator[BudgetRow]:
    at_rest = sources.probe_noise > 0 and not stated.of("probe_noise")
    for name in RANDOM:
        size, height = getattr(sources, name, 0.0), random.get(name)
        status, reason = NOT_EVALUATED, ""
        if name == SCAN_SCATTER and height is not None:
            size = height
            status, reason = EVALUATED, "from sample to sample of this scan"
        elif size or stated.of(name):
            status, reason = origin_of(name, calibration, stated)
        elif name in _HELD and at_rest:
            status, reason, size, height = EVALUATED, _BOUND_BY_NOISE, None, None
        elif height:
            status, reason, size = EVALUATED, "on the path of this scan", height
        else:
            size = height = None
        yield BudgetRow(
            name, _RANDOM_DESCRIPTIONS[name], "random", status, size, "m", height, reason
        )


def _systematic_rows(
    acting: Sequence[SystematicSource], fields: Mapping[str, FloatArray]
) -> Iterator[BudgetRow]:
    for name, kind in KINDS.items():
        alike = [source for source in acting if source.name == name]
        unit = kind.quantity.unit or "1"
        if not alike:
            yield BudgetRow(name, kind.says, "systematic", NOT_EVALUATED, None, unit, None, "")
            continue
        size = float(np.sqrt(sum(source.standard_uncertainty**2 for source in alike)))
        reason = "; ".join(dict.fromkeys(source.reason for source in alike))
        height = _height(fields[name]) if name in fields else None
        yield BudgetRow(name, kind.says, "systematic", alike[0].origin, size, unit, height, reason)


def _height(fields: FloatArray) -> float:
    """Return the rms of the heights without their mean [m], for fields (k, n)."""
    moved = fields - np.mean(fields, axis=1, keepdims=True)
    return float(np.sqrt(np.mean(np.sum(moved**2, axis=0)))) if moved.size else 0.0


# May these heights be relied on, to the accuracy asked for? Green, amber or red, with reasons.
#
# Green says that everything which can spoil a scan was looked at and is small enough; amber that
# something was not; red that something is known to be too large or wrong. Every reason names what
# can be done about it at the machine.

GREEN, AMBER, RED = "green", "amber", "red"

# A source this much smaller than what is asked for adds a twentieth to it in squares.
_SETTLED_SHARE = 1 / 3
# Light and texture of the part explain less than a fifth more of noise.
_NOISIER = 1.2
POSE = ("tilt", "decentre", "clocking")
# Of each group one statement will do: zero, with a reason, where it is known not to matter.
_GROUPS: Mapping[str, tuple[tuple[str, ...], str]] = {
    "drift": (
        ("drift", "drift_rate", "drift_walk"),
        "hold the probe on one place of the part for as long as the scan takes, or scan twice, "
        "and state drift, drift_rate or drift_walk",
    ),
    "centre of the spindle": (
        ("centre_x",),
        "scan a reference sphere, run 'omsm align', and state centre_x with its uncertainty",
    ),
    "spindle": (
        ("spindle_axial", "spindle_radial", "spindle_tilt"),
        "measure its error motion with a ball and a capacitive sensor, and state spindle_axial",
    ),
    "straightness of X": (
        ("straightness_x",),
        "scan an optical flat along X, and state straightness_x",
    ),
    "linearity of the probe": (
        ("probe_linearity", "probe_periodic"),
        "step Z through the probe's range on a flat, and state probe_linearity",
    ),
    "slope error of the probe": (
        ("probe_slope", "probe_slope_square"),
        "scan a reference sphere, and state probe_slope",
    ),
    "scale of Z": (
        ("encoder_scale",),
        "compare Z with a laser interferometer, or take it from the scale's certificate, and "
        "state encoder_scale",
    ),
    "vibration": (
        ("vibration",),
        "hold the probe on the axis of the turning part for some turns, and state vibration, the "
        "rms of what does not repeat with the turn",
    ),
    "change since the step test": (
        ("lag_change",),
        "repeat the step test after the scan, run 'omsm compare' on both, and state lag_change, "
        "by how much their lags differ",
    ),
    "pitch of Z": (
        ("pitch",),
        "measure it with an autocollimator along Z, give the arm in the geometry, and state pitch",
    ),
}


@dataclass(frozen=True)
class TrafficLightReason:
    """What stands against green;  remedy: what to do about it at the machine, or nothing."""

    what: str
    remedy: str = ""

    def __str__(self) -> str:
        return f"{self.what}: {self.remedy}" if self.remedy else self.what


@dataclass(frozen=True)
class TrafficLight:
    """level: GREEN, AMBER or RED;  word: for the reader;  reasons: all that speaks against green.

    accuracy: that it is held against, k = 2 [m];  uncertainty: of what all heights share, k = 2,
        rms over the scan [m]
    """

    level: str
    word: str
    accuracy: float
    uncertainty: float
    reasons: tuple[TrafficLightReason, ...]

    def entry(self) -> dict[str, Any]:
        """Return the JSON values of ``summary.json``."""
        return asdict(self)


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
    pose_open: sources of the part's pose that count; none where it is not compared with a nominal
        surface, or is fitted to it
    registered: whether others of the pose's freedoms are fitted to the nominal surface
    doubts: what else speaks against it
    """
    uncertainty = 2 * sum(size**2 for size in heights.values()) ** 0.5
    asked = uncertainty if accuracy is None else accuracy
    verdict, reasons = verdict_of(calibration)
    if verdict == REJECTED:
        found = [
            TrafficLightReason("the calibration was rejected", "identify again"),
            *map(TrafficLightReason, reasons),
        ]
        return _traffic_light(RED, calibration, asked, uncertainty, found)
    open_ = [
        *_latency(calibration, heights, accuracy),
        *_not_settled(stated, pose_open, registered),
    ]
    if not verdict:
        open_.insert(0, TrafficLightReason("the calibration has no certificate", "identify again"))
    if uncertainty > asked:
        largest = max(heights, key=lambda name: heights[name])
        too_large = TrafficLightReason(
            f"uncertainty {quantity(uncertainty, 'm')} (k = 2) exceeds the accuracy of "
            f"{quantity(asked, 'm')} asked for",
            f"begin with {largest.replace('_', ' ')}, which alone makes "
            + quantity(2 * heights[largest], "m"),
        )
        return _traffic_light(RED, calibration, asked, uncertainty, [too_large, *open_, *doubts])
    open_ += doubts
    return _traffic_light(AMBER if open_ else GREEN, calibration, asked, uncertainty, open_)


def excess_noise_reasons(budget: Mapping[str, float]) -> Iterator[TrafficLightReason]:
    """Yield a reason where readings scatter by more than is stated of them.

    budget: rms of the heights by each source [m]
    """
    variances = {name: budget.get(name, 0.0) ** 2 for name in RANDOM}
    beyond = variances.pop(SCAN_SCATTER)
    stated = sum(variances.values())
    if stated > 0 and stated + beyond > _NOISIER**2 * stated:
        yield TrafficLightReason(
            f"heights of this scan scatter by {quantity((stated + beyond) ** 0.5, 'm')}, "
            f"{quantity(stated**0.5, 'm')} by what is stated of single readings",
            "compare exposure, intensity and vibration with those of the step test; where the "
            "scan is as it should be, state probe_noise",
        )


def _traffic_light(
    level: str,
    calibration: Calibration,
    asked: float,
    uncertainty: float,
    reasons: list[TrafficLightReason],
) -> TrafficLight:
    supported = f"supported by data up to {quantity(calibration.valid_up_to, 'Hz')}"
    word = {
        GREEN: f"{supported}, to {quantity(asked, 'm')} (k = 2)",
        AMBER: f"{supported}, but not everything was looked at",
        RED: "not supported by data",
    }[level]
    return TrafficLight(level, word, asked, uncertainty, tuple(reasons))


def _latency(
    calibration: Calibration, heights: Mapping[str, float], accuracy: float | None
) -> Iterator[TrafficLightReason]:
    if latency_of(calibration).resolved:
        return
    share = 2 * heights.get("lateral_lag", 0.0)
    if accuracy is None or share > _SETTLED_SHARE * accuracy:
        what = (
            "any part of the lag may be latency of the probe, which makes "
            f"{quantity(share, 'm')} (k = 2)"
        )
        yield TrafficLightReason(what, REMEDY)


def _not_settled(
    stated: MachineSources, pose_open: Sequence[str], registered: bool
) -> Iterator[TrafficLightReason]:
    missing = [name for name in pose_open if not stated.of(name)]
    if missing:
        yield TrafficLightReason(
            f"pose of the part not evaluated ({', '.join(missing)})",
            "these are held; state them, or fit them too (--fit auto)"
            if registered
            else "register the part to its nominal surface (--fit auto, or 'omsm form'), or state "
            "them",
        )
    for group, (names, remedy) in _GROUPS.items():
        if not any(stated.of(name) for name in names):
            yield TrafficLightReason(f"{group} not evaluated", remedy)
