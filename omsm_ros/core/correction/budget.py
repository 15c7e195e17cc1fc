"""What is the uncertainty of a scan made of? Every source, also those that nobody has looked at.

A source is *evaluated* from data, *declared* by somebody, or *not evaluated*: then its share is
not zero but unknown, and the budget says so.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

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
from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.machine.kinematics import Geometry
from omsm_ros.core.samples.blocks import FloatArray

_RANDOM_SAYS = {each.name: each.metadata["says"] for each in fields(ErrorSources)} | {
    SCAN_SCATTER: "scatter of this scan beyond what is stated"
}
# The noise that a step test tells is that of encoder plus probe at rest: it holds these.
_HELD = ("probe_resolution", "encoder_noise", "encoder_resolution")
_HELD_BY_NOISE = "held by probe_noise, which is the scatter of heights at rest"


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
            status, reason, size, height = EVALUATED, _HELD_BY_NOISE, None, None
        elif height:
            status, reason, size = EVALUATED, "on the path of this scan", height
        else:
            size = height = None
        yield BudgetRow(name, _RANDOM_SAYS[name], "random", status, size, "m", height, reason)


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
