"""Choose delays and order of parallel sections by their free runs over held-out parts of records.

Models of rising order are fitted to the first part of each record and simulated over the rest. The
best few are then compared on several held-out parts. The simplest of equally good models is taken,
because superfluous poles would follow a drift. An impulse response without a model is fitted to the
same first part: a model whose free run over the rest is worse does not describe the records.

A few thousand samples determine the order as well as all, except for dynamics slower than they
last; so the orders of a long record are explored on its most exciting part.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import signal

from omsm_ros.core.estimation.covariance import autoregression
from omsm_ros.core.estimation.impulse_response import coherent_power, gram_of, impulse_response
from omsm_ros.core.estimation.parallel_sections import BAND_LIMITED, ParallelSections
from omsm_ros.core.estimation.sampled_fit import (
    RATE,
    SampledRecord,
    SectionsFit,
    SectionsProblem,
    grown_starts,
)
from omsm_ros.core.estimation.sampled_model import simulated
from omsm_ros.core.streams.blocks import BoolArray, FloatArray
from omsm_ros.errors import IdentificationError
from omsm_ros.linear_algebra import inverse_gram

# Most poles. Orders that are tried: every one while it is low, then steps.
MAX_ORDER = 40
_ORDERS = (*range(7), *range(8, 21, 2), *range(24, MAX_ORDER + 1, 4))
# Parts of each record: all but the first are held out in turn, and the last ones together.
_PARTS = 6
# Share of the deviation of an input below which it stands still.
_STILL = 0.1
# Share of the used samples to which every order is fitted first.
_FIRST_PART = 0.75
# Orders compared on every held-out part: the best over the last part, and the lowest orders within
# this factor of the least error. One part alone is uncertain by about this factor.
_FINALISTS = 3
_EQUIVALENT = 2.0
# Orders in a row without a better prediction that end the search; better is an error below this
# part of the least before.
_FRUITLESS, _NO_GAIN = 4, 0.98
# Standard errors by which a model must predict better than another. With disturbances, a pole too
# few costs more than one too many (docs/design/identification-ablation.md).
_IMPROVES_BY = 0.5
# Factor on the error of the chosen model within which another predicts about as well.
_ALIKE = 1.1
# Order by which delays are chosen, that by which they are confirmed; delays [samples] at which free
# ones start.
_DELAY_ORDER, _CONFIRMING_ORDER = 3, 12
_FREE_DELAYS = (0.0, 1.0, 4.0, 15.0)
# Samples per parameter: with fewer, an order is not tried.
_LEAST_SAMPLES_EACH = 3
# Sixty columns of a record then take half a gigabyte.
_MOST_SAMPLES = 1_000_000
# Used samples of all records together on which orders are explored.
EXPLORED_ON = 8000
# Iterations of each start, of an explored, of a refitted and of the final fit.
_RACE, _EXPLORING, _REFITTED, _FINAL = 3, 12, 4, 30
# Directions weaker than this part of the power of the strongest are rounding of six digits.
_UNEXCITED = 1e-12
# The comparator's record: half its sampling rate over the frequency below which this share of the
# power of the inputs lies.
_ABOVE_CONTENT, _CONTENT = 1.6, 0.999
# Blocks whose scatter gives the uncertainty of a comparison; how many of these count as worse, and
# the least difference, in shares of the variance.
_BLOCKS, _CLEARLY, _NOTICEABLE = 12, 2.0, 0.005


@dataclass(frozen=True, eq=False)
class SampledCandidate:
    """A fit, and its mean square errors of free runs over each held-out part (folds,)."""

    fit: SectionsFit
    held_out: FloatArray


@dataclass(frozen=True, eq=False)
class SampledChoice:
    """The chosen model, and the others.

    chosen: of the order asked for, or the free choice;  free: that one, as it was compared
    others: models of every order compared, in sample periods
    evidence: weight of each (c,), times the share of the samples on which they were compared
    alternatives: the larger of them that predict about as well
    impulse_response: share of the variance over the last part that it, as a "comparator", explains
        at the frequencies of the inputs, and the "model"; None where the records are too short
    worse: the model is worse by more than the uncertainty of the comparison
    """

    chosen: SampledCandidate
    free: SampledCandidate
    others: Sequence[ParallelSections]
    evidence: FloatArray
    alternatives: Sequence[ParallelSections]
    impulse_response: Mapping[str, float | None]
    worse: bool


def choose_sampled(
    records: Sequence[SampledRecord], hold: str, *, order: int = 0, max_delay: int = 0
) -> SampledChoice:
    """Fit parallel sections to ``records``, about their means, and choose.

    order: number of poles, 0 to choose;  max_delay: whole samples to try, of a held input

    Raises IdentificationError for too few samples or frequencies of the input, or an order beyond
    MAX_ORDER.
    """
    most = check_records(records, order)
    whole = SectionsProblem(records, hold, np.zeros(records[0].inputs.shape[1], np.int64))
    if hold != BAND_LIMITED and max_delay:
        parts = replace(whole, records=_exciting_parts(records))
        late = _confirmed(_with_delays(parts, max_delay)[0], min(_CONFIRMING_ORDER, most))
        whole = replace(whole, delays=late.delays)
    explored, every, most = _explored(whole, order, most)
    explored, lag = _with_delays(explored, 0)
    first = (r.used & (_parts(r.used) < _FIRST_PART * _PARTS) for r in explored.records)
    records = [replace(r, used=u) for r, u in zip(explored.records, first, strict=True)]
    early = replace(explored, records=records)
    fits, by_order = _explore(early, explored, most, order, lag)
    orders, judged = [fitted.order for fitted in fits], list[SampledCandidate]()
    best = np.argsort(by_order, kind="stable")[:_FINALISTS]
    alike = np.flatnonzero(by_order <= _EQUIVALENT * np.min(by_order))[:_FINALISTS]
    finalists = {0, 1, order, *(orders[i] for i in (*best, *alike))}
    for fitted in (fitted for fitted in reversed(fits) if fitted.order in finalists):
        starts = [fitted.nonlinear, *(_reduced(c.fit, fitted.order) for c in judged[:1])]
        refitted = explored.fit(fitted.order, starts, _EXPLORING)
        judged.append(SampledCandidate(refitted, validation_errors(refitted)))
    free = simplest_undominated(judged)
    chosen = free if not order else next(c for c in judged if c.fit.order == order)
    comparison = _against_impulse_response(explored, fits[orders.index(chosen.fit.order)])
    finished = _finished(whole, chosen, every)
    others = [c.fit.model(float(every)) for c in judged]
    bound = _ALIKE * np.mean(chosen.held_out)
    about = [c.fit.order > chosen.fit.order and np.mean(c.held_out) <= bound for c in judged]
    larger = [other for other, as_well in zip(others, about, strict=True) if as_well]
    share = len(chosen.fit.residual) * every / len(finished.fit.residual)
    return SampledChoice(finished, free, others, share * _evidence(judged), larger, *comparison)


def _evidence(judged: Sequence[SampledCandidate]) -> FloatArray:
    """Return the weights of Akaike (c,), in the coloured noise that the largest model leaves."""
    whitening, _ = autoregression(max(judged, key=lambda c: c.fit.order).fit.residual)
    scores = []
    for fitted in (c.fit for c in judged):
        white = signal.lfilter(whitening, [1.0], fitted.residual)
        # Initial states and offset of each record are free, too.
        free = len(fitted.nonlinear) + fitted.linear.size
        free += len(fitted.problem.records) * (fitted.order + 1)
        power = max(float(white @ white), np.finfo(float).tiny)
        scores.append(0.5 * len(white) * np.log(power) + free)
    weights = np.exp(np.min(scores) - scores)
    return np.asarray(weights / np.sum(weights))


def _explored(whole: SectionsProblem, order: int, most: int) -> tuple[SectionsProblem, int, int]:
    """Return the problem in which orders are explored, its sampling period, and its highest order.

    Where the inputs are slow, the records are decimated. Samples of slow inputs are band-limited.
    """
    shares: list[float] = []
    for record in whole.records:
        power = np.sum(np.abs(np.fft.rfft(record.inputs, axis=0)) ** 2, axis=1)
        total = np.cumsum([power, coherent_power(record.inputs, record.filled())], axis=1)
        shares += np.mean(total < _CONTENT * total[:, -1:], axis=1).tolist()
    every = max(int(1 / max(np.max(shares) * _ABOVE_CONTENT, 1e-3)), 1)
    while every:
        thinned = []
        for record in whole.records:
            values = np.column_stack([record.inputs, record.filled()])
            fewer = np.asarray(signal.resample_poly(values, 1, every, axis=0, padtype="line"))
            thinned.append(SampledRecord(fewer[:, :-1], fewer[:, -1], record.used[::every]))
        records = _exciting_parts(thinned)
        try:
            most = min(most, check_records(records, order))
        except IdentificationError:
            every //= 2
        else:
            held = (whole.hold, whole.delays) if every == 1 else (BAND_LIMITED, 0 * whole.delays)
            return SectionsProblem(records, *held), every, most
    # No part excites as much as the whole record.
    return whole, 1, most


def check_records(records: Sequence[SampledRecord], order: int) -> int:
    """Return the highest order that records determine; raise as :func:`choose_sampled` does."""
    samples = int(sum(np.sum(record.used) for record in records))
    if not 0 <= order <= MAX_ORDER:
        raise IdentificationError("estimation.order", order=order, most=MAX_ORDER)
    if samples > _MOST_SAMPLES:
        raise IdentificationError(
            "estimation.too_many_samples", samples=samples, most=_MOST_SAMPLES
        )
    inputs, lowest = int(records[0].inputs.shape[1]), max(order, 1)
    needed = _LEAST_SAMPLES_EACH * ((2 + inputs) * lowest + inputs + 2)
    if samples < needed:
        raise IdentificationError(
            "estimation.too_few_samples", samples=samples, least=needed, order=lowest
        )
    most = min(MAX_ORDER, (samples // _LEAST_SAMPLES_EACH - inputs - 2) // (2 + inputs))
    excited = min(
        max(excited_parameters(r.inputs[:, i], min(2 * most + 1, len(r))) for r in records)
        for i in range(inputs)
    )
    if excited < 2 * lowest + 1:
        raise IdentificationError(
            "estimation.few_frequencies", excited=excited, needed=2 * lowest + 1, order=lowest
        )
    return min(most, (excited - 1) // 2)


def excited_parameters(input: FloatArray, most: int) -> int:
    """Return the number of parameters that ``input`` (n,) determines, at most ``most``.

    That is its order of persistent excitation with a constant (Ljung 1999, ch. 13): the rank of
    all its windows of ``most`` samples. Each sine gives two, noise gives all.
    """
    varied = (input - np.mean(input))[:, np.newaxis]
    gram, _ = gram_of(varied, np.zeros(len(input) - most + 1), most)
    power = np.linalg.eigvalsh(gram)
    return int(np.sum(power > _UNEXCITED * power[-1]))


def _exciting_parts(records: Sequence[SampledRecord]) -> list[SampledRecord]:
    """Return of each record the part in which the inputs vary most; they share EXPLORED_ON."""
    most, found = EXPLORED_ON // len(records), []
    for record in records:
        places = np.flatnonzero(record.used)
        whole = places[: len(places) // most * most].reshape(-1, most)
        ends = whole[:, [0, -1]].tolist() if len(whole) > 1 else [(0, len(record) - 1)]
        parts = [record.part(slice(first, last + 1)) for first, last in ends]
        found.append(max(parts, key=lambda part: float(np.var(part.inputs, axis=0).sum())))
    return found


def _parts(used: BoolArray) -> FloatArray:
    """Return the place of each used sample in parts, 0 to _PARTS, fractional; -1 elsewhere."""
    place = np.cumsum(used) - 1.0
    return np.asarray(np.where(used, place * _PARTS / max(float(np.sum(used)), 1.0), -1.0))


def _with_delays(problem: SectionsProblem, most: int) -> tuple[SectionsProblem, SectionsFit]:
    delays = problem.delays.astype(np.float64)
    best = _late(problem, delays, _DELAY_ORDER)
    for input in range(problem.inputs):
        for delay in range(1, most + 1) if problem.hold != BAND_LIMITED else _FREE_DELAYS[1:]:
            late = np.where(np.arange(len(delays)) == input, delay, delays)
            found = _late(problem, late, _DELAY_ORDER)
            if _better(found, best):
                best = found
        delays = best.problem.late(best.nonlinear, best.order)
    return best.problem, best


def _late(problem: SectionsProblem, late: FloatArray, order: int, *more: FloatArray) -> SectionsFit:
    """Return a fit with delays ``late`` [samples], and ``more`` starts; those of held ones stay."""
    if problem.hold != BAND_LIMITED:
        problem = replace(problem, delays=late.astype(np.int64))
    return problem.fit(order, [problem.spread_start(order, late), *more], _EXPLORING)


def _better(found: SectionsFit, other: SectionsFit) -> bool:
    """Return whether a fit with one parameter more is better.

    Errors are per sample, as a longer delay leaves fewer.
    """
    count, tiny = len(found.residual), np.finfo(float).tiny
    before, after = (max(np.mean(each.residual**2), tiny) for each in (other, found))
    return bool(count * np.log(before / after) > np.log(count))


def _confirmed(problem: SectionsProblem, order: int) -> SectionsProblem:
    """Return ``problem`` with the delays that a fit of enough poles does not contradict.

    Where poles are too few, a delay imitates the others; no poles make up for one that is too long.
    """
    if not np.any(problem.delays):
        return problem
    found = _late(problem, problem.delays.astype(np.float64), order)
    for input in np.flatnonzero(problem.delays):
        late = found.problem.delays.astype(np.float64)
        for delay in range(problem.delays[input]):
            late[input] = delay
            shorter = _late(problem, late, order, found.nonlinear)
            if _better(shorter, found):
                found = shorter
    return found.problem


def _explore(
    early: SectionsProblem, whole: SectionsProblem, most: int, asked: int, lag: SectionsFit
) -> tuple[list[SectionsFit], FloatArray]:
    """Return fits of rising order to ``early``, and what they miss of the rest of ``whole``.

    They end where orders stop to improve the prediction, at ``asked`` or beyond.
    """
    fits: list[SectionsFit] = []
    missed: list[float] = []
    best = 0
    late = lag.problem.late(lag.nonlinear, lag.order)
    for order in sorted(n for n in {*_ORDERS, asked} if n <= most):
        starts = _starts(early, fits, best, order, late)
        raced = [early.fit(order, [start], _RACE) for start in starts]
        chosen = min(raced, key=lambda one: _missed(one, whole))
        fits.append(early.fit(order, [chosen.nonlinear], _EXPLORING))
        missed.append(_missed(fits[-1], whole))
        if missed[-1] < _NO_GAIN * missed[best]:
            best = len(missed) - 1
        if len(missed) - 1 - best >= _FRUITLESS and order >= asked:
            break
    return fits, np.array(missed)


def _starts(
    problem: SectionsProblem, fits: Sequence[SectionsFit], best: int, order: int, late: FloatArray
) -> list[FloatArray]:
    """Return starts of ``order``: spread poles, those of the largest of ``fits``, of the best.

    The best is the one that predicts best: poles of a larger one may follow noise.
    """
    if order == 0:
        return [problem.nonlinear_of(np.empty(0, np.complex128), late)]
    found = [problem.spread_start(order, late)]
    for smaller in {fits[-1], fits[best]}:
        own = smaller.problem.late(smaller.nonlinear, smaller.order)
        found += [problem.nonlinear_of(p, own) for p in grown_starts(problem, smaller, order)]
    return found


def _reduced(larger: SectionsFit, order: int) -> FloatArray:
    """Return parameters: ``larger`` without a single pole, and the pairs whose loss costs least."""
    gram, pairs = larger.gram(), list(range(larger.order // 2))
    own = np.tile(np.append(-1, np.arange(larger.order) // 2), larger.problem.inputs)
    while len(pairs) > order // 2:
        places = np.flatnonzero(np.isin(own, [-1, *pairs]))
        inverse, cost = inverse_gram(gram[np.ix_(places, places)]), []
        for lost in (np.flatnonzero(own[places] == pair) for pair in pairs):
            along = inverse[lost] @ gram[places] @ np.ravel(larger.linear)
            cost.append(along @ inverse_gram(inverse[np.ix_(lost, lost)]) @ along)
        pairs.pop(int(np.argmin(cost)))
    first, second = np.log(larger.sections[pairs].T)
    single = np.full(order % 2, np.log(RATE / 5))
    return np.concatenate([first, single, second, larger.nonlinear[larger.order :]])


def validation_residual(fitted: SectionsFit, whole: SectionsProblem) -> list[FloatArray]:
    """Return output less free run of each record of ``whole``, where it was held out from the fit.

    The initial state and the offset of each record are those of its samples that were fitted. The
    residual is relative to the deviation of the record, NaN elsewhere, (n,).
    """
    model, found = fitted.model(), []
    for record, own in zip(whole.records, fitted.problem.records, strict=True):
        inputs = record.inputs - np.mean(record.inputs, axis=0)
        with np.errstate(all="ignore"):
            missed = record.output - simulated(model, inputs, record.output, own.used)[0]
        scale = float(np.std(record.output[record.used])) or 1.0
        found.append(np.where(record.used & ~own.used, missed / scale, np.nan))
    return found


def _missed(fitted: SectionsFit, whole: SectionsProblem) -> float:
    """Return the mean square of all counted residuals; infinite where one is not finite."""
    every = np.concatenate([one[~np.isnan(one)] for one in validation_residual(fitted, whole)])
    with np.errstate(over="ignore"):
        return float(np.mean(np.nan_to_num(every**2, nan=np.inf))) if len(every) else np.inf


def validation_errors(fitted: SectionsFit, evaluations: int = _REFITTED) -> FloatArray:
    """Return the mean square error over each held-out part, refitted without it, (folds,).

    Some parts lie inside the records, others reach to their end. Parts inside alone would favour
    models of a drift, because the data constrain the model on both sides. Where an input stands
    still in the rest of the records, as before a single step, a part tells nothing.
    """
    problem = fitted.problem
    numbers = [np.floor(_parts(record.used)) for record in problem.records]
    folds = [[n == i for n in numbers] for i in range(1, _PARTS)]
    folds += [[n >= i for n in numbers] for i in range(_PARTS // 2, _PARTS - 1)]
    errors, counted = [], []
    for fold in folds:
        rest = [
            replace(record, used=record.used & ~part)
            for record, part in zip(problem.records, fold, strict=True)
        ]
        counted.append(np.all(_variation(rest) > _STILL * _variation(problem.records)))
        found = replace(problem, records=rest).fit(fitted.order, [fitted.nonlinear], evaluations)
        errors.append(_missed(found, problem))
    return np.array(errors)[counted if sum(counted) > 1 else slice(None)]


def _variation(records: Sequence[SampledRecord]) -> FloatArray:
    """Return the standard deviation of each input where the output counts, (m,)."""
    return np.asarray(np.std(np.concatenate([r.inputs[r.used] for r in records]), axis=0))


def simplest_undominated(judged: Sequence[SampledCandidate]) -> SampledCandidate:
    """Return the candidate of the fewest poles that no other dominates.

    A candidate dominates if its mean error is lower by more than half a standard error of their
    paired difference (after Breiman et al. 1984).
    """
    errors = np.array([c.held_out for c in judged])
    with np.errstate(invalid="ignore"):
        worse = errors[:, np.newaxis] - errors[np.newaxis]
        allowed = _IMPROVES_BY * np.std(worse, axis=2, ddof=1) / np.sqrt(errors.shape[1])
        unbeaten = np.all(np.mean(worse, axis=2) <= allowed, axis=1)
    best = int(np.argmin(np.mean(errors, axis=1)))
    every = {best, *np.flatnonzero(unbeaten).tolist()}
    return judged[min(every, key=lambda i: judged[i].fit.order)]


def _finished(whole: SectionsProblem, candidate: SampledCandidate, every: int) -> SampledCandidate:
    """Return a candidate that was explored at one in ``every`` samples, fitted to all of them."""
    fitted = candidate.fit
    late = fitted.problem.late(fitted.nonlinear, fitted.order) * every
    roots = fitted.roots()
    if every > 1:
        turned = roots * RATE / every
        held = whole.hold != BAND_LIMITED
        roots = np.asarray((2 * np.tanh(turned / 2) if held else turned) / RATE)
    found = whole.fit(fitted.order, [whole.nonlinear_of(roots, late)], _FINAL)
    return replace(candidate, fit=found)


def _against_impulse_response(
    whole: SectionsProblem, fitted: SectionsFit
) -> tuple[dict[str, float | None], bool]:
    """Return what an impulse response and ``fitted`` explain of held-out samples, as shares.

    The second value is True if the model is worse by more than the uncertainty of the comparison.
    """
    record, own = whole.records[0], fitted.problem.records[0]
    inputs = record.inputs - np.mean(record.inputs, axis=0)
    inputs = np.column_stack(
        [np.roll(u, d) for u, d in zip(inputs.T, fitted.problem.delays, strict=True)]
    )
    output = record.filled() - np.mean(record.output[own.used])
    residual = validation_residual(fitted, whole)[0] * np.std(record.output[record.used])
    held_out = ~np.isnan(residual)
    missed, used = np.where(held_out, residual, 0.0), own.used
    end = int(np.flatnonzero(used)[-1]) + 1
    taps = impulse_response(inputs[:end], output[:end], used[:end])
    if taps is None or np.sum(held_out) < _BLOCKS:
        return {"comparator": None, "model": None}, False
    free = output.copy()
    for drive, response in zip(inputs.T, taps, strict=True):
        free -= signal.fftconvolve(drive, response)[: len(drive)]
    free -= np.mean(free[used])
    power = float(np.var(output[held_out])) or 1.0
    blocks = np.array_split(np.flatnonzero(held_out), _BLOCKS)
    means = np.array([[np.mean(e[b] ** 2) for b in blocks] for e in (free, missed)]) / power
    apart = means[1] - means[0]
    uncertain = float(np.std(apart, ddof=1)) / np.sqrt(_BLOCKS)
    shares = 1 - np.mean(means, axis=1)
    worse = float(np.mean(apart)) > max(_CLEARLY * uncertain, _NOTICEABLE)
    return {"comparator": float(shares[0]), "model": float(shares[1])}, bool(worse)
