"""Adjust scans of one part together: form, errors of the machine, and what is contradicted."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from omsm_ros.core.adjustment.agreement import ScanAgreement, agreement_of
from omsm_ros.core.adjustment.blocks import block_columns, blocks_of, node_means
from omsm_ros.core.adjustment.disturbances import dust_of, follows_removed, lines_of, steps_of
from omsm_ros.core.adjustment.evidence import evidence_of
from omsm_ros.core.adjustment.families import families_of, ranges_of
from omsm_ros.core.adjustment.figures import (
    NO_EFFECT,
    POSE,
    Effect,
    FormMap,
    FormOf,
    effects_on_form,
    form_map,
    largest_contribution,
)
from omsm_ros.core.adjustment.network import Network, Scales, Solution, solve
from omsm_ros.core.adjustment.part_terms import part_model
from omsm_ros.core.adjustment.planning import best_addition
from omsm_ros.core.adjustment.refutation import (
    MODEL_SHARE,
    Doubt,
    Refutation,
    completed,
    fit_and_refute,
    settled,
    start_scales,
    walk_deviate,
)
from omsm_ros.core.adjustment.scan_data import (
    ScanData,
    ScanView,
    Zero,
    fitted_surface,
    play,
    view_of,
    zero_of,
)
from omsm_ros.core.adjustment.sources import Family, Source, base_name, prior_sizes, with_dynamics
from omsm_ros.core.adjustment.verdict import (
    WRONG_SENSE,
    Reason,
    Verdict,
    looks_like,
    not_evaluated,
    open_limit,
    reasons_of,
    redundant,
    rests_on,
    verdict_of,
)
from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import DataError

# Enough for lines and steps to stand out; they are tested after the scales have settled.
_FIRST_STEPS = 2
# A backlash is found from the one that was assumed; 5 % of it are 5 % of the shape at a reversal.
_PLAY, _PLAY_STEPS, _SAME_PLAY = "motion_error", 3, 0.05
# Points at a time of corrected heights.
_CHUNK = 16_384


@dataclass(frozen=True, eq=False)
class SourceFinding:
    """One family: declared against found.

    name, unit: of the family;  declared: standard uncertainty [unit], None where nothing was
    found, uncertainty: by the adjustment, each component (size,) [unit]; of a family that takes
        no part, by its score test
    effect, effect_uncertainty: rms of what was found on the heights, and its standard uncertainty
        [m];  possible: of what is left open on the form, k = 1 [m]
    shown: True if the scans determine it, else ``shown_by`` would
    deviate: of found from declared, in standard deviations
    refuted: True if released;  alike: families that explain the same
    """

    name: str
    unit: str
    declared: float | None
    found: FloatArray
    uncertainty: FloatArray
    effect: float
    effect_uncertainty: float
    possible: float
    shown: bool
    shown_by: str
    deviate: float
    refuted: bool
    alike: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Adjustment:
    """Scans of one part, adjusted together.

    form: map of the form error, figures and covariance
    sources: each family, declared against found;  refutations: in the order of their evidence
    agreement: each scan against the others;  wrong_sign: scan, and the share that it follows
    verdict: may the heights be relied on
    scales: noise, drift and form below the terms, estimated;  noise: of a reading, each scan [m]
    solution: parameters, covariance, residuals
    zero: from where times, heights and distances count
    """

    form: FormMap
    sources: tuple[SourceFinding, ...]
    refutations: tuple[Refutation, ...]
    agreement: tuple[ScanAgreement, ...]
    wrong_sign: tuple[tuple[int, float], ...]
    verdict: Verdict
    scales: Scales
    noise: FloatArray
    solution: Solution
    nominal: Surface
    zero: Zero

    def source(self, name: str) -> SourceFinding:
        """Return the finding of family ``name``.

        Raises KeyError for a family that the scans cannot have.
        """
        for finding in self.sources:
            if finding.name == name:
                return finding
        raise KeyError(name)

    @property
    def drift_walk(self) -> float:
        """Standard deviation of the drift after one second [m/√s]."""
        return float(np.sqrt(self.scales.walk))


def adjust(
    scans: Sequence[ScanData],
    priors: Sequence[Source] = (),
    *,
    calibration: Calibration | None = None,
    nominal: Surface | None = None,
    accuracy: float | None = None,
    removed: Sequence[str] = POSE,
    accepted: Collection[str] = (),
) -> Adjustment:
    """Return ``scans`` of one part, adjusted together by least squares with priors.

    Parameters
    ----------
    scans
        One or more. Redundancy, and with it a green verdict, needs two that differ in speed or
        direction.
    priors
        Declared sources. Families without one take part by their default, or once they show.
    calibration
        That corrected the heights: its uncertainty is a prior of the lag, and what a rejected one
        corrected is not valid. None: an exact one.
    nominal
        Surface in the part frame; None: a polynomial of degree 8 through the first scan, of which
        the form error then is the deviation.
    accuracy
        Asked for, k = 2 [m]; None: none.
    removed
        Pose that is taken from the form error: ``piston``, ``tip``, ``tilt``, ``x``, ``y``,
        ``clocking``.
    accepted
        Names of families whose found value somebody has accepted: they refute no more.

    Raises
    ------
    DataError
        For no scan, and for a scan that is no spiral.
    ConfigurationError
        For a declared source that is no family of the adjustment.
    """
    _check_spirals(scans)
    surface: Surface = fitted_surface(scans[0]) if nominal is None else nominal
    if calibration is not None:
        priors = with_dynamics(priors, calibration)
    zero = zero_of(scans, surface)
    views = [view_of(s, k, zero, surface) for k, s in enumerate(scans)]
    views, dust, first = _without_dust(scans, views, priors)
    detecting, refutations, doubts = _with_its_play(first, views, priors)
    del first  # Its normal equations have 100 MiB.
    solution, families = completed(detecting, refutations), detecting.network.families
    made = FormOf.of(solution, surface, removed)
    effects = effects_on_form(made)
    form = form_map(made, doubts, effects)
    # The zero of the heights was taken off before the fit, and belongs to the piston.
    piston = zero.height * (np.array(removed) == "piston")
    form = replace(form, pose=form.pose + piston, dust=dust)
    agreement = agreement_of(solution, surface, removed)
    wrong = _wrong_signs(views)
    enough, stated = redundant(scans), {p.name for p in priors}
    walk, least = _walk(detecting, priors), MODEL_SHARE * form.rms.value
    # A source that nobody evaluated counts in full, whatever the form resembles.
    known = np.sqrt(form.mean_uncertainty**2 - sum(size**2 for _, size in form.resembled))
    reasons = reasons_of(refutations, stated, agreement, wrong, walk, accepted, least)
    verdict = verdict_of(
        _or_sense_of_c(reasons, scans, priors, surface, refutations),
        not_evaluated(families, effects, priors, accuracy, 2 * known)
        + looks_like(form.resembled, families, accepted, open_limit(accuracy)),
        rests_on(families, effects, form.mean_uncertainty, _mirrored(scans, surface, form)),
        enough, 2 * form.pv.uncertainty, accuracy,
        partial(best_addition, scans, priors, surface, removed, solution),
        calibration,
        largest_contribution(made, effects, doubts, form.alike, accuracy),
    )  # fmt: skip
    return Adjustment(
        form=form,
        sources=_findings(detecting, effects, priors, refutations),
        refutations=refutations, agreement=agreement, wrong_sign=wrong, verdict=verdict,
        scales=solution.scales, noise=solution.network.blocks.noise,
        solution=solution, nominal=surface, zero=zero,
    )  # fmt: skip


def _check_spirals(scans: Sequence[ScanData]) -> None:
    if not scans:
        raise DataError("no scan to adjust; give one or more scans of one part")
    for number, scan in enumerate(scans, 1):
        if not scan.is_spiral:
            width = float(np.ptp(np.hypot(scan.x, scan.y)))
            raise DataError("adjustment.no_spiral", scan=number, turns=scan.turns, width=width)


def _without_dust(
    scans: Sequence[ScanData], views: list[ScanView], priors: Sequence[Source]
) -> tuple[list[ScanView], FloatArray, Solution]:
    """Return ``views`` without dust, how far it is off (d,) [m], and a first solution."""
    first = _started(_network(scans, views, priors), priors)
    dust = dust_of(first, views)
    away = np.concatenate([heights for _, heights in dust])
    if len(away):
        views = [v.part(np.setdiff1d(np.arange(len(v)), points))
                 for v, (points, _) in zip(views, dust, strict=True)]  # fmt: skip
        first = _started(_network(scans, views, priors), priors)
    return views, away, first


def _with_its_play(
    first: Solution, views: Sequence[ScanView], priors: Sequence[Source]
) -> tuple[Solution, tuple[Refutation, ...], tuple[Doubt, ...]]:
    """Return the solution with a backlash as wide as it is found, where the scans refute any.

    If they do not refute it more surely by that, it is an error of the direction without a width.
    """
    found, assumed, network = _fitted(first, views, priors), 0.0, first.network
    families = [f for f in network.families if f.name == _PLAY]
    for _ in range(_PLAY_STEPS):
        half = _play_of(found[0], assumed)
        if not found[1] or half == assumed:
            break
        assumed, views = half, [replace(v, motion_play=play(v.motion, half)) for v in views]
        column = np.concatenate([node_means(v, families) for v in views])
        larger = _fitted(_started(network.with_column(_PLAY, column), priors), views, priors)
        if _of_play(larger[1]) < _of_play(found[1]):
            break
        found = larger
    return found


def _of_play(refutations: Sequence[Refutation]) -> float:
    """Return the gain of the backlash among what was refuted."""
    return sum(r.evidence.gain for r in refutations if r.name == _PLAY)


def _play_of(solution: Solution, assumed: float) -> float:
    """Return half the backlash that is found [m]; ``assumed`` if it is not another one."""
    family = next(f for f in solution.network.families if f.name == _PLAY)
    evidence = evidence_of(solution, family)
    half, unsure = abs(float(evidence.values[0])), 3 * float(evidence.uncertainty[0])
    another = abs(half - assumed) > max(unsure, _SAME_PLAY * half) and half > unsure
    return half if another else assumed


def _walk(solution: Solution, priors: Sequence[Source]) -> tuple[float, float]:
    """Return the drift found after one second [m], and how far it is beyond the declared one.

    A declared drift that fades may move by its whole size within a second.
    """
    stated, found = {p.name: p.uncertainty for p in priors}, float(np.sqrt(solution.scales.walk))
    if "drift_walk" not in stated:
        return found, 0.0
    allowed = float(np.hypot(stated["drift_walk"], stated.get("drift", 0.0)))
    return found, walk_deviate(solution, allowed)


def _network(
    scans: Sequence[ScanData], views: Sequence[ScanView], priors: Sequence[Source]
) -> Network:
    families = families_of(ranges_of(views, priors, [s.clamping for s in scans]), priors)
    blocks = blocks_of(views, [s.weight for s in scans], families)
    return Network(blocks, families, part_model(blocks, min(s.turns for s in scans)))


def _started(network: Network, priors: Sequence[Source]) -> Solution:
    """Return the solution by declarations and defaults, its scales nearly settled."""
    walk = {p.name: p.uncertainty for p in priors}.get("drift_walk")
    sizes, y = prior_sizes(network.families, priors), network.blocks.deviation
    return settled(solve(network, y, start_scales(network, walk), sizes), _FIRST_STEPS)


def _fitted(
    first: Solution, views: Sequence[ScanView], priors: Sequence[Source]
) -> tuple[Solution, tuple[Refutation, ...], tuple[Doubt, ...]]:
    """Return the solution, lines and steps of the residuals among its families."""
    network = first.network
    extra: list[Family] = []
    for view in views:
        extra += lines_of(first, view)
        extra += steps_of(first, view.index)
    if extra:
        network = network.with_families(extra, block_columns(views, extra))
    sizes = {**first.sizes, **prior_sizes(extra, priors)}
    return fit_and_refute(network, first.y, first.scales, sizes)


def _wrong_signs(views: Sequence[ScanView]) -> tuple[tuple[int, float], ...]:
    """Return scan and share of each, if all scans follow what was removed alike."""
    shares = [follows_removed(view) for view in views]
    found = [(v.index, s) for v, s in zip(views, shares, strict=True) if s is not None]
    return tuple(found) if len(found) == len(views) else ()


def _or_sense_of_c(
    reasons: tuple[Reason, ...], scans: Sequence[ScanData], priors: Sequence[Source],
    surface: Surface, refutations: Sequence[Refutation],
) -> tuple[Reason, ...]:  # fmt: skip
    """Return ``reasons``, or the sense of C alone, if the scans agree where C has the other one.

    Only a part that was turned on the chuck distinguishes it from its mirror image.
    """
    if all(r.minor for r in refutations) or len({s.clocking for s in scans}) == 1:
        return reasons
    mirrored = [replace(s, y=-s.y, c=-s.c) for s in scans]
    zero = zero_of(mirrored, surface)
    views = [view_of(s, k, zero, surface) for k, s in enumerate(mirrored)]
    fitted = _fitted(_started(_network(mirrored, views, priors), priors), views, priors)
    agrees = all(r.minor for r in fitted[1])
    return (Reason(WRONG_SENSE),) if agrees else reasons


def _mirrored(scans: Sequence[ScanData], surface: Surface, form: FormMap) -> bool:
    """Return whether the nominal surface is its own mirror image, and no scan shows the part's."""
    change = surface.height(form.x, form.y) - surface.height(form.x, -form.y)
    return len({s.clocking for s in scans}) == 1 and float(np.ptp(change)) < form.pv.value


def _findings(
    solution: Solution, effects: Mapping[str, Effect], priors: Sequence[Source],
    refutations: Sequence[Refutation],
) -> tuple[SourceFinding, ...]:  # fmt: skip
    """Return every family, declared against found."""
    stated = {p.name: p.uncertainty for p in priors}
    alike = {r.name: r.alike for r in refutations}
    found = []
    # A released family has the evidence that released it.
    released = {r.name: r.evidence for r in refutations}
    for family in solution.network.families:
        evidence = released.get(family.name) or evidence_of(solution, family)
        values, free = evidence.values, evidence.free
        covariance = free @ free.T
        if family.name in solution.sizes:
            here = solution.network.place[family.name]
            values, covariance = solution.values[here], solution.covariance_of(here)
        effect, spread = solution.network.effect(family.name, values, covariance)
        found.append(
            SourceFinding(
                name=family.name, unit=family.unit,
                declared=stated.get(base_name(family.name)),
                found=values,
                uncertainty=np.sqrt(np.maximum(np.diag(covariance), 0.0)),
                effect=effect, effect_uncertainty=spread,
                possible=effects.get(family.name, NO_EFFECT).left,
                shown=evidence.shown, shown_by=family.shown_by, deviate=evidence.deviate,
                refuted=family.name in alike, alike=alike.get(family.name, ()),
            )
        )  # fmt: skip
    return tuple(found)


def corrected_heights(adjustment: Adjustment, scan: ScanData, index: int) -> FloatArray:
    """Return the heights of ``scan`` less all that the adjustment found of the machine, (n,) [m].

    index: of the scan among those that were adjusted
    """
    solution = adjustment.solution
    net = solution.network
    view = view_of(scan, index, adjustment.zero, adjustment.nominal)
    taking = [f for f in net.families if f.name in solution.sizes]
    knots = solution.values[net.knots[index]]
    drift = np.interp(view.since, np.arange(len(knots)) * net.steps[index], knots)
    made = scan.height - drift
    for first in range(0, len(view), _CHUNK):
        part = slice(first, first + _CHUNK)
        points = view.part(part)
        for family in taking:
            values = solution.values[net.place[family.name]]
            made[part] -= values @ np.atleast_2d(family.columns(points))
    return np.asarray(made)
