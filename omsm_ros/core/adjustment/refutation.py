"""Fit, test every family, release what the scans refute, and fit again.

The family that explains most is released first; those that explain as much as it does, and nothing
together with it, are one group whose members these scans do not separate.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from omsm_ros.core.adjustment.evidence import Evidence, evidence_of
from omsm_ros.core.adjustment.network import LEAST_VARIANCE, Network, Scales, Sizes, Solution, solve
from omsm_ros.core.adjustment.sources import FREE, LAG_CHANGE, base_name
from omsm_ros.core.streams.blocks import FloatArray

# One in five hundred clean adjustments has one of some sixty families beyond: 4.2 σ each.
_UNDECLARED_LIMIT = 4.5
# A declared size is a standard uncertainty; by chance, one of a dozen is beyond in 1 of 400 cases.
_DECLARED_LIMIT = 3.7
# Twice the logarithm of odds of 150 : 1, "very strong" (Kass and Raftery 1995).
_LEAST_GAIN = 10.0
# A source with a smaller effect matters for no accuracy of this method.
_LEAST_EFFECT_M = 0.5e-9
# Two explanations within this of each other in χ², or in their share of it, are not separated.
_ALIKE, _ALIKE_SHARE = 12.0, 0.05
# The models of a first cause and of the form are wrong by up to this share; it is no other cause.
MODEL_SHARE = 0.01
# A family that explains this share of the evidence may be the cause: no model of one is exact.
_RIVAL_SHARE, _RARE, _FAR_BEYOND = 0.2, 3.0, 3.0
# A family whose value changes by less than this share is a cause of its own.
_UNCHANGED = 0.3
_MOST_RELEASED = 8
# Further culprits that are tried first.
_MOST_TRIED = 3
# Prior odds against an error that is not declared, and against a wrong declaration in a machine.
ODDS_ABSENT, SURE = 9.0, 50.0
# With a smaller prior, the information of the scans on a family would be lost in rounding.
_LEAST_PROBABLE = 1e-6
# Starting values; each step moves a variance by 30 at most, and four are enough for 2 %.
_WALK_START, _BAND_START_M, _CELLS_START_M = 1e-18, 3e-9, 3e-9
_FIRST_STEPS, _FURTHER_STEPS = 5, 3
# Relative change of a variance: 2 % of a standard deviation.
_SETTLED = 0.04


@dataclass(frozen=True, eq=False)
class Refutation:
    """A family that the scans show beyond what was declared.

    evidence: when it was released;  others: of the families that explain the same
    rivals: of those that explain a part of it, and would make another form
    minor: True if texture, which differs from track to track, may have made it
    explains: True if it, or one that is alike, explains all that belongs together
    """

    evidence: Evidence
    others: tuple[Evidence, ...]
    rivals: tuple[Evidence, ...] = ()
    minor: bool = False
    explains: bool = True

    @property
    def name(self) -> str:
        """Name of the family that was released."""
        return self.evidence.family.name

    @property
    def alike(self) -> tuple[str, ...]:
        """Names of the families that explain the same."""
        return tuple(e.family.name for e in self.others)


@dataclass(frozen=True, eq=False)
class Doubt:
    """A release that may not be right: the form by ``after`` less that by ``before``.

    share: of this difference that is a standard uncertainty of the form
    """

    before: Solution
    after: Solution
    share: float


def start_scales(network: Network, walk: float | None) -> Scales:
    """Return scales to begin with.

    walk: declared standard deviation of the drift after one second [m]
    """
    estimated = network.part.degrees[network.part.free == 0]
    bands = dict.fromkeys(map(int, estimated), _BAND_START_M**2)
    first = _WALK_START if not walk else walk**2
    return Scales(first, bands, _CELLS_START_M**2, np.ones(network.blocks.scans))


def settled(solution: Solution, steps: int) -> Solution:
    """Return the solution after ``steps`` estimates of its scales, fewer once they are constant."""
    for _ in range(steps):
        before, scales = solution.scales, estimate_scales(solution)
        solution = solve(solution.network, solution.y, scales, solution.sizes)
        one, other = (np.append(s.noise, s.walk) for s in (scales, before))
        cells = max(0.3 * scales.cells, 1e-4 * float(np.min(one)))
        close = np.all(np.abs(one - other) < _SETTLED * one)
        if close and abs(scales.cells - before.cells) < cells:
            break
    return solution


def estimate_scales(solution: Solution) -> Scales:
    """Return one step of the variance components (MacKay, Neural Comp. 4, 415).

    Each variance is the sum of squares of its parameters over how many of them the data determine.
    """
    net, scales = solution.network, solution.scales
    diagonal = np.diag(solution.covariance_of(net.terms))
    terms, degrees = solution.values[net.terms], net.part.degrees
    least = _VANISHED * float(np.min(net.blocks.variance))
    bands = {}
    for degree, before in scales.bands.items():
        mine = degrees == degree
        determined = np.sum(1 - diagonal[mine] / before)
        bands[degree] = _variance(float(np.sum(terms[mine] ** 2)), float(determined), before, least)
    residual = solution.residual
    cells = net.cells_of(scales, residual)
    share = net.cell_share(net.weights(scales), scales)
    seen = np.unique(net.part.cell)
    determined_cells = float(np.sum(1 - share[seen] / max(scales.cells, LEAST_VARIANCE)))
    walked = [(scales.walk * np.sum(moves**2), np.sum(1 - np.diag(covariance)))
              for moves, covariance in _moves(solution)]  # fmt: skip
    square, number = (float(total) for total in np.sum(walked, axis=0))
    return replace(
        scales,
        walk=_variance(square, number, scales.walk, least),
        bands=bands,
        cells=_variance(float(np.sum(cells**2)), determined_cells, scales.cells, least),
        noise=_noise(solution, residual - cells[net.part.cell], determined_cells),
    )


# Share of a move's variance that the scans determine; less is rounding.
_LEAST_KNOWN = 1e-6
# A step of a variance; what has vanished, as a share of the variance of a block, may come back.
_LARGEST_STEP, _VANISHED = 30.0, 1e-5


def _variance(square: float, determined: float, before: float, least: float) -> float:
    found = square / max(determined, 1e-3)
    return float(max(np.clip(found, before / _LARGEST_STEP, before * _LARGEST_STEP), least))


def _moves(solution: Solution) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield the moves of the drift of each scan from knot to knot, over their prior standard
    deviation, with their covariance."""
    for here, step in zip(solution.network.knots, solution.network.steps, strict=True):
        moves, size = np.diff(solution.values[here]), solution.scales.walk * step
        one = np.diff(solution.covariance_of(here), axis=0)
        yield moves / np.sqrt(size), np.diff(one, axis=1) / size


def walk_deviate(solution: Solution, declared: float) -> float:
    """Return how far the walk lies beyond ``declared`` [m/√s], in standard deviations.

    It is the root of twice the logarithm of the ratio of likelihoods: moves that the scans hardly
    determine say little, and few moves scatter more above their variance than below it.
    """
    gain, ratio = 0.0, max(declared**2 / solution.scales.walk, _LEAST_KNOWN)
    for moves, covariance in _moves(solution):
        share, axes = np.linalg.eigh(covariance)
        known = np.maximum(1 - share, _LEAST_KNOWN)
        before = 1 + (ratio - 1) * known
        moved = (axes.T @ moves) ** 2 / known
        gain += float(np.sum(moved * (1 / before - 1) + np.log(before)))
    return float(np.sign(1 - ratio) * np.sqrt(max(gain, 0.0)))


def _noise(solution: Solution, residual: FloatArray, determined_cells: float) -> FloatArray:
    """Return the factors of the variance of blocks by the residuals of each scan."""
    blocks = solution.network.blocks
    weights = 1 / blocks.variance
    own = solution.matrix[np.ix_(solution.active, solution.active)]
    parameters = float(np.sum(solution.covariance * own))
    share = (parameters + determined_cells) / len(blocks)
    made = []
    for k in range(blocks.scans):
        mine = blocks.scan == k
        free = max(np.count_nonzero(mine) * (1 - share), 1.0)
        made.append(float(np.sum(weights[mine] * residual[mine] ** 2)) / free)
    return np.maximum(made, _LEAST_NOISE)


# A block cannot be better than half of what its white noise says.
_LEAST_NOISE = 0.5


def fit_and_refute(
    network: Network, y: FloatArray, scales: Scales, sizes: Sizes
) -> tuple[Solution, tuple[Refutation, ...], tuple[Doubt, ...]]:
    """Return the solution with all refuted families released, these families, and open doubts.

    If the simplest culprit does not explain all, the next one that explains as much is tried.
    """
    solution = settled(solve(network, y, scales, sizes), _FIRST_STEPS)
    evidences = [evidence_of(solution, f) for f in network.families]
    found = made = _released(solution, evidences, ())
    avoided: list[str] = []
    while not all(c.explains for c in made[1]) and len(avoided) < _MOST_TRIED:
        avoided.append(made[1][0].name)
        next_one = _culprit(_beyond(evidences, (), _LEAST_GAIN), avoided)
        if next_one.family.name in avoided or not _plausible(next_one):
            break
        made = _released(solution, evidences, avoided)
    return made if all(c.explains for c in made[1]) else found


def _released(
    solution: Solution, evidences: list[Evidence], avoided: Sequence[str]
) -> tuple[Solution, tuple[Refutation, ...], tuple[Doubt, ...]]:
    """Return what :func:`fit_and_refute` does, with a first culprit that is none of ``avoided``."""
    network, y = solution.network, solution.y
    first = {e.family.name: e.values for e in evidences}
    found: list[Refutation] = []
    released: list[str] = []
    steps = [solution]
    least = _LEAST_GAIN
    while len(found) < _MOST_RELEASED and (beyond := _beyond(evidences, released, least)):
        best = _culprit(beyond, () if released else avoided)
        least = max(least, MODEL_SHARE * best.gain)
        family = best.family
        # As large as it was found, if that is more than plausible.
        size = max(family.wide, float(np.sqrt(np.mean(best.values**2))))
        solution = settled(
            solve(network, y, solution.scales, {**solution.sizes, family.name: size}, solution),
            _FURTHER_STEPS,
        )
        steps.append(solution)
        others = [e for e in evidences if e is not best and e.deviate > _RARE]
        evidences = [evidence_of(solution, f) for f in network.families]
        still = [e.family.name for e in _beyond(evidences, released, least)] + released
        # Parsimony chooses the culprit; whatever explains as much may be it.
        alike = [e for e in others
                 if _plausible(e) and e.family.name not in still and _as_good(e, best)]  # fmt: skip
        minor = best.effect < 2 * solution.scales.texture and best.gain < SURE
        rivals = [e for e in others if not minor and explained(e, best) > _RIVAL_SHARE]
        # As a centre that is off along X and along Y: two causes that together explain as much.
        parts = [e for e in rivals if e not in alike and e.family.size < family.size
                 and e.family.name not in still]  # fmt: skip
        if sum(explained(e, best) for e in parts) > 1 - _ALIKE_SHARE:
            alike += parts
        found.append(Refutation(best, tuple(alike), tuple(rivals), minor))
        released.append(family.name)
    left = max((e.gain for e in _beyond(evidences, released, _LEAST_GAIN)), default=0.0)
    return solution, *_grouped(found, steps, first, left)


def _grouped(
    found: Sequence[Refutation], steps: Sequence[Solution], first: Mapping[str, FloatArray],
    rest: float,
) -> tuple[tuple[Refutation, ...], tuple[Doubt, ...]]:  # fmt: skip
    """Return causes and doubts; a family released because of an earlier one belongs to that one.

    A family that was found as large before anything was released is a cause of its own, as is the
    same cause in another scan. A family whose value an earlier release changed, or whose effect is
    a small share of the first one's, shows what that release left. If that is more than the error
    of its model, no single family explains the scans.
    first: found value of each family before the first release;  rest: gain that is left at the end
    """
    causes: list[Refutation] = []
    left: list[float] = []
    of: list[int] = []
    for one in found:
        moved = np.linalg.norm(one.evidence.values - first[one.name])
        again = base_name(one.name) in {base_name(c.name) for c in causes}
        small = causes and one.evidence.effect < _RIVAL_SHARE * causes[0].evidence.effect
        changed = moved > _UNCHANGED * np.linalg.norm(one.evidence.values)
        if not causes or again or not (small or changed):
            causes.append(one)
            left.append(0.0)
            of.append(len(causes) - 1)
            continue
        of.append(0)
        # A lag that depends on something has an unknown mean, which is no further cause.
        if one.name != LAG_CHANGE:
            left[0] += one.evidence.chi_square
    shares = []
    for k, (cause, more) in enumerate(zip(causes, left, strict=True)):
        chi_square = cause.evidence.chi_square
        named = _plausible(cause.evidence) or not cause.evidence.family.named
        explains = named and more <= max(_ALIKE, _ALIKE_SHARE * chi_square)
        causes[k] = replace(cause, explains=explains)
        shares.append(min(np.sqrt((more + rest) / chi_square), 1.0) if explains else 1.0)
    doubts = (
        Doubt(before, after, float(shares[k]))
        for before, after, k in zip(steps, steps[1:], of, strict=False)
    )
    return tuple(causes), tuple(doubts)


def _beyond(evidences: Sequence[Evidence], released: Sequence[str], least: float) -> list[Evidence]:
    """Return those that are rare and gain more than ``least``, strongest first."""
    found = [
        e
        for e in evidences
        if e.gain > least
        and e.effect > _LEAST_EFFECT_M
        and e.deviate > (_DECLARED_LIMIT if e.declared else _UNDECLARED_LIMIT)
        and e.family.name not in released
        and base_name(e.family.name) not in FREE
    ]
    return sorted(found, key=lambda e: -e.gain)


def explained(one: Evidence, best: Evidence) -> float:
    """Return the share of what ``best`` explains that family ``one`` alone would explain.

    A declared family counts against the odds that its declaration is wrong, and explains nothing
    far beyond its plausible size.
    """
    size = one.gain if one.declared else one.chi_square - one.dof
    return float(np.clip(size / best.chi_square, 0.0, 1.0)) if _plausible(one) else 0.0


def _plausible(one: Evidence) -> bool:
    """Return whether it is a named cause, and not far beyond its plausible size if declared."""
    far = one.declared and np.max(np.abs(one.values)) > _FAR_BEYOND * one.family.wide
    return one.family.named and base_name(one.family.name) not in FREE and not far


def _as_good(one: Evidence, best: Evidence) -> bool:
    """Return whether ``one`` is as probable as ``best``, or fits as well with more parameters."""
    likely = best.gain - max(_ALIKE, _ALIKE_SHARE * best.gain)
    fits = best.chi_square - max(_ALIKE, _RIVAL_SHARE * best.chi_square)
    return one.gain >= likely or one.chi_square >= fits


def _culprit(beyond: list[Evidence], avoided: Sequence[str]) -> Evidence:
    """Return the simplest of those that explain as much; a named one before one that detects."""
    as_good = [e for e in beyond if _as_good(e, beyond[0])]
    named = [e for e in as_good if _plausible(e) and e.family.name not in avoided] or as_good
    return min((e for e in named if e.gain >= named[0].gain - _ALIKE), key=lambda e: e.family.size)


def probabilities(gains: Sequence[float]) -> FloatArray:
    """Return the probability that each of several declarations is the one that is wrong, (k,).

    The prior odds are shared equally, so that many declarations do not make one that looks wrong
    by chance more probable (J. G. Scott, J. O. Berger, Ann. Statist. 38, 2587).
    gains: of their likelihoods (k,)
    """
    odds = np.exp(np.minimum(gains, SURE) / 2)
    return np.asarray(odds / (ODDS_ABSENT * max(len(odds), 1) + np.sum(odds)))


def completed(solution: Solution, refutations: Sequence[Refutation] = ()) -> Solution:
    """Return ``solution`` with every family taking part that has a name.

    A family that is neither declared nor significant may be present, as large as the residuals and
    its plausible size allow. The uncertainty of the form contains its mean square: the square of
    that size times the probability that it is present (Hoeting et al., Statist. Sci. 14, 382). A
    declared size from which the scans differ by more than both are uncertain is larger by the ratio
    (R. T. Birge, Phys. Rev. 40, 207). Families that explain a part of the evidence count by that
    part, because no model is exact and the likelihood alone would be overconfident.
    """
    sizes: dict[str, float | FloatArray] = dict(solution.sizes)
    for one in (evidence_of(solution, f) for f in solution.network.families if f.named):
        name = one.family.name
        if one.declared:
            sizes[name] = np.sqrt(max(one.chi_square / max(one.dof, 1), 1.0)) * sizes[name]
            continue
        probable = 1 / (1 + ODDS_ABSENT * np.exp(-min(one.gain, SURE) / 2))
        root = np.sqrt(max(probable, _LEAST_PROBABLE))
        sizes[name] = np.minimum(root * np.hypot(one.values, one.uncertainty), one.family.wide)
    for refutation in refutations:
        for other in refutation.rivals:
            share = explained(other, refutation.evidence)
            name, size = other.family.name, np.sqrt(share) * np.abs(other.values)
            sizes[name] = np.maximum(sizes.get(name, 0.0), size)
    return solve(solution.network, solution.y, solution.scales, sizes, solution)
