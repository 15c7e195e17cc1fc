"""May these heights be relied on? Green is for redundant scans that agree, never for declarations.

Codes and values only; sentences are made elsewhere.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from omsm_ros.core.adjustment.agreement import ScanAgreement
from omsm_ros.core.adjustment.families import BEYOND_CENTRE, RECLOCKED, REFERENCE
from omsm_ros.core.adjustment.figures import NO_EFFECT, Effect
from omsm_ros.core.adjustment.refutation import Refutation
from omsm_ros.core.adjustment.scan_data import ScanData
from omsm_ros.core.adjustment.sources import VIBRATION, Contribution, Family, Source, base_name
from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.calibration.certificate import REJECTED

VERIFIED, NOT_VERIFIED = "verified", "not_verified"
CONTRADICTED, TOO_UNCERTAIN, INVALID = "contradicted", "too_uncertain", "invalid"

# Reasons.
REFUTED, DISAGREE, WRONG_SIGN = "refuted", "scans_disagree", "wrong_sign"
WRONG_SENSE, SENSE = "wrong_sense", "sense_of_c"
UNDECLARED_EFFECT, NOT_REDUNDANT, UNCERTAINTY = "undeclared_effect", "not_redundant", "uncertainty"
NOT_EVALUATED, DECLARED_ONLY = "not_evaluated", "declared_only"
UNIDENTIFIED, LOOKS_LIKE = "unidentified", "looks_like"

# Standard deviations; drift beyond them is not the declared drift (probability 1e-4, one-sided).
_RARE_WALK = 3.7
# Speeds nearer to each other than a tenth leave a lag as open as one scan does.
_OTHER_SPEED = 0.1


@dataclass(frozen=True)
class Reason:
    """One reason against green.

    code: of this module;  names: families or scans it is about;  value, limit: its figures
    largest: contribution to an uncertainty that is too large
    """

    code: str
    names: tuple[str, ...] = ()
    value: float = float("nan")
    limit: float = float("nan")
    largest: Contribution | None = None


@dataclass(frozen=True)
class Verdict:
    """Verdict on the heights, with its reasons.

    code: of this module;  reasons: against green, none where it is verified
    rests_on: declared sources that these scans do not verify, name, standard uncertainty of the
        heights by each [m], and code of what would show it, largest first
    add: code of the one scan to add that helps most, "" where none is needed
    reached: expanded uncertainty (k = 2) of PV with that scan [m]
    """

    code: str
    reasons: tuple[Reason, ...]
    rests_on: tuple[tuple[str, float, str], ...] = ()
    add: str = ""
    reached: float = float("nan")


def redundant(scans: Sequence[ScanData]) -> bool:
    """Return whether two of the scans differ in speed or direction, and in time."""
    return any(
        (one.time[-1] < other.time[0] or other.time[-1] < one.time[0])
        and abs(other.speed - one.speed) > _OTHER_SPEED * max(abs(other.speed), abs(one.speed))
        for one, other in combinations(scans, 2)
    )


def reasons_of(
    refutations: Sequence[Refutation],
    declared: Collection[str],
    agreement: Sequence[ScanAgreement],
    wrong_sign: Sequence[tuple[int, float]],
    walk: tuple[float, float],
    accepted: Collection[str],
    least: float = 0.0,
) -> tuple[Reason, ...]:
    """Return what contradicts the scans or their declarations.

    declared: names of the declared sources;  wrong_sign: scan, and share that it follows
    walk: of the drift after one second [m], and its standard deviations beyond the declared one
    accepted: names of families whose found value somebody has accepted
    least: effect below which a cause has no name: the model of the form may have made it [m]
    """
    found = [Reason(WRONG_SIGN, (str(scan),), share, 0.0) for scan, share in wrong_sign]
    # An error that was removed with the wrong sign passes for others.
    seen = () if wrong_sign else refutations
    causes = [r for r in seen if not r.minor and set(accepted).isdisjoint(_names(r))]
    size, beyond = walk
    walks = beyond > _RARE_WALK
    # To the centre time and slide are one, and a line whose phase wanders is none.
    minor = [r.name for r in seen if r.minor and r.evidence.family.named]
    of_walk: tuple[str, ...] = ("drift_walk", "straightness_x", VIBRATION, *minor)
    if not all(r.explains for r in causes):
        # A cause that no family explains may stand behind all others that were found.
        found.append(Reason(UNIDENTIFIED, (), max(r.evidence.deviate for r in causes), 3.0))
        causes = []
    elif walks and all(r.evidence.effect < size for r in causes):
        # A drift within half a turn looks like any source with a smaller effect.
        named = [n for r in causes if r.evidence.family.named for n in _names(r)]
        of_walk = tuple(dict.fromkeys((*of_walk, *named)))
    else:
        found += _named(causes, declared, least)
        causes = []
    for one in agreement:
        if one.largest >= one.limit:
            found.append(Reason(DISAGREE, (str(one.scan),), one.largest, one.limit))
    # Any other error that is left in the residuals passes for drift.
    if walks and (causes or not found) and set(accepted).isdisjoint(of_walk):
        found.append(Reason(REFUTED, of_walk, beyond, _RARE_WALK))
    return tuple(found)


def _names(cause: Refutation) -> tuple[str, ...]:
    return (cause.name, *cause.alike)


def _named(causes: Sequence[Refutation], declared: Collection[str], least: float) -> list[Reason]:
    """Return a reason for each of ``causes``, for those with a family in common one.

    A family that explains two of them alone is the simpler explanation, and is named first.
    """
    found: list[Reason] = []
    for cause in causes:
        names, deviate = _names(cause), cause.evidence.deviate
        if not cause.evidence.family.named or cause.evidence.effect < least:
            found.append(Reason(UNIDENTIFIED, (), deviate, 3.0))
            continue
        for before in [r for r in found if not set(names).isdisjoint(r.names)]:
            found.remove(before)
            both = [n for n in before.names if n in names]
            names = tuple(dict.fromkeys((*both, *before.names, *names)))
            deviate = max(deviate, before.value)
        code = REFUTED if base_name(names[0]) in declared else UNDECLARED_EFFECT
        found.append(Reason(code, names, deviate, 3.0))
    return found


# Share of the accuracy by which a source that is neither shown nor declared may change the heights.
_OPEN_SHARE = 0.5
# If no accuracy is given: what matters for a mirror for visible light, rms and PV [m].
_OPEN_M, _OPEN_PV_M = 20e-9, 80e-9


def open_limit(accuracy: float | None) -> float:
    """Return the effect on the heights beyond which an open source matters [m]."""
    return _OPEN_M if accuracy is None else _OPEN_SHARE * accuracy


def not_evaluated(
    families: Sequence[Family],
    effects: Mapping[str, Effect],
    priors: Sequence[Source],
    accuracy: float | None,
    expanded: float,
) -> tuple[Reason, ...]:
    """Return families that nobody evaluated, that these scans leave open, and that may matter.

    effects: of each family on the form, left by scans and prior and by the scans alone, k = 1 [m]
    accuracy: of PV, asked for [m]; None: none;  expanded: uncertainty of the heights, rms [m]

    What nobody declared counts in the uncertainty with the probability that it is there, so that
    its heights matter from :func:`open_limit` on; from ``expanded`` on where no other speed,
    direction or clocking would show it. What is declared counts with its declaration: without an
    evaluation it must not hold where PV (k = 2) could be off by the accuracy.
    The second name of a reason is the scan or artefact that would show the family.
    """
    stated = {base_name(p.name): p for p in priors}
    limit, of_pv = open_limit(accuracy), _OPEN_PV_M if accuracy is None else accuracy
    found = []
    for family in families:
        prior, effect = stated.get(base_name(family.name)), effects.get(family.name, NO_EFFECT)
        names = (family.name, family.shown_by)
        size = np.inf if prior is None else prior.uncertainty
        # A default is wide enough for good machines, and what it leaves open is in the uncertainty.
        if (family.default is not None and size >= family.default) or (prior and prior.evaluated):
            continue
        if prior and 2 * effect.peak > of_pv:
            found.append(Reason(DECLARED_ONLY, names, 2 * effect.peak, of_pv))
        least = min(limit, expanded) if family.shown_by in (BEYOND_CENTRE, REFERENCE) else limit
        if prior is None and family.named and effect.free > least:
            found.append(Reason(NOT_EVALUATED, names, effect.free, float(least)))
    return tuple(found)


def looks_like(
    resembled: Sequence[tuple[str, float]], families: Sequence[Family], accepted: Collection[str],
    limit: float,
) -> tuple[Reason, ...]:  # fmt: skip
    """Return the families that the form looks like, which these scans cannot tell from the part.

    resembled: their names, with what each may do to the form [m];  accepted: as the part's
    limit: effect from which on one matters [m]
    """
    by = {f.name: f.shown_by for f in families}
    return tuple(
        Reason(LOOKS_LIKE, (name, by[name]), size)
        for name, size in resembled
        if name not in accepted and size > limit
    )


def rests_on(
    families: Sequence[Family], effects: Mapping[str, Effect], limit: float, mirrored: bool
) -> tuple[tuple[str, float, str], ...]:
    """Return the sources that count as they were declared, for these scans do not show them.

    Also what each does to the heights as declared, k = 1 [m], the largest first, and the code of
    the scan or artefact that would show it.
    limit: a source that may do more if its declaration is worth nothing is one of them [m]
    mirrored: True if C might count the other way, which makes the mirror image of the form
    """
    # A declared pose among them: it looks like form.
    found = [(f.name, effects[f.name].left, f.shown_by) for f in families
             if effects.get(f.name, NO_EFFECT).free > limit]  # fmt: skip
    sense = [(SENSE, 0.0, RECLOCKED)] if mirrored else []
    return (*sense, *sorted(found, key=lambda one: -one[1]))


def verdict_of(
    contradictions: Sequence[Reason],
    open_sources: Sequence[Reason],
    resting: tuple[tuple[str, float, str], ...],
    is_redundant: bool,
    expanded: float,
    accuracy: float | None,
    best_addition: Callable[[], tuple[str, float]],
    calibration: Calibration | None = None,
    largest: Contribution | None = None,
) -> Verdict:
    """Return the verdict.

    open_sources: what is neither shown nor declared;  resting: of :func:`rests_on`
    expanded: uncertainty (k = 2) of PV [m];  accuracy: asked for [m], None: none
    best_addition: returns the code of a scan to add, and the expanded uncertainty that it reaches
    calibration: that corrected the heights; where it was rejected they are not valid
    largest: contribution to ``expanded`` where it is too large
    """
    reasons = [*contradictions, *open_sources]
    rejected = calibration is not None and calibration.certificate.verdict == REJECTED
    if rejected:
        reasons.insert(0, Reason(REJECTED))
    if not is_redundant:
        reasons.append(Reason(NOT_REDUNDANT))
    too_large = accuracy is not None and not expanded <= accuracy
    if too_large:
        limit = float("nan") if accuracy is None else accuracy
        reasons.append(Reason(UNCERTAINTY, (), expanded, limit, largest))
    add, reached = "", float("nan")
    if not is_redundant or (too_large and not contradictions):
        best, reached = best_addition()
        add = best if not is_redundant or reached < expanded else ""
    if rejected:
        code = INVALID
    elif contradictions:
        code = CONTRADICTED
    elif too_large or not np.isfinite(expanded):
        code = TOO_UNCERTAIN
    elif open_sources or not is_redundant:
        code = NOT_VERIFIED
    else:
        code = VERIFIED
    return Verdict(code, tuple(reasons), resting, add, reached)
