"""Two measurements of one part: matched, subtracted, judged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from omsm_ros.core.comparison.agreement import (
    ComparisonAgreement,
    MeasurementErrors,
    judge,
    root_mean_square,
)
from omsm_ros.core.comparison.matching import SEATED, Matched, match
from omsm_ros.core.comparison.resampling import LocalQuadratic, cell_side
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
from omsm_ros.errors import DataError
from omsm_ros.readable import count, figure, p_value_text, percent, plain, quantity
from omsm_ros.units import MICROMETRE_M, NANOMETRE_M

# Agree, differ, or cannot tell; and why.

AGREE, DIFFER, CANNOT_TELL = "agree", "differ", "cannot tell"

# Of pairs that agree one in a hundred may look as unlikely.
_LEAST_PROBABILITY = 0.01
# A term beyond one, which of pairs that agree one in twenty has, and all terms as unlikely as that.
_UNLIKELY = 0.05
# What is beyond one but not by this is as well chance as a difference.
_CLEARLY_BEYOND = 1.25
# Of the smaller area: of less, the figures are those of another part.
_LEAST_SHARED = 0.5


@dataclass(frozen=True, slots=True)
class ComparisonVerdict:
    """verdict: AGREE, DIFFER or CANNOT_TELL;  reasons: for it, the weightiest first
    reservations: what it rests on beside the stated uncertainties
    """

    verdict: str
    reasons: tuple[str, ...]
    reservations: tuple[str, ...]


def verdict_of(
    matched: Matched,
    agreement: ComparisonAgreement | None,
    unknown: tuple[str, ...],
    shared: float,
    reservations: tuple[str, ...],
) -> ComparisonVerdict:
    """Return the verdict.

    agreement: None if the uncertainty of a measurement is not known;  unknown: why
    shared: of the smaller area, the share that both cover
    """
    if shared < _LEAST_SHARED:
        unknown += (f"they share {percent(shared)} of the smaller area, expected 50 % or more",)
    if agreement is None or shared < _LEAST_SHARED:
        return ComparisonVerdict(CANNOT_TELL, unknown, reservations)
    differs = _differences(agreement)
    if differs:
        return ComparisonVerdict(DIFFER, differs, reservations)
    doubts = _reservation_texts(matched, agreement)
    if doubts:
        return ComparisonVerdict(CANNOT_TELL, doubts, reservations)
    largest = agreement.largest
    return ComparisonVerdict(
        AGREE,
        (
            f"all {len(agreement.terms)} Zernike terms: the largest |E_n| is "
            f"{plain(abs(largest.e_n))}, of {_named(largest.n, largest.m)}",
            f"a difference like theirs or larger: {p_value_text(agreement.probability)}",
            f"|E_n| < 1 on {percent(agreement.within, 3)} of the area",
            "what may differ unseen, term by term: up to " + _most_uncertain_terms(agreement),
        ),
        reservations,
    )


def _most_uncertain_terms(found: ComparisonAgreement) -> str:
    """Return the terms of the largest uncertainty, with it."""
    terms = sorted(found.terms, key=lambda term: -term.expanded)[:3]
    return ", ".join(f"{quantity(t.expanded, 'm')} of {_named(t.n, t.m)}" for t in terms)


def _differences(found: ComparisonAgreement) -> tuple[str, ...]:
    largest, probability = found.largest, found.probability
    plainly = abs(largest.e_n) > _CLEARLY_BEYOND
    both = abs(largest.e_n) > 1 and probability < _UNLIKELY
    reasons = []
    if plainly or both:
        reasons.append(
            f"{_named(largest.n, largest.m)} differs by {quantity(largest.difference, 'm')} "
            f"where {quantity(largest.expanded, 'm')} are explained: E_n = {plain(largest.e_n)}"
        )
    if probability < _LEAST_PROBABILITY or both:
        reasons.append(
            f"all terms together: {p_value_text(probability)} if only the stated errors were there"
        )
    if found.farthest > _CLEARLY_BEYOND * found.allowed:
        x, y = (quantity(place, "m") for place in found.at)
        reasons.append(
            f"at x = {x}, y = {y} they differ by {plain(found.farthest)} standard "
            f"uncertainties, where {plain(found.allowed)} are the most to expect of all places"
        )
    reasons += [
        f"{figure(name)}: E_n = {plain(number.e_n)}"
        for name, number in found.figures.items()
        if number.e_n is not None and abs(number.e_n) > _CLEARLY_BEYOND and reasons
    ]
    return tuple(reasons)


def _reservation_texts(matched: Matched, found: ComparisonAgreement) -> tuple[str, ...]:
    beyond = {_named(t.n, t.m): t.e_n for t in found.terms if abs(t.e_n) > 1}
    beyond |= {
        figure(name): number.e_n
        for name, number in found.figures.items()
        if number.e_n is not None and abs(number.e_n) > 1
    }
    doubts = [
        f"{name} has E_n = {plain(value)}, too little beyond 1 to tell"
        for name, value in beyond.items()
    ]
    deviation = matched.without_fit(np.stack([matched.a, matched.b]))
    compared = float(np.max(root_mean_square(deviation)))
    # Of half the terms: a pose that is hardly known leaves two or three open, and tells the others.
    usual = float(np.median([term.expanded for term in found.terms]))
    if usual > compared:
        doubts.append(
            f"half of the terms have an uncertainty of {quantity(usual, 'm')} or more, more "
            f"than all that is compared, {quantity(compared, 'm')} rms; measure with less"
        )
    return tuple(doubts)


_NAMES = {
    (2, 0): "power",
    (2, 2): "astigmatism",
    (2, -2): "oblique astigmatism",
    (3, 1): "coma in x",
    (3, -1): "coma in y",
    (3, 3): "trefoil",
    (3, -3): "oblique trefoil",
    (4, 0): "spherical aberration",
}


def _named(n: int, m: int) -> str:
    term = f"Z({n}, {m})"
    return f"{_NAMES[n, m]} {term}" if (n, m) in _NAMES else term


MOST_ACROSS = 200
"""Places across the map of a difference: thirty in half a wave of the sixth order."""
# Finer places would cost minutes, and lie between means of the same cells.
_MOST_PLACES = (MOST_ACROSS + 1) ** 2

# Of the radius: an error of a form that nobody knows is correlated over it, which makes most of
# it the terms of low order that a comparison looks at.
_CORRELATED_SHARE = 0.5


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SideSummary:
    """What a measurement brought to the comparison, lengths [m].

    scatter: of a point about its neighbours
    sources: rms over the places of each systematic error, by source; None: not known
    drift: standard deviation where it is largest;  drift_from: who knows it
    interpolation: rms error between the points, from above;  cell: of the local fits
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
    """matched: both at the same places;  agreement: None if an uncertainty is not known
    shared: of the smaller area, the share that both cover
    length: over which errors of unknown form are taken for correlated [m]
    common: sources of one and the same error in both
    """

    matched: Matched
    sides: tuple[SideSummary, SideSummary]
    agreement: ComparisonAgreement | None
    shared: float
    length: float
    common: tuple[str, ...]
    verdict: ComparisonVerdict


def compare_measurements_of_part(
    a: ComparedMeasurement,
    b: ComparedMeasurement,
    dofs: Sequence[str] = SEATED,
    spacing: float | None = None,
    length: float | None = None,
) -> Comparison:
    """Compare two measurements of one part, the second moved onto the first by ``dofs``.

    spacing: of the places [m], None: as the coarser of both allows
    length: over which errors of unknown form are correlated [m], None: half the radius

    Raises DataError where they share too little, or are no areas.
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
        f"{half.measurement.name} carries no uncertainty; state it, as --uncertainty 5e-9"
        for half, errors in zip(halves, (one, other), strict=True)
        if errors is None
    )
    sides = (_side(halves[0], one, agreement), _side(halves[1], other, agreement))
    shared = _shared(a.points, b.points, matched, side)
    reservations = _reservations(sides, matched)
    return Comparison(
        matched=matched,
        sides=sides,
        agreement=agreement,
        shared=shared,
        length=reach,
        common=common,
        verdict=verdict_of(matched, agreement, unknown, shared, reservations),
    )


def _places(a: MeasuredPoints, b: MeasuredPoints, side: float) -> HeightGrid:
    """Return a grid over what both may cover."""
    low = [max(float(v.min()), float(w.min())) for v, w in ((a.x, b.x), (a.y, b.y))]
    high = [min(float(v.max()), float(w.max())) for v, w in ((a.x, b.x), (a.y, b.y))]
    if low[0] >= high[0] or low[1] >= high[1]:
        raise DataError(
            "the two measurements do not overlap; do they lie in one frame, and in one unit?"
        )
    counts = [int((h - c) / side) + 1 for c, h in zip(low, high, strict=True)]
    if max(counts) > _MOST_PLACES or counts[0] * counts[1] > _MOST_PLACES:
        raise DataError(
            f"a spacing of {quantity(side, 'm')} makes {counts[0]:.4g} × {counts[1]:.4g} places, "
            f"expected {count(_MOST_PLACES)} at most, which is as fine as points are resampled; "
            "widen it"
        )
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
        name=m.name,
        points=len(m.points),
        scatter=half.surface.scatter,
        sources=sources,
        drift=drift_size(errors),
        drift_from=NOT_KNOWN if estimated else m.drift_from,
        interpolation=half.interpolation,
        cell=half.surface.cell,
    )


def _reservations(sides: tuple[SideSummary, SideSummary], matched: Matched) -> tuple[str, ...]:
    found: tuple[str, ...] = ()
    drifts = [side.drift for side in sides if side.drift_from == ESTIMATED]
    if any(drifts):
        found = (
            f"nobody states the drift: what of the difference goes with the time of a scan, up to "
            f"{quantity(max(drifts), 'm', 2)}, is taken for it; a true difference of that form, "
            "as rings or power of a spiral scan, is not seen; state it, as --drift 20e-9",
        )
    lateral_dofs = [name for name in ("x", "y", "clocking") if name in matched.dofs]
    if lateral_dofs:
        found += (
            f"{', '.join(lateral_dofs)} were fitted: a true difference that looks like such a move is "
            "not seen",
        )
    found += _steepness_warning(matched)
    return found + tuple(f"{name} was not fitted: {why}" for name, why in matched.refused.items())


def _steepness_warning(matched: Matched) -> tuple[str, ...]:
    """Return what a small shift between the two would do to heights that are steep."""
    there = matched.from_b
    each = {"x": there.slope_x, "y": there.slope_y}
    slopes = [slope for name, slope in each.items() if name not in matched.dofs]
    if not slopes:
        return ()
    left = matched.without_fit(np.stack(slopes))
    opened = MICROMETRE_M * float(np.sqrt(np.max(np.mean(left**2, axis=1))))
    if opened < NANOMETRE_M:
        return ()
    height = quantity(float(np.ptp(matched.a)), "m")
    return (
        f"whole heights were compared, of {height} PV: where one part lies a micrometre beside the "
        f"other they differ by {quantity(opened, 'm', 2)} rms; to compare deviations, each in the "
        "frame of its part, give --nominal SURFACE.yaml --register auto",
    )


def _shared(a: MeasuredPoints, b: MeasuredPoints, matched: Matched, side: float) -> float:
    """Return the share of the smaller area that both cover [1]."""
    both = float(np.sum(matched.filled)) * side**2
    return min(both / min(_area(points, side) for points in (a, b)), 1.0)


def _area(points: MeasuredPoints, side: float) -> float:
    """Return the area that the points cover [m²], by cells of ``side`` that hold any."""
    column, row = (np.floor(v / side).astype(np.int64) for v in (points.x, points.y))
    cells = np.unique((column - column.min()) * (int(np.ptp(row)) + 1) + row - row.min())
    return len(cells) * side**2
