"""Which scans reach a wanted uncertainty? The covariance of an adjustment, before any data.

A design becomes a scan with few points a turn, each of which stands for many readings; the normal
equations are those of the adjustment (:mod:`network`), without heights.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from omsm_ros.core.adjustment.blocks import blocks_of
from omsm_ros.core.adjustment.families import (
    BEYOND_CENTRE,
    NEW_SPEED,
    OTHER_DIRECTION,
    OTHER_SPEED,
    RECLOCKED,
    REPEATED_TRACK,
    families_of,
    ranges_of,
)
from omsm_ros.core.adjustment.figures import (
    POSE,
    FormOf,
    effects_on_form,
    figure,
    largest_contribution,
    pv_of,
)
from omsm_ros.core.adjustment.network import Network, Scales, Solution, solve
from omsm_ros.core.adjustment.part_terms import START_POWER, part_model
from omsm_ros.core.adjustment.refutation import completed
from omsm_ros.core.adjustment.scan_data import ARRAYS, LEAST_POINTS, ScanData, view_of, zero_of
from omsm_ros.core.adjustment.sources import Contribution, Source, prior_sizes
from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.kinematics.trajectories import BEYOND
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.surface.aperture import within_aperture

# Points and turns of a design: sets with more turns are planned with fewer, each counting for
# more and the time running faster.
_POINTS_A_TURN, _MOST_TURNS = 96, 24
# Terms of a plan: what a form of finer detail adds is the same for all sets.
_DEGREE = 12
# Of a reading, a drift after a second, and a cell: where nothing is declared.
_NOISE_M, _WALK_M, _CELLS_M, _BAND_M = 12e-9, 1e-9, 1e-9, 5e-9
# Forms that are drawn for a plan, their rms, and the share of them that shall reach it: where a
# form has its peaks decides how certain its PV is, and how large they are hardly does.
_FORMS, _FORM_M, _SHARE = 40, 30e-9, 0.9
# Between two scans: the spindle is stopped, turned over, and the probe driven back.
_PAUSE_S = 20.0
# A speed like this is no other one; a third one lies between the first and twice the first.
_SAME_SPEED, _BETWEEN = 0.1, 0.75
# A third turn of the part would leave its third harmonics where they were.
_RECLOCKED_RAD = np.deg2rad(80.0)
_RANGE_M = 1e-5


@dataclass(frozen=True, kw_only=True)
class ScanDesign:
    """A spiral that could be scanned.

    rpm: spindle speed, with its sign;  start, end: slide x [m], beyond the axis negative
    pitch: feed a turn [m];  clocking: of the part [rad];  clamping: its number
    rate: readings a second [Hz]
    """

    rpm: float
    start: float
    end: float
    pitch: float
    clocking: float = 0.0
    clamping: int = 0
    rate: float = 1000.0

    @property
    def turns(self) -> float:
        """Turns of the spindle."""
        return abs(self.end - self.start) / self.pitch

    @property
    def duration(self) -> float:
        """Duration of the scan [s]."""
        return self.turns * 60 / abs(self.rpm)


@dataclass(frozen=True, eq=False)
class PlannedUncertainty:
    """Uncertainty that an adjustment of a set of scans will reach.

    pv: standard uncertainty of PV, its pose removed, of the form or that nine of ten reach [m]
    sources: of each family that takes part, standard uncertainty after the scans [unit]
    duration: of all scans and the pauses between them [s]
    largest: contribution to ``pv``, and what it may be for the accuracy asked for
    """

    pv: float
    sources: Mapping[str, FloatArray]
    duration: float
    largest: Contribution | None = None


class PlannedSet(NamedTuple):
    """A set of scans with what it reaches;  reaches: True if that is the wanted accuracy."""

    name: str
    designs: tuple[ScanDesign, ...]
    uncertainty: PlannedUncertainty
    reaches: bool


def posterior_uncertainty(
    designs: Sequence[ScanDesign],
    priors: Sequence[Source],
    nominal: Surface,
    removed: Sequence[str] = POSE,
    found: Solution | None = None,
    accuracy: float | None = None,
) -> PlannedUncertainty:
    """Return what ``designs``, adjusted together, will leave uncertain.

    priors: declared sources, ``noise`` [m] and ``drift_walk`` [m/√s] among them
    found: by scans of this part, else that of good ones;  accuracy: asked for, k = 2 [m], or None
    """
    scans, begin = [], 0.0
    shorter = max(1.0, max(d.turns for d in designs) / _MOST_TURNS)
    for design in designs:
        scans.append(design_scan(design, nominal, begin / shorter, design.turns / shorter))
        begin += design.duration + _PAUSE_S
    zero = zero_of(scans, nominal)
    views = [view_of(s, k, zero, nominal) for k, s in enumerate(scans)]
    ranges = ranges_of(views, priors, [s.clamping for s in scans])
    families = families_of(ranges, priors)
    sizes = prior_sizes(families, priors)
    # All is over sooner by ``shorter``: what grows with time has to grow faster.
    sizes["drift_rate"] *= shorter
    stated = {p.name: p.uncertainty for p in priors}
    noise, walk = stated.get("noise", _NOISE_M), stated.get("drift_walk", _WALK_M) ** 2
    cells, bands = _CELLS_M**2, dict[int, float]()
    if found is not None:
        noise, walk = float(np.mean(found.network.blocks.noise)), found.scales.walk
        cells, bands = found.scales.cells, dict(found.scales.bands)
    blocks = blocks_of(views, [s.weight for s in scans], families, noise)
    part = part_model(blocks, min(s.turns for s in scans), _DEGREE)
    scales = Scales(
        walk=walk * shorter,
        bands={int(d): bands.get(int(d), _BAND_M**2) for d in part.degrees},
        cells=cells,
        noise=np.ones(len(scans)),
    )
    solution = solve(Network(blocks, families, part), np.zeros(len(blocks)), scales, sizes)
    made = FormOf.of(completed(solution), nominal, removed)
    pv, height = _of_pv(made, found)
    effects = {} if accuracy is None else effects_on_form(made)
    return PlannedUncertainty(
        pv=pv,
        sources={f.name: solution.uncertainty(f.name) for f in families if f.name in sizes},
        duration=begin - _PAUSE_S,
        largest=largest_contribution(replace(made, height=height), effects, (), (), accuracy),
    )


def _of_pv(made: FormOf, known: Solution | None) -> tuple[float, FloatArray]:
    """Return the standard uncertainty of PV of the ``known`` form, or that ``_SHARE`` of all reach
    [m], and the form that has it (n,) [m]."""
    part, places = made.solution.network.part, made.places
    sizes = np.array([t.n ** (-START_POWER / 2) if t.n > 1 else 0.0 for t in part.terms])
    terms = part.values(places.x, places.y)[:, : len(sizes)] * sizes
    forms = made.free(terms @ np.random.default_rng(0).standard_normal((len(sizes), _FORMS)))
    forms *= _FORM_M / np.sqrt(places.area @ forms**2)
    if known is not None:
        forms = made.free(known.smooth_form(places.x, places.y)[:, np.newaxis])
    errors = made.free(made.errors()[0])
    found = np.array([figure(f, errors, pv_of).uncertainty for f in forms.T])
    reached = float(np.quantile(found, _SHARE))
    return reached, forms[:, np.argmin(np.abs(found - reached))]


def plan_scans(
    candidates: Mapping[str, tuple[ScanDesign, ...]],
    priors: Sequence[Source],
    nominal: Surface,
    accuracy: float,
) -> tuple[PlannedSet, ...]:
    """Return the sets of scans, the shortest that reaches ``accuracy`` [m] (k = 2) first.

    Those that do not reach it follow, the most accurate first, and single scans come last: nothing
    verifies them. If none does, the first one has its ``largest`` contribution.
    """

    def order(one: PlannedSet) -> tuple[bool, bool, float]:
        reached = one.uncertainty.duration if one.reaches else one.uncertainty.pv
        return len(one.designs) < 2, not one.reaches, reached

    found = []
    for name, designs in candidates.items():
        planned = posterior_uncertainty(designs, priors, nominal)
        found.append(PlannedSet(name, designs, planned, 2 * planned.pv <= accuracy))
    best, *others = sorted(found, key=order)
    if not best.reaches:
        planned = posterior_uncertainty(best.designs, priors, nominal, accuracy=accuracy)
        best = best._replace(uncertainty=planned)
    return best, *others


def usual_sets(first: ScanDesign) -> dict[str, tuple[ScanDesign, ...]]:
    """Return the sets to choose from, by name: ``single``, ``quick`` of two, ``full`` with more.

    first: a scan that the machine can make
    """
    other = additions(first)
    quick = (first, other[OTHER_SPEED])
    again = other[RECLOCKED]
    return {
        "single": (first,),
        "quick": quick,
        "quick_beyond": (first, other[BEYOND_CENTRE]),
        "full": (*quick, again),
        "full_beyond": (first, other[BEYOND_CENTRE], again),
        "full_4": (*quick, again, replace(again, clocking=first.clocking + 2.5 * _RECLOCKED_RAD)),
    }


def additions(first: ScanDesign) -> dict[str, ScanDesign]:
    """Return the scans that may be added to ``first``, by their codes.

    All but ``other_direction`` run back over the part at twice the speed, so that time and drift
    are separated from radius as well.
    """
    back = replace(first, start=first.end, end=first.start)
    fast = replace(back, rpm=2 * first.rpm)
    outer = max(first.start, first.end, key=abs)
    beyond = (-BEYOND * outer, outer)
    start, end = beyond if abs(first.start) > abs(first.end) else beyond[::-1]
    return {
        OTHER_SPEED: fast,
        OTHER_DIRECTION: replace(back, rpm=-first.rpm),
        RECLOCKED: replace(
            fast, clocking=first.clocking + _RECLOCKED_RAD, clamping=first.clamping + 1
        ),
        BEYOND_CENTRE: replace(fast, start=start, end=end),
        REPEATED_TRACK: back,
    }


def design_of(scan: ScanData) -> ScanDesign:
    """Return the design that ``scan`` followed, as far as it is a spiral."""
    start, end = ((scan.x + 1j * scan.y) * np.exp(1j * scan.c)).real[[0, -1]].tolist()
    return ScanDesign(
        rpm=scan.speed * 30 / np.pi,
        start=start,
        end=end,
        pitch=abs(end - start) / max(scan.turns, 1.0),
        clocking=scan.clocking,
        clamping=scan.clamping,
        rate=(len(scan) - 1) / scan.duration,
    )


def design_scan(design: ScanDesign, nominal: Surface, begin: float, shown: float) -> ScanData:
    """Return ``design`` as a scan of the nominal surface with few points.

    begin: when it begins [s];  shown: turns that stand for those of the design, at its speed
    """
    number = max(round(shown * _POINTS_A_TURN), 2 * LEAST_POINTS)  # some may be off the part
    share = np.arange(number) / number
    time = share * shown * 60 / abs(design.rpm)
    slide = design.start + (design.end - design.start) * share
    c = np.sign(design.rpm) * 2 * np.pi * shown * share
    chuck = slide * np.exp(-1j * c)
    part = chuck * np.exp(-1j * design.clocking)
    motion = nominal.height(part.real, part.imag)
    # Off the part the probe sees nothing.
    area = within_aperture(nominal, None)[1]
    seen = np.ones(number, bool) if area is None else area.holds(part.real, part.imag)
    # The probe is driven through some of its range on the way, else its scale would not show.
    distance = _RANGE_M * np.sin(2 * np.pi * 7 * share)
    channels = (begin + time, chuck.real, chuck.imag, motion, distance, motion, np.zeros(number), c)
    return ScanData(
        **{name: values[seen] for name, values in zip(ARRAYS, channels, strict=True)},
        clocking=design.clocking,
        clamping=design.clamping,
        weight=max(design.duration * design.rate / number, 1e-9),
    )


def best_addition(
    scans: Sequence[ScanData],
    priors: Sequence[Source],
    nominal: Surface,
    removed: Sequence[str],
    found: Solution | None = None,
) -> tuple[str, float]:
    """Return the code of the scan to add that helps most, and U (k = 2) of PV with it [m]."""
    designs = [design_of(scan) for scan in scans]
    added = additions(designs[0])
    del added[REPEATED_TRACK]  # leaves the set without redundancy
    other = added[OTHER_SPEED].rpm
    if any(abs(abs(d.rpm) - abs(other)) < _SAME_SPEED * abs(other) for d in designs):
        added[NEW_SPEED] = replace(added.pop(OTHER_SPEED), rpm=_BETWEEN * other)
    reached = {
        code: 2 * posterior_uncertainty([*designs, one], priors, nominal, removed, found).pv
        for code, one in added.items()
    }
    return min(reached.items(), key=lambda item: item[1])
