"""Identify from an input that is held between samples, such as a drive's own command.

A linear system behind a zero-order hold is exactly rational in z, hence also in
``w = (2/T)(z - 1)/(z + 1)``, with as many poles. So the same fit serves with w for s, and
the initial state is exact too: it is a polynomial over the same denominator.
Measured motion is not held; for that, :mod:`omsm_ros.core.identification.identify` is the way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import fft, signal

from omsm_ros.core.dynamics.transfer_function import ComplexArray
from omsm_ros.core.fitting.covariance import autoregression
from omsm_ros.core.fitting.model_structure import Structure
from omsm_ros.core.fitting.order_estimate import OrderEstimate
from omsm_ros.core.fitting.output_error import Fit, Problem, fit
from omsm_ros.core.fitting.starting_points import StartingPoints
from omsm_ros.core.samples.blocks import BoolArray, FloatArray
from omsm_ros.errors import IdentificationError

_GREATEST_ORDER = 8
# Of the used samples; half of them are fitted at least.
_PARTS = 6
# Logarithm of the time constant of a pole too fast to be seen, but not to have a gradient.
_FAST = float(np.log(0.1))
_NO_VOTE = OrderEstimate(np.empty(0), 0, np.empty(0, np.complex128))


class HeldProblem(Problem):
    """A problem whose motion is held between samples; s is then scaled w."""

    @cached_property
    def closed_length(self) -> int:
        """Samples of the record: a held input needs no bridge back to its start."""
        return len(self.input)

    def closed_spectrum(self, values: FloatArray) -> ComplexArray:
        """Transform of ``values`` (n,) as they are, shape (k,)."""
        return np.asarray(fft.rfft(values), np.complex128)

    @cached_property
    def _spectrum(self) -> ComplexArray:
        return self.closed_spectrum(self.input)

    @cached_property
    def s(self) -> ComplexArray:
        """2 (z − 1) / (z + 1) / period / rate on the unit circle, w of a held input, (k,)."""
        angle = np.pi * fft.rfftfreq(self.closed_length)
        return np.asarray(2j / self.period * np.tan(angle) / self.rate, np.complex128)

    def drives(self, structure: Structure) -> list[tuple[ComplexArray, int]]:
        """The motion, and a pulse at the first sample whose terms make any initial state.

        n of them do from the second sample on, and one more sets the first free.
        """
        pulse = np.ones(len(self.s), np.complex128)
        return [(self._spectrum, structure.zeros + 1), (pulse, structure.poles + 1)]

    def _driven(self, structure: Structure, lag: ComplexArray) -> ComplexArray:
        """Without their mean, which the offset replaces: an integrator's would drown the rest."""
        spectra = super()._driven(structure, lag)
        spectra[:, 0] = 0.0
        return spectra

    def with_initial_state(self, fitted: Fit) -> FloatArray:
        """Output (n,) of a fit's dynamics, with initial state and offset fitted here."""
        lag, _ = fitted.scaled.lag(fitted.nonlinear, self.s)
        spectra = self._driven(fitted.structure, lag)
        terms = len(fitted.numerator)
        columns = fft.irfft(spectra, self.closed_length)[:, : len(self.input)].T
        moved = columns[:, :terms] @ fitted.driven[:terms]
        free = np.column_stack([columns[:, terms:], self.background])
        rest = (self.output - moved)[self.used]
        scale = np.linalg.norm(free[self.used], axis=0)
        scale[scale == 0] = 1.0
        state = np.linalg.lstsq(free[self.used] / scale, rest, rcond=None)[0]
        return np.asarray(moved + free @ (state / scale))


@dataclass(frozen=True, eq=False)
class HeldFit:
    """order: poles;  delay: whole samples;  whitened: fitted with its residual made white
    output: what the model says is seen (n,), a free run from its initial state; the first
        ``delay`` samples mean nothing, for what they answer to was before the record
    """

    order: int
    delay: int
    whitened: bool
    output: FloatArray


def identify_held(
    command: FloatArray,
    seen: FloatArray,
    used: BoolArray,
    period: float,
    *,
    order: int = _GREATEST_ORDER,
    delays: Sequence[int] = (0,),
) -> HeldFit:
    """Fit ``seen`` (n,) where ``used`` (n,) from a ``command`` (n,) held over ``period`` [s].

    order: most poles a model may have;  delays: whole samples to try. How many poles are
    worth having, the delay, and whether to whiten the residual are judged by free runs
    through parts of the used samples that were hidden from the fit. So more poles allowed
    do no harm: an unstable, integrating or drifting plant would invite them to follow its
    drift, and whitening is efficient only for a model that holds all the dynamics.

    Raises IdentificationError when too few samples are used or one is not finite.
    """
    needed = 2 * (_parameters(order) + 1)
    finite = np.all(np.isfinite(command)) and np.all(np.isfinite(seen[used]))
    if not (np.sum(used) >= needed and finite):
        raise IdentificationError(
            f"{int(np.sum(used))!r} samples are used, at least {needed} finite ones are needed"
        )
    centre = float(np.mean(seen[used]))
    centred = np.where(used, seen - centre, 0.0)
    problems = [_delayed(command, centred, used, period, delay) for delay in delays]
    fits = [_by_order(problem, order) for problem in problems]
    found = [
        held
        for problem, delay, own in zip(problems, delays, fits, strict=True)
        for held in _free_runs(problem, delay, own)
    ]

    def blind(hidden: BoolArray) -> list[float]:
        return [
            float(np.mean((centred - held.output)[hidden] ** 2))
            for problem, delay, own in zip(problems, delays, fits, strict=True)
            for held in _blind_runs(problem, delay, own, hidden)
        ]

    best = found[_plainest(found, np.array([blind(hidden) for hidden in _hidden(used)]))]
    return replace(best, output=best.output + centre)


def _parameters(order: int) -> int:
    """Of denominator, numerator, initial state and offset."""
    return 3 * order + 3


def _hidden(used: BoolArray) -> list[BoolArray]:
    """Used samples to hide: each part but the first alone, and each of the last half's and on.

    A model is asked to bridge a part and to run on beyond the data; either alone misjudges:
    a plant that drifts is held at both ends of a bridge. None is asked to run backwards.
    """
    part = np.where(used, (np.cumsum(used) - 1) * _PARTS // np.sum(used), -1)
    bridged = [part == i for i in range(1, _PARTS)]
    return bridged + [part >= i for i in range(_PARTS // 2, _PARTS - 1)]


def _plainest(tried: Sequence[HeldFit], errors: FloatArray) -> int:
    """Which of those as good as the best, ``errors`` (folds, tried), is plainest.

    As good: worse in the mean by no more than one standard error of the difference (Breiman
    et al. 1984, paired). Plainest: not whitened, then with fewest poles.
    """
    mean = np.mean(errors, axis=0)
    worse = errors - errors[:, [int(np.argmin(mean))]]
    standard_error = np.std(worse, axis=0, ddof=1) / np.sqrt(len(errors))
    close = np.flatnonzero(np.mean(worse, axis=0) <= standard_error)
    return int(min(close, key=lambda i: (tried[i].whitened, tried[i].order, mean[i])))


def _by_order(problem: HeldProblem, order: int) -> list[Fit]:
    """Best fits with no pole, one, … ``order``."""
    fits = [fit(problem, Structure(0, 0, False), [np.empty(0)])]
    points = StartingPoints(problem, fits[0], _NO_VOTE)
    for poles in range(1, order + 1):
        structure = Structure(poles, poles, False)
        shapes = [f.nonlinear for f in fits]
        starts = points.of(structure, fits[1:]) + _grown(shapes, len(problem.output))
        fits.append(fit(problem, structure, starts))
    return fits


def _free_runs(problem: HeldProblem, delay: int, fits: Sequence[Fit]) -> list[HeldFit]:
    """Free runs of ``fits`` as they are, and of those with poles whitened."""
    plain = [(f, False, problem.with_initial_state(f)) for f in fits]
    white = [(f, True, _efficient(problem, f)) for f in fits if f.structure.poles]
    return [
        HeldFit(f.structure.poles, delay, whitened, output) for f, whitened, output in plain + white
    ]


def _blind_runs(
    problem: HeldProblem, delay: int, fits: Sequence[Fit], hidden: BoolArray
) -> list[HeldFit]:
    """The same without the samples ``hidden``, each from where ``fits`` found its minimum."""
    rest = replace(problem, used=problem.used & ~hidden)
    return _free_runs(rest, delay, [fit(rest, f.structure, [f.nonlinear]) for f in fits])


def _grown(shapes: Sequence[FloatArray], samples: int) -> list[FloatArray]:
    """Starts for one pole more than the last of ``shapes``, that of every smaller fit.

    A pole too fast to be seen, so that richer never fits worse; and two as slow as the record
    is long: from afar, a pair of integrators is behind a crest of the error.
    """
    slow = np.log(samples / 2)
    fast = [_with_pole(shapes[-1], _FAST)]
    return fast + [_with_pole(_with_pole(shape, slow), slow) for shape in shapes[-2:-1]]


def _with_pole(shape: FloatArray, log_time: float) -> FloatArray:
    """Shape (n+1,) of the denominator of ``shape`` (n,) times 1 + e^log_time w."""
    pairs, odd = divmod(len(shape), 2)
    first, second = shape[:pairs], shape[pairs + odd :]
    if not odd:
        return np.concatenate([first, [log_time], second])
    merged = np.logaddexp(shape[pairs], log_time)
    return np.concatenate([first, [merged], second, [shape[pairs] + log_time]])


def _delayed(
    command: FloatArray, seen: FloatArray, used: BoolArray, period: float, delay: int
) -> HeldProblem:
    late = np.roll(command, delay)
    return HeldProblem(
        input=late - np.mean(late),
        output=seen,
        used=used & (np.arange(len(used)) >= delay),
        period=period,
        background=np.ones((len(seen), 1)),
        # Half way between the slowest and the fastest a sampled pole can be.
        rate=0.5 / period,
    )


def _efficient(problem: HeldProblem, fitted: Fit) -> FloatArray:
    """Output of the fit repeated with its coloured residual whitened, (n,).

    A whitening filter on both sides leaves G alone; only the initial state is found anew.
    """
    whitener, _ = autoregression(fitted.residual)
    if len(whitener) > 1:
        apart = np.arange(len(problem.used)) >= len(whitener)
        lost = np.convolve(~problem.used, np.ones(len(whitener)))[: len(problem.used)] > 0.5
        white = replace(
            problem,
            input=signal.lfilter(whitener, 1.0, problem.input),
            output=signal.lfilter(whitener, 1.0, problem.output),
            used=problem.used & apart & ~lost,
        )
        fitted = fit(white, fitted.structure, [fitted.nonlinear])
    return problem.with_initial_state(fitted)
