"""Identify from an input that is held between samples, such as a drive's own command.

A linear system behind a zero-order hold is exactly rational in z, hence also in
``w = (2/T)(z - 1)/(z + 1)``, with as many poles. So the same fit serves with w for s, and
the initial state is exact too: it is a polynomial over the same denominator.
Measured motion is not held; for that, :mod:`omsm_ros.core.identify` is the way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import fft, signal

from omsm_ros.core.confidence import autoregression
from omsm_ros.core.hankel import HankelVote
from omsm_ros.core.output_error import Fit, Problem, fit
from omsm_ros.core.records import BoolArray, FloatArray
from omsm_ros.core.starts import StartingPoints
from omsm_ros.core.structure import Structure
from omsm_ros.core.transfer_function import ComplexArray
from omsm_ros.errors import IdentificationError

_GREATEST_ORDER = 8
_FITTED_PART = 2 / 3
# Errors of a free run within this factor are alike.
_CLOSE = 1.15
_NO_VOTE = HankelVote(np.empty(0), 0, np.empty(0, np.complex128))


class HeldProblem(Problem):
    """A problem whose motion is held between samples; s is then scaled w."""

    @cached_property
    def closed_length(self) -> int:
        return len(self.motion)

    def closed_spectrum(self, values: FloatArray) -> ComplexArray:
        return np.asarray(fft.rfft(values), np.complex128)

    @cached_property
    def _spectrum(self) -> ComplexArray:
        return self.closed_spectrum(self.motion)

    @cached_property
    def s(self) -> ComplexArray:
        angle = np.pi * fft.rfftfreq(self.closed_length)
        return np.asarray(2j / self.period * np.tan(angle) / self.rate, np.complex128)

    def drives(self, structure: Structure) -> list[tuple[ComplexArray, int]]:
        """The motion, and a pulse at the first sample whose terms make any initial state.

        n of them do from the second sample on, and one more sets the first free.
        """
        pulse = np.ones(len(self.s), np.complex128)
        return [(self._spectrum, structure.zeros + 1), (pulse, structure.poles + 1)]

    def with_initial_state(self, fitted: Fit) -> FloatArray:
        """Output (n,) of a fit's dynamics, with initial state and offset fitted here."""
        lag, _ = fitted.scaled.lag(fitted.shape, self.s)
        spectra = self._driven(fitted.structure, lag)
        terms = len(fitted.numerator)
        columns = fft.irfft(spectra, self.closed_length)[:, : len(self.motion)].T
        moved = columns[:, :terms] @ fitted.driven[:terms]
        free = np.column_stack([columns[:, terms:], self.background])
        rest = (self.seen - moved)[self.used]
        state = np.linalg.lstsq(free[self.used], rest, rcond=None)[0]
        return np.asarray(moved + free @ state)


@dataclass(frozen=True, eq=False)
class HeldFit:
    """order: poles;  delay: whole samples;  whitened: fitted with its residual made white
    output: what the model says is seen (n,), a free run from its initial state
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
    order: int = 0,
    delays: Sequence[int] = (0,),
) -> HeldFit:
    """Fit ``seen`` (n,) where ``used`` (n,) from a ``command`` (n,) held over ``period`` [s].

    order: number of poles, 0 to choose it;  delays: whole samples to try. Both, and whether
    to whiten the residual, are judged by a free run over the last third of the used
    samples, fitted without it: whitening is efficient for a model that holds all the
    dynamics, and harmful for one that cannot.

    Raises IdentificationError when too few samples are used or one is not finite.
    """
    finite = np.all(np.isfinite(command)) and np.all(np.isfinite(seen[used]))
    if not (np.sum(used) > 4 * _GREATEST_ORDER and finite):
        raise IdentificationError(
            f"{int(np.sum(used))!r} samples are used, more than {4 * _GREATEST_ORDER} finite "
            "ones are needed"
        )
    orders = [order] if order else range(1, _GREATEST_ORDER + 1)
    check = used & (np.cumsum(used) > _FITTED_PART * np.sum(used))

    def judged(found: HeldFit) -> float:
        return float(np.sum((seen - found.output)[check] ** 2))

    tried = [
        found
        for delay in delays
        for found in _by_order(command, seen, used & ~check, period, delay, orders)
    ]
    best = _simplest(tried, [judged(found) for found in tried])
    again = _by_order(command, seen, used, period, best.delay, [best.order])
    return next(found for found in again if found.whitened == best.whitened)


def _simplest(tried: Sequence[HeldFit], errors: Sequence[float]) -> HeldFit:
    """The plainest of those that come close to the best: not whitened, then fewest poles."""
    limit = _CLOSE * min(errors)
    close = [f for f, error in zip(tried, errors, strict=True) if error <= limit]
    return min(close, key=lambda f: (f.whitened, f.order, f.delay))


def _by_order(
    command: FloatArray,
    seen: FloatArray,
    used: BoolArray,
    period: float,
    delay: int,
    orders: Sequence[int],
) -> list[HeldFit]:
    centre = float(np.mean(seen[used]))
    problem = _delayed(command, np.where(used, seen - centre, 0.0), used, period, delay)
    static = fit(problem, Structure(0, 0, False), [np.empty(0)])
    points = StartingPoints(problem, static, _NO_VOTE)
    fits: list[Fit] = []
    for poles in range(1, max(orders) + 1):
        structure = Structure(poles, poles, False)
        fits.append(fit(problem, structure, points.of(structure, fits)))
    wanted = [f for f in fits if f.structure.poles in orders]
    return [
        HeldFit(f.structure.poles, delay, whitened, output(f) + centre)
        for f in wanted
        for whitened, output in (
            (False, problem.with_initial_state),
            (True, lambda g: _efficient(problem, g)),
        )
    ]


def _delayed(
    command: FloatArray, seen: FloatArray, used: BoolArray, period: float, delay: int
) -> HeldProblem:
    late = np.roll(command, delay)
    return HeldProblem(
        motion=late - np.mean(late),
        seen=seen,
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
            motion=signal.lfilter(whitener, 1.0, problem.motion),
            seen=signal.lfilter(whitener, 1.0, problem.seen),
            used=problem.used & apart & ~lost,
        )
        fitted = fit(white, fitted.structure, [fitted.shape])
    return problem.with_initial_state(fitted)
