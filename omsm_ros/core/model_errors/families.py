"""Families of model errors: deviations of a machine from a linear, time-invariant G(s).

Each family makes columns (n, c) that it adds to the reading of the probe, per unit of its size:
metres for errors of position, a share of the response for relaxations and modes.

Backlash, and friction before sliding, depend on the reversals of the motion only, not on time. A
reversal counts once the motion has gone back by a multiple of its noise, so that stationary noise
has no effect.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from numpy.polynomial import legendre
from scipy import fft, signal

from omsm_ros.core.estimation.model_structure import Fit
from omsm_ros.core.estimation.output_error import Problem
from omsm_ros.core.estimation.steps import Steps
from omsm_ros.core.lti.transfer_function import ComplexArray
from omsm_ros.core.streams.blocks import FloatArray, IntArray

# Half width of the backlash that removes reversals of noise, in standard deviations. The remaining
# noise is far smaller than any backlash looked for; a larger width would lose reversals.
_NOISE_HALF_GAP = 2.0


def without_noise(motion: FloatArray, noise: float) -> FloatArray:
    """Return ``motion`` (n,) [m] without the reversals of ``noise`` [m], its deviation."""
    return through_backlash(motion, _NOISE_HALF_GAP * noise) if noise > 0 else motion


def _turns(motion: FloatArray) -> IntArray:
    """Return the last index (r,) of each part of ``motion`` (n,) that goes in one direction."""
    change = np.diff(motion, prepend=motion[0])
    moved = np.flatnonzero(change)
    back = change[moved] < 0
    turns = moved[np.flatnonzero(back[1:] != back[:-1])]
    return np.append(turns, len(motion) - 1)


def through_backlash(motion: FloatArray, half: float) -> FloatArray:
    """Return the output (n,) of a gap of ±``half`` [m] that ``motion`` (n,) drives."""
    turns = _turns(motion)
    return _driven(motion, half, motion[turns], turns)


def _driven(motion: FloatArray, half: float, turned: FloatArray, turns: IntArray) -> FloatArray:
    """Return the output (n,) of a gap; ``motion`` turns at values ``turned`` (r,), ``turns``."""
    # A turn clips the state to a range, and clips after one another are a clip: those of each block
    # are combined, all blocks at once.
    size = int(np.sqrt(len(turned))) + 1
    ends = np.resize(turned, (-(-len(turned) // size), size))
    low, high = ends - half, ends + half
    for k in range(1, size):
        for bound in (low, high):
            np.clip(bound[:, k - 1], ends[:, k] - half, ends[:, k] + half, out=bound[:, k])
    state, states = float(motion[0]), np.empty(ends.shape)
    for row, last_low, last_high in zip(
        states, low[:, -1].tolist(), high[:, -1].tolist(), strict=True
    ):
        row[0], state = state, min(max(state, last_low), last_high)
    np.clip(states[:, :1], low[:, :-1], high[:, :-1], out=states[:, 1:])
    held = np.repeat(states.ravel()[: len(turned)], np.diff(turns, prepend=-1))
    near = motion - half
    np.maximum(held, near, out=held)
    near += 2 * half
    return np.asarray(np.minimum(held, near, out=held))


def backlash_lead(
    motion: FloatArray, gaps: Sequence[float], every: int = 1
) -> Iterator[FloatArray]:
    """Yield the lead of ``motion`` (n,) over half of each backlash [m], and its start column.

    The start column is for the unknown first position in the backlash, until it is crossed.
    every: one in so many samples is yielded, though the motion turns at any
    """
    crossed = (np.maximum.accumulate(motion) - np.minimum.accumulate(motion))[::every]
    turns = _turns(motion)
    seen, turned, turns = motion[::every].copy(), motion[turns], turns // every
    for gap in gaps:
        yield (seen - _driven(seen, 0.5 * gap, turned, turns)) / (0.5 * gap)
        yield np.clip(1.0 - crossed / gap, 0.0, 1.0)


def dahl_friction(motion: FloatArray, travel: float) -> tuple[FloatArray, FloatArray]:
    """Return the friction force along ``motion`` (n,), -1 to 1, and the decay of its first value.

    dF/dx = (1 - F sgn v) / travel (Dahl 1968).
    """
    turns = _turns(motion)
    begun = np.append(motion[:1], motion[turns[:-1]])
    ways = np.sign(motion[turns] - begun)
    kept = np.exp(-np.abs(motion[turns] - begun) / travel)
    # Each part moves the force to kept · force + its end: those of each block are combined.
    size = int(np.sqrt(len(turns))) + 1
    shape = -(-len(turns) // size), size
    ends, kept = np.resize(ways * (1 - kept), shape), np.resize(kept, shape)
    for k in range(1, size):
        ends[:, k] += kept[:, k] * ends[:, k - 1]
        kept[:, k] *= kept[:, k - 1]
    value, before = 0.0, np.zeros((len(ends), 1))
    for row in range(1, len(ends)):
        before[row] = value = float(ends[row - 1, -1] + kept[row - 1, -1] * value)
    values = np.append(0.0, (ends + kept * before).ravel()[: len(turns) - 1])
    lengths = np.diff(turns, prepend=-1)
    begun, ways, first = (np.repeat(each, lengths) for each in (begun, ways, values))
    force = ways + (first - ways) * np.exp(-np.abs(motion - begun) / travel)
    return force, np.exp(-np.cumsum(np.abs(np.diff(motion, prepend=motion[0]))) / travel)


@dataclass(frozen=True, eq=False)
class ModelErrorTerm:
    """One model error.

    parameter: time constant [s], frequency [Hz], travel or period [m]; 0 where it has none
    trials: number of independent terms of its family, for the probability of the best
    damping: of a mode, else 0
    columns: (n, c), added to the reading per unit
    """

    family: str
    parameter: float
    trials: float
    columns: FloatArray
    damping: float = 0.0


@dataclass(frozen=True, eq=False)
class ModelErrorFamily:
    """Terms of one kind.

    part: columns (n, terms · c) of the terms from one index to another, made when they are needed:
        those of all terms of a long record take gigabytes;  width: columns of one term, c
    """

    name: str
    parameters: FloatArray
    trials: float
    part: Callable[[int, int], FloatArray]
    width: int
    dampings: FloatArray | None = None

    @classmethod
    def of(
        cls, name: str, parameters: FloatArray, trials: float, columns: FloatArray
    ) -> ModelErrorFamily:
        """Return the terms whose ``columns`` (n, terms · c) are known."""
        width = int(columns.shape[1] // len(parameters))
        return cls(name, parameters, trials, lambda a, b: columns[:, a * width : b * width], width)

    def term(self, index: int) -> ModelErrorTerm:
        """Return the term at ``index``."""
        damping = 0.0 if self.dampings is None else float(self.dampings[index])
        parameter = float(self.parameters[index])
        columns = self.part(index, index + 1)
        return ModelErrorTerm(self.name, parameter, self.trials, columns, damping)


CREEP, MODE = "creep", "soft mode"
BACKLASH, FRICTION = "backlash", "friction"
STIFFENING, LINEARITY, PERIODIC = "stiffening", "probe linearity", "periodic error"
VIBRATION, DRIFT = "vibration", "drift"

# A faster relaxation is no slower than the structure itself.
FASTEST_CREEP_S = 20e-3
# Time constants tried: a factor of 1.6 apart, neighbours differ by a few per cent.
_CREEPS_A_DECADE = 5
# Damping ratios ζ tried; a mode is 2ζ wide, which is the distance of neighbours.
_DAMPINGS = (0.03, 0.15)
# Faster modes are poles of the structure, which the choice of order finds.
FASTEST_MODE_HZ = 100.0
# Pre-sliding travels tried (Armstrong-Hélouvry 1994: some micrometres).
_SLIDING_TRAVELS_M = (0.3e-6, 0.6e-6, 1e-6, 2e-6, 4e-6, 10e-6)
# Values per sample among which a reversal is located: at 0.2 m/s² to half a nanometre.
_FINER = 8
# Backlashes tried: a motion crosses any of them in about a sample, so a few suffice.
_GAPS_M = (10e-9, 30e-9, 100e-9, 300e-9)
# Most periods in the travel: 98 µm make 1 µm, the period of a scale or an interferometer.
_MOST_CYCLES = 100
# Periods tried between neighbours; half a cycle off, half of the error would remain.
_BETWEEN_CYCLES = 37
# Factor on the number of independent periods, for those between them (Davies 1987).
_OVERLAP = 3.0
# Degrees of Legendre polynomials: from a bend to two periods over the record, where lines begin.
# Higher ones would follow a staircase, and mask a relaxation.
_DRIFT_DEGREES = (2, 3, 4, 6, 8)
# Fewest periods of a line over the record; drift has fewer.
_FEWEST_PERIODS = 2
# Lines of vibration tried at a time; the next round tries more.
_LINES_TRIED = 3


@dataclass(frozen=True, eq=False)
class ModelErrorFamilies:
    """All families of model errors for the fit ``fitted`` of ``problem``.

    slower: longest time constant of a relaxation over the duration of the record
    """

    problem: Problem
    fitted: Fit
    steps: Steps
    slower: float = 1.0

    def families(self, only: Collection[str] = ()) -> Iterator[ModelErrorFamily]:
        """Yield the families that this motion excites, or those of them named in ``only``."""
        turning = cache(self._turning)  # shared by two families, and large
        makers: dict[str, Callable[[], Iterator[ModelErrorFamily]]] = {
            CREEP: lambda: iter([self.creep()]),
            MODE: lambda: iter([self.modes()]),
            VIBRATION: lambda: iter([self.vibration()]),
            DRIFT: self.drift,
            LINEARITY: lambda: iter([self.linearity()]),
            STIFFENING: lambda: iter([self.stiffening()]),
            PERIODIC: lambda: iter([self.periodic()]),
            FRICTION: lambda: self.friction(turning),
            BACKLASH: lambda: self.backlash(turning),
        }
        for name, make in makers.items():
            if not only or name in only:
                yield from make()

    def again(self, term: ModelErrorTerm) -> ModelErrorTerm:
        """Return the ``term`` of another fit with its columns in this fit."""
        for family in self.families((term.family,)):
            for index in np.flatnonzero(family.parameters == term.parameter):
                return family.term(int(index))
        return term

    def alike(self, family: ModelErrorFamily) -> ModelErrorFamily:
        """Return the terms of ``family``, made for another fit of the record, for this fit."""
        if family.name == CREEP:
            return self.creep(family.parameters)
        if family.name == MODE and family.dampings is not None:
            pairs = zip(family.parameters.tolist(), family.dampings.tolist(), strict=True)
            return self.modes(list(pairs))
        if family.name == PERIODIC:
            return self._of_periods(family.parameters, family.trials)
        return next(f for f in self.families((family.name,)) if f.width == family.width)

    @property
    def duration(self) -> float:
        """Duration of the record [s]."""
        return len(self.problem.input) * self.problem.period

    def _in_time(self, spectra: ComplexArray) -> FloatArray:
        back = fft.irfft(spectra, self.problem.closed_length, axis=-1)
        return np.asarray(back[..., : len(self.problem.input)].T)

    @cached_property
    def _answer(self) -> ComplexArray:
        """Spectrum of the output at ``problem.s``, without the initial-condition response.

        That is known only where it reaches compared samples, and is huge before them.
        """
        return self.problem.output_spectrum(self.fitted)

    def time_constants(self) -> FloatArray:
        """Return the time constants [s] tried, up to ``slower`` durations of the record."""
        slowest = max(self.slower * self.duration, 2 * FASTEST_CREEP_S)
        decades = np.log10(slowest / FASTEST_CREEP_S)
        return np.geomspace(FASTEST_CREEP_S, slowest, max(round(_CREEPS_A_DECADE * decades), 2))

    def creep(self, time_constants: FloatArray | None = None) -> ModelErrorFamily:
        """Return ``1 - ε + ε / (1 + sτ)`` on the response, per ε, and its derivative by ln τ.

        It is computed in time and from rest, because a relaxation longer than the record depends on
        its start.
        """
        found = self.time_constants() if time_constants is None else time_constants
        answer = self._in_time(self._answer)

        def part(first: int, last: int) -> FloatArray:
            columns = []
            for step in self.problem.period / found[first:last]:
                once = low_pass_response(answer, step)
                columns += [once - answer, low_pass_response(once, step) - once]
            return np.array(columns).T

        return ModelErrorFamily(CREEP, found, 3.0, part, 2)

    def modes(self, ladder: Sequence[tuple[float, float]] = ()) -> ModelErrorFamily:
        """Return ``1 + a (M - 1)``, M a mode, and its velocity, per participation a.

        ladder: frequencies [Hz] and damping ratios; empty for all
        """
        lowest = 2 / self.duration
        highest = min(self.problem.rate / np.pi, 0.25 / self.problem.period, FASTEST_MODE_HZ)
        highest = max(highest, 2 * lowest)
        span = np.log(highest / lowest)
        found = ladder or [
            (frequency, damping)
            for damping in _DAMPINGS
            for frequency in np.geomspace(lowest, highest, int(span / (2 * damping)) + 1)
        ]

        def part(first: int, last: int) -> FloatArray:
            spectra = np.empty((last - first, 2, len(self._answer)), np.complex128)
            for rows, (frequency, damping) in zip(spectra, found[first:last], strict=True):
                s = self.problem.s * (self.problem.rate / (2 * np.pi * frequency))
                mode = self._answer / (1 + 2 * damping * s + s * s)
                rows[:] = mode - self._answer, s * mode
            return self._in_time(spectra.reshape(-1, len(self._answer)))

        frequencies, dampings = np.array(found).T
        return ModelErrorFamily(MODE, frequencies, len(found) / 2, part, 2, dampings)

    def vibration(self) -> ModelErrorFamily:
        """Return the sine and cosine at the strongest lines of the residual."""
        used = self.problem.used
        samples = len(used)
        residual = np.zeros(samples)
        residual[used] = self.fitted.residual
        length = 4 * fft.next_fast_len(samples, real=True)
        power = np.abs(fft.rfft(residual, length)) ** 2
        # The slowest lines are drift.
        power[: 4 * _FEWEST_PERIODS] = 0.0
        time = np.arange(samples) * self.problem.period
        found = []
        for _ in range(_LINES_TRIED):
            peak = int(np.argmax(power))
            found.append(_vertex(power, peak) / (length * self.problem.period))
            power[max(peak - 8, 0) : peak + 9] = 0.0
        angles = 2 * np.pi * np.asarray(found) * time[:, np.newaxis]
        columns = np.stack([np.sin(angles), np.cos(angles)], axis=2).reshape(samples, -1)
        return ModelErrorFamily.of(VIBRATION, np.asarray(found), samples / 2, columns)

    def drift(self) -> Iterator[ModelErrorFamily]:
        """Yield polynomials of time of degree 2 and more: drift, independent of the axis."""
        time = np.linspace(-1.0, 1.0, len(self.problem.input))
        columns = np.asarray(legendre.legvander(time, max(_DRIFT_DEGREES)), np.float64)
        for degree in _DRIFT_DEGREES:
            scale = np.full(1, self.duration / degree)
            yield ModelErrorFamily.of(DRIFT, scale, 1.0, np.asarray(columns[:, 2 : degree + 1]))

    def linearity(self) -> ModelErrorFamily:
        """Return square and cube of the position in the travel: the nonlinearity of the probe.

        They are of the position at the probe, with its lag: of that of the axis, a scale that
        changes by one per cent would look like one per cent of the lag.
        """
        motion, seen = self.problem.input, self._in_time(self._answer) / self.fitted.gain
        middle = 0.5 * (motion.max() + motion.min())
        place = (seen - middle) / (0.5 * np.ptp(motion) or 1.0)
        return ModelErrorFamily.of(
            LINEARITY, np.zeros(1), 1.0, np.column_stack([place**2, place**3])
        )

    def stiffening(self) -> ModelErrorFamily:
        """Return the cube of the deflection (output less input), over its largest value."""
        answer = self._in_time(self._answer)
        deflection = answer / self.fitted.gain - self.problem.input
        deflection = deflection - np.median(deflection)
        largest = float(np.max(np.abs(deflection))) or 1.0
        return ModelErrorFamily.of(
            STIFFENING, np.zeros(1), 1.0, (deflection[:, np.newaxis] / largest) ** 3
        )

    def periodic(self, near: float | None = None) -> ModelErrorFamily:
        """Return sines of the position, with periods from the whole travel to a fraction of it.

        near: a period among those [m], to have periods between it and its neighbours instead
        """
        answer = self._in_time(self._answer) / self.fitted.gain
        travel = float(np.ptp(answer)) or 1.0
        cycles = np.arange(3, _MOST_CYCLES, dtype=np.float64)
        trials = _OVERLAP * len(cycles)
        if near is not None:
            cycles = travel / near + np.linspace(-0.9, 0.9, _BETWEEN_CYCLES)
        return self._of_periods(travel / cycles, trials)

    def _of_periods(self, periods: FloatArray, trials: float) -> ModelErrorFamily:
        """Return sines of the position of ``periods`` (k,) [m], evenly spaced in their inverse."""
        angle = 2 * np.pi * self._in_time(self._answer) / self.fitted.gain
        apart = 1 / periods[1] - 1 / periods[0]

        def part(first: int, last: int) -> FloatArray:
            # Each is the one before, rotated by the same angle.
            turned, step = np.exp(1j * angle / periods[first]), np.exp(1j * apart * angle)
            rows = np.empty((2 * (last - first), len(angle)))
            for row in range(0, len(rows), 2):
                rows[row], rows[row + 1] = turned.imag, turned.real
                turned *= step
            return rows.T

        return ModelErrorFamily(PERIODIC, np.asarray(periods), trials, part, 2)

    def friction(self, turning: Callable[[], FloatArray]) -> Iterator[ModelErrorFamily]:
        """Yield Dahl's pre-sliding friction (1968) for several travels, with its unknown start."""
        if not self.steps.edges:
            return

        moved = turning()[::_FINER].copy()

        def part(first: int, last: int) -> FloatArray:
            columns = [c for t in _SLIDING_TRAVELS_M[first:last] for c in dahl_friction(moved, t)]
            return -self.fitted.gain * np.column_stack(columns)

        yield ModelErrorFamily(FRICTION, np.asarray(_SLIDING_TRAVELS_M), 2.0, part, 2)

    def _turning(self) -> FloatArray:
        """Return the position of the structure, ``_FINER`` values a sample.

        A motion reverses between samples, and backlash depends on how far it went.
        """
        length = _FINER * self.problem.closed_length
        answer = _FINER * fft.irfft(self._answer / self.fitted.gain, length)
        return without_noise(answer[: _FINER * len(self.problem.input)], self.problem.noise)

    def backlash(self, turning: Callable[[], FloatArray]) -> Iterator[ModelErrorFamily]:
        """Yield half of several backlashes, by the last reversal, with the unknown start."""
        if not self.steps.edges:
            return

        # All at once, because they share the search for reversals.
        rows = np.array(list(backlash_lead(turning(), _GAPS_M, _FINER)))
        rows *= -self.fitted.gain
        yield ModelErrorFamily.of(BACKLASH, np.asarray(_GAPS_M), 2.0, rows.T)


def _vertex(power: FloatArray, peak: int) -> float:
    """Return the place of the maximum of ``power`` (n,) near ``peak``, by a log parabola.

    Half a line off, a fifth of a sine would remain at the ends of the record.
    """
    near = power[max(peak - 1, 0) : peak + 2]
    if len(near) < 3 or np.min(near) <= 0:
        return float(peak)
    before, at, after = np.log(near)
    bend = before - 2 * at + after
    return peak + float(0.5 * (before - after) / bend) if bend < 0 else float(peak)


def low_pass_response(values: FloatArray, step: float) -> FloatArray:
    """Return ``values`` (n,) through 1 / (1 + sτ), stationary before.

    step: sample period over τ

    Between samples the values are linear.
    """
    kept = np.exp(-step)
    mean = (1 - kept) / step
    rest = values - values[0]
    filtered = signal.lfilter([1 - mean, mean - kept], [1.0, -kept], rest)
    return np.asarray(filtered + values[0])
