"""Compare two measurements of one part: match, subtract, test the agreement."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from omsm_ros.core.comparison.agreement import (
    ComparisonAgreement,
    MeasurementErrors,
    judge,
    root_mean_square,
)
from omsm_ros.core.comparison.matching import LATERAL, SEATED, Matched, match
from omsm_ros.core.comparison.resampling import LocalQuadratic, cell_side, occupied
from omsm_ros.core.comparison.stated_errors import (
    ESTIMATED,
    NOT_KNOWN,
    ComparedMeasurement,
    ComparisonSide,
    drift_size,
    errors_of,
)
from omsm_ros.core.surface.height_grid import HeightGrid
from omsm_ros.core.surface.measured_points import MeasuredPoints
from omsm_ros.errors import DataError, Notice
from omsm_ros.units import MICROMETRE_M, NANOMETRE_M

AGREE, DIFFER, CANNOT_TELL = "agree", "differ", "cannot tell"

# Significance level of the χ² test of all terms.
_LEAST_PROBABILITY = 0.01
# Significance level of the χ² test where a term has |E_n| > 1 as well.
_UNLIKELY = 0.05
# A single term or figure differs from this |E_n| on; between 1 and this it is undecided.
_CLEARLY_BEYOND = 1.25
# Share of the smaller area below which the figures describe different surfaces.
_LEAST_SHARED = 0.5
MOST_ACROSS = 200
"""Places across the map of a difference: thirty in half a wave of the sixth order."""
# A finer grid would take minutes, and only interpolate between means of the same cells.
_MOST_PLACES = (MOST_ACROSS + 1) ** 2
# Correlation length of errors of unknown form over the radius, for which most of their variance
# lies in the low-order terms that are compared.
_CORRELATED_SHARE = 0.5


def verdict_of(
    matched: Matched, agreement: ComparisonAgreement | None, unknown: tuple[Notice, ...],
    shared: float,
) -> tuple[str, tuple[Notice, ...]]:  # fmt: skip
    """Return AGREE, DIFFER or CANNOT_TELL, and the reasons, the most important first.

    agreement: None if the uncertainty of a measurement is not known;  unknown: the reasons
    shared: share of the smaller area that both cover
    """
    if shared < _LEAST_SHARED:
        unknown += (Notice("comparison.small_shared_area", shared=shared, least=_LEAST_SHARED),)
    if agreement is None or shared < _LEAST_SHARED:
        return CANNOT_TELL, unknown
    if differs := _differences(agreement):
        return DIFFER, differs
    if doubts := _undecided(matched, agreement):
        return CANNOT_TELL, doubts
    largest = agreement.largest
    least_certain = sorted(agreement.terms, key=lambda term: -term.expanded)[:3]
    undetected = tuple(
        Notice("comparison.expanded_of_term", expanded=t.expanded, term=(t.n, t.m))
        for t in least_certain
    )
    return AGREE, (
        Notice(
            "comparison.largest_term",
            count=len(agreement.terms),
            e_n=abs(largest.e_n),
            term=(largest.n, largest.m),
        ),
        Notice("comparison.probability", p=agreement.probability),
        Notice("comparison.area_within", share=agreement.within),
        Notice("comparison.undetected", terms=undetected),
    )


def _differences(found: ComparisonAgreement) -> tuple[Notice, ...]:
    largest, probability = found.largest, found.probability
    plainly = abs(largest.e_n) > _CLEARLY_BEYOND
    both = abs(largest.e_n) > 1 and probability < _UNLIKELY
    reasons = []
    if plainly or both:
        n_m, e_n = (largest.n, largest.m), largest.e_n
        size = {"difference": largest.difference, "expanded": largest.expanded, "e_n": e_n}
        reasons.append(Notice("comparison.term_differs", term=n_m, **size))
    if probability < _LEAST_PROBABILITY or both:
        reasons.append(Notice("comparison.improbable", p=probability))
    if found.farthest > _CLEARLY_BEYOND * found.allowed:
        x, y = found.at
        reasons.append(
            Notice(
                "comparison.place_differs", x=x, y=y, score=found.farthest, allowed=found.allowed
            )
        )
    reasons += [
        Notice("comparison.figure_differs", name=name, e_n=number.e_n)
        for name, number in found.figures.items()
        if number.e_n is not None and abs(number.e_n) > _CLEARLY_BEYOND and reasons
    ]
    return tuple(reasons)


def _undecided(matched: Matched, found: ComparisonAgreement) -> tuple[Notice, ...]:
    doubts = [
        Notice("comparison.term_undecided", term=(t.n, t.m), e_n=t.e_n)
        for t in found.terms
        if abs(t.e_n) > 1
    ]
    doubts += [
        Notice("comparison.figure_undecided", name=name, e_n=number.e_n)
        for name, number in found.figures.items()
        if number.e_n is not None and abs(number.e_n) > 1
    ]
    deviation = matched.without_fit(np.stack([matched.a, matched.b]))
    compared = float(np.max(root_mean_square(deviation)))
    # The median, because an uncertain pose affects two or three terms only.
    usual = float(np.median([term.expanded for term in found.terms]))
    if usual > compared:
        doubts.append(Notice("comparison.uncertainty_too_large", expanded=usual, compared=compared))
    return tuple(doubts)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SideSummary:
    """Properties of one measurement in the comparison, lengths [m].

    scatter: of a point about its neighbours
    sources: rms over the places of each systematic error, by source; None: not known
    drift: largest standard deviation;  drift_from: origin of its size
    interpolation: upper bound of the rms error between the points;  cell: of the local fits
    """

    name: str
    points: int
    scatter: float
    sources: dict[str, float] | None
    drift: float
    drift_from: str
    interpolation: float
    cell: float


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Comparison:
    """Result of a comparison.

    matched: both at the same places;  agreement: None if an uncertainty is not known
    shared: share of the smaller area that both cover
    length: correlation length of errors of unknown form [m]
    common: sources of an error that both have in common
    verdict: AGREE, DIFFER or CANNOT_TELL;  reasons: the most important first
    reservations: assumptions in addition to the stated uncertainties
    """

    matched: Matched
    sides: tuple[SideSummary, SideSummary]
    agreement: ComparisonAgreement | None
    shared: float
    length: float
    common: tuple[str, ...]
    verdict: str
    reasons: tuple[Notice, ...]
    reservations: tuple[Notice, ...]


def compare_measurements_of_part(
    a: ComparedMeasurement, b: ComparedMeasurement, dofs: Sequence[str] = SEATED,
    spacing: float | None = None, length: float | None = None,
) -> Comparison:  # fmt: skip
    """Compare two measurements of one part, the second moved onto the first by ``dofs``.

    spacing: of the places [m], None: as the coarser of both allows
    length: correlation length of errors of unknown form [m], None: half the radius

    Raises DataError for measurements that hardly overlap, or cover no area.
    """
    cells = [cell_side(m.points.x, m.points.y, MOST_ACROSS) for m in (a, b)]
    side = spacing or max(cells)
    first, second = (
        LocalQuadratic(m.points, max(c, side)) for m, c in zip((a, b), cells, strict=True)
    )
    matched = match(first, second, _places(a.points, b.points, side), dofs)
    halves = (
        ComparisonSide(a, first, matched.from_a, matched.x, matched.y,
             first.method_error(matched.x, matched.y)),
        ComparisonSide(b, second, matched.from_b, matched.b_x, matched.b_y,
             second.method_error(matched.b_x, matched.b_y)),
    )  # fmt: skip
    reach = length or _CORRELATED_SHARE * float(max(np.ptp(matched.x), np.ptp(matched.y))) / 2
    (one, other), common = errors_of(halves, matched, reach)
    agreement = None
    if one is not None and other is not None:
        agreement = judge(matched, (one, other), common)
    unknown = tuple(
        Notice("comparison.no_uncertainty", name=half.measurement.name)
        for half, errors in zip(halves, (one, other), strict=True)
        if errors is None
    )
    sides = (_side(halves[0], one, agreement), _side(halves[1], other, agreement))
    own = min(occupied(half.points.x, half.points.y, side) for half in (a, b))
    shared = min(float(np.sum(matched.filled)) / own, 1.0)
    verdict, reasons = verdict_of(matched, agreement, unknown, shared)
    return Comparison(
        matched=matched, sides=sides, agreement=agreement, shared=shared, length=reach,
        common=common, verdict=verdict, reasons=reasons,
        reservations=_reservations(sides, matched),
    )  # fmt: skip


def _places(a: MeasuredPoints, b: MeasuredPoints, side: float) -> HeightGrid:
    low = [max(float(v.min()), float(w.min())) for v, w in ((a.x, b.x), (a.y, b.y))]
    high = [min(float(v.max()), float(w.max())) for v, w in ((a.x, b.x), (a.y, b.y))]
    if low[0] >= high[0] or low[1] >= high[1]:
        raise DataError("comparison.no_overlap")
    counts = [int((h - c) / side) + 1 for c, h in zip(low, high, strict=True)]
    if max(counts) > _MOST_PLACES or counts[0] * counts[1] > _MOST_PLACES:
        raise DataError(
            "comparison.too_many_places", spacing=side, columns=counts[0], rows=counts[1],
            most=_MOST_PLACES,
        )  # fmt: skip
    x0, y0 = (c + (h - c) % side / 2 for c, h in zip(low, high, strict=True))
    return HeightGrid(height=np.zeros(counts[::-1]), x0=x0, y0=y0, dx=side, dy=side)


def _side(
    half: ComparisonSide, errors: MeasurementErrors | None, agreement: ComparisonAgreement | None
) -> SideSummary:
    sources = None
    if errors is not None:
        sources = {
            name: float(np.sqrt(np.mean(np.sum(rows**2, axis=0))))
            for name, rows in errors.shapes.items()
        }
    m = half.measurement
    estimated = m.drift_from == ESTIMATED and agreement is None
    return SideSummary(
        name=m.name, points=len(m.points), scatter=half.surface.scatter, sources=sources,
        drift=drift_size(errors), drift_from=NOT_KNOWN if estimated else m.drift_from,
        interpolation=half.interpolation, cell=half.surface.cell,
    )  # fmt: skip


def _reservations(sides: tuple[SideSummary, SideSummary], matched: Matched) -> tuple[Notice, ...]:
    found: tuple[Notice, ...] = ()
    drifts = [side.drift for side in sides if side.drift_from == ESTIMATED]
    if any(drifts):
        found = (Notice("comparison.drift_estimated", drift=max(drifts)),)
    if fitted := [name for name in LATERAL if name in matched.dofs]:
        found += (Notice("comparison.moves_fitted", names=fitted),)
    found += _lateral_shift(matched)
    return found + tuple(
        Notice("comparison.not_fitted", name=name, reason=why)
        for name, why in matched.refused.items()
    )


def _lateral_shift(matched: Matched) -> tuple[Notice, ...]:
    """Return the effect of a lateral shift of a micrometre between whole heights."""
    there = matched.from_b
    each = {"x": there.slope_x, "y": there.slope_y}
    slopes = [slope for name, slope in each.items() if name not in matched.dofs]
    if not slopes:
        return ()
    left = matched.without_fit(np.stack(slopes))
    opened = MICROMETRE_M * float(np.sqrt(np.max(np.mean(left**2, axis=1))))
    if opened < NANOMETRE_M:
        return ()
    height = float(np.ptp(matched.a))
    return (Notice("comparison.whole_heights", height=height, shift=MICROMETRE_M, rms=opened),)
