"""Fit parallel sections to sampled records by the error of the simulated output.

All records share the sections; each has its own initial state and offset. Those and the numerators
enter linearly and are eliminated (variable projection, Golub and Pereyra 1973), the states of each
record first. Model and data are compared in time, so missing samples of the output do not count.

Starting points are of two kinds. One is poles by vector fitting of the spectra of input and output
(Gustavsen and Semlyen 1999), with the transients of the record as further residues. The other is
the poles of a smaller fit, with pairs added at the lines at which its residual is largest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import fft, linalg, ndimage, signal

from omsm_ros.core.estimation.covariance import noise_before_fit, weighted_gram
from omsm_ros.core.estimation.impulse_response import AVERAGED_LINES, coherent_power
from omsm_ros.core.estimation.model_structure import ScaledStructure
from omsm_ros.core.estimation.optimisation import Projection, descend
from omsm_ros.core.estimation.parallel_sections import (
    BAND_LIMITED,
    ParallelSections,
    basis_of,
    closed_inputs,
    orthogonal_decays,
    recursion,
    relocated,
    sections_of,
    slowed,
    stacked,
    variable,
)
from omsm_ros.core.lti.transfer_function import ComplexArray, Structure
from omsm_ros.core.streams.blocks import BoolArray, FloatArray, IntArray
from omsm_ros.linear_algebra import inverse_gram, inverse_root, without_copy

# Unit of w inside a fit, in 1/T: the middle of the range of sampled poles.
RATE = 0.5
# Twice half the sampling rate, as w inside a fit: samples show no faster pole.
_FASTEST = 2 * np.pi / RATE
# Least share of the largest power at which a line is excited.
_EXCITED = 1e-3
# Most lines of one record for vector fitting, evenly among the excited ones.
_MOST_LINES = 4000
# Iterations of vector fitting: by then it has converged, or will not.
_RELOCATIONS = 10
# Damping ratio of pairs at a start, those that are tried for a line of the residual, and the lines.
_START_DAMPING, _ADDED_DAMPINGS, _TRIED_LINES = 0.05, (0.002, 0.01, 0.05), 40


@dataclass(frozen=True, eq=False)
class SampledRecord:
    """Samples of inputs (n, m) and output (n,), evenly spaced; ``used`` where the output counts."""

    inputs: FloatArray
    output: FloatArray
    used: BoolArray

    def __len__(self) -> int:
        return len(self.output)

    def filled(self) -> FloatArray:
        """Return the output (n,), interpolated where it does not count."""
        index = np.arange(len(self))
        return np.asarray(np.interp(index, index[self.used], self.output[self.used]))

    def part(self, part: slice) -> SampledRecord:
        """Return the samples of ``part``."""
        return SampledRecord(self.inputs[part], self.output[part], self.used[part])


@dataclass(frozen=True, eq=False)
class _Spectra:
    """One record in a fit: about its means, its inputs as spectra (m, k) at w (k,)."""

    record: SampledRecord
    hold: str

    @cached_property
    def places(self) -> IntArray:
        return np.flatnonzero(self.record.used)

    @cached_property
    def output(self) -> FloatArray:
        known = self.record.output[self.places]
        return np.asarray(known - np.mean(known), np.float64)

    @cached_property
    def length(self) -> int:
        return int(fft.next_fast_len(self._closed.shape[1], real=True))

    @cached_property
    def _closed(self) -> FloatArray:
        return closed_inputs(self.record.inputs - np.mean(self.record.inputs, axis=0), self.hold)

    @cached_property
    def inputs(self) -> ComplexArray:
        return np.asarray(fft.rfft(self._closed, self.length), np.complex128)

    @cached_property
    def angle(self) -> FloatArray:
        return np.asarray(2 * np.pi * fft.rfftfreq(self.length), np.float64)

    @cached_property
    def w(self) -> ComplexArray:
        return variable(self.hold, self.angle / (2 * np.pi)) / RATE

    def in_time(self, spectra: ComplexArray) -> FloatArray:
        """Return ``spectra`` (…, k) at the compared samples, without means, (…, places)."""
        found = np.asarray(fft.irfft(spectra, self.length)[..., without_copy(self.places)])
        found -= np.mean(found, axis=-1, keepdims=True)
        return found

    @cached_property
    def excited(self) -> tuple[FloatArray, ComplexArray, ComplexArray]:
        """Angles at which the inputs have power, their spectra there and that of the output.

        Where their power is small, an output that follows them counts. The spectra are those of
        the record as it is, without a bridge, whose output is not known.
        """
        inputs = self.record.inputs - np.mean(self.record.inputs, axis=0)
        spectra = np.asarray(fft.rfft(inputs.T), np.complex128)
        power = ndimage.uniform_filter1d(np.sum(np.abs(spectra) ** 2, axis=0), AVERAGED_LINES)
        filled = self.record.filled()
        follows = coherent_power(inputs, filled)
        excited = (v[1:-1] > _EXCITED * np.max(v[1:-1]) for v in (power, follows))
        lines = np.flatnonzero(np.logical_or(*excited)) + 1
        lines = lines[np.linspace(0, len(lines) - 1, min(len(lines), _MOST_LINES)).astype(int)]
        angle = 2 * np.pi * lines / len(self.record)
        return angle, spectra[:, lines], np.asarray(fft.rfft(filled)[lines], np.complex128)


@dataclass(frozen=True, eq=False)
class SectionsFit:
    """Sections fitted to the records of ``problem``.

    nonlinear: logarithms of d1 of each section, of d2 of each pair, then the delays [RATE/T]
    linear: (m, 1 + k), direct term and numerators of each input;  residual: (all places,)
    """

    problem: SectionsProblem
    order: int
    nonlinear: FloatArray
    linear: FloatArray
    residual: FloatArray

    @property
    def sections(self) -> FloatArray:
        """Return d1, d2 of each section (k, 2), scaled."""
        return sections_of(self.nonlinear, self.order)

    def on_grids(self) -> list[FloatArray]:
        """Return the residual of each record (n,), 0 where it is not compared."""
        grids, start = [], 0
        for one in self.problem.spectra:
            grids.append(np.zeros(len(one.record)))
            grids[-1][one.places] = self.residual[start : start + len(one.places)]
            start += len(one.places)
        return grids

    def gram(self) -> FloatArray:
        """Return the products of the columns of ``linear``, without the free ones, (q, q)."""
        own = [_Columns(self.problem, s, self.nonlinear, self.order) for s in self.problem.spectra]
        return np.asarray(sum(p.rows @ p.rows.T - p.along @ p.along.T for p in own))

    def roots(self) -> ComplexArray:
        """Return the poles in w, scaled, (n,)."""
        return self.model().roots() / RATE

    def model(self, period: float = 1.0, covariance: FloatArray | None = None) -> ParallelSections:
        """Return the fit as a model in seconds."""
        unit = RATE / period
        ups = np.zeros((len(self.linear), *self.sections.shape))
        ups[:, _numerator_places(self.sections)] = self.linear[:, 1:]
        return ParallelSections(
            hold=self.problem.hold,
            period=period,
            denominators=self.sections / [unit, unit**2],
            numerators=ups / [1.0, unit],
            direct=self.linear[:, 0].copy(),
            delays=self.problem.late(self.nonlinear, self.order) * period,
            covariance=covariance,
        )


@dataclass(frozen=True, eq=False)
class SectionsProblem:
    """Records to be fitted together.

    delays: whole samples (m,) of a held input, 0 of a band-limited one, whose delays are free
    """

    records: Sequence[SampledRecord]
    hold: str
    delays: IntArray

    @cached_property
    def spectra(self) -> list[_Spectra]:
        """The records up to their last used sample, as spectra.

        Samples that answer to inputs before the record do not count.
        """
        first = int(np.max(self.delays)) + 1 if self.hold != BAND_LIMITED else 0
        counted = [replace(r, used=r.used & (np.arange(len(r)) >= first)) for r in self.records]
        return [
            _Spectra(r.part(slice(int(np.flatnonzero(r.used)[-1]) + 1)), self.hold) for r in counted
        ]

    @property
    def inputs(self) -> int:
        """Return the number of inputs."""
        return int(self.records[0].inputs.shape[1])

    def late(self, nonlinear: FloatArray, order: int) -> FloatArray:
        """Return the delay of each input [samples], (m,)."""
        found = nonlinear[order:] / RATE if self.hold == BAND_LIMITED else self.delays
        return np.asarray(found, np.float64)

    def box(self, order: int) -> tuple[FloatArray, FloatArray]:
        """Return the bounds of the nonlinear parameters."""
        lower, upper = ScaledStructure(Structure(order, order, False), RATE).bounds()
        if self.hold != BAND_LIMITED:
            return lower, upper
        lower[order // 2 :] = -np.log(_FASTEST)
        lower[order - order // 2 :] *= 2
        longest = np.full(self.inputs, max(len(record) for record in self.records) / 4 * RATE)
        return np.pad(lower, (0, self.inputs)), np.append(upper, longest)

    def project(self, nonlinear: FloatArray, order: int) -> Projection:
        """Return the residual after the linear parameters are eliminated."""
        parts = [_Columns(self, one, nonlinear, order) for one in self.spectra]
        grams = [part.rows @ part.rows.T - part.along @ part.along.T for part in parts]
        inverse = inverse_gram(np.sum(grams, axis=0))
        left = [part.without_free(part.one.output.copy()) for part in parts]
        linear = np.zeros(len(inverse))
        # Refined once, because the inverse has the squared condition of the columns.
        for _ in range(2):
            pairs = list(zip(parts, left, strict=True))
            change = inverse @ np.sum([part.rows @ rest for part, rest in pairs], axis=0)
            left = [part.without_free(rest - change @ part.rows) for part, rest in pairs]
            linear += change

        def normal() -> tuple[FloatArray, FloatArray]:
            each = [(part, part.slopes(linear.reshape(self.inputs, -1))) for part in parts]
            own = [part.along_free(slopes) for part, slopes in each]
            mixed = [
                slopes @ part.rows.T - along @ part.along.T
                for (part, slopes), along in zip(each, own, strict=True)
            ]
            share = np.sum(mixed, axis=0) @ inverse
            slope = -np.sum([s @ rest for (_, s), rest in zip(each, left, strict=True)], axis=0)
            for (part, slopes), along in zip(each, own, strict=True):
                slopes -= share @ part.rows
                part.add_free(share @ part.along - along, slopes)
            return slope, np.sum([slopes @ slopes.T for _, slopes in each], axis=0)

        return Projection(nonlinear, np.concatenate(left), linear, normal)

    def fit(self, order: int, starts: Sequence[FloatArray], evaluations: int = 40) -> SectionsFit:
        """Return the best of the fits that a few iterations reach from ``starts``."""
        box = self.box(order)

        def project(nonlinear: FloatArray) -> Projection:
            if self.hold == BAND_LIMITED:
                nonlinear = np.clip(slowed(nonlinear, order, _FASTEST), *box)
            return self.project(nonlinear, order)

        tried = [descend(project, project(s), box, evaluations) for s in starts]
        best = min(tried, key=lambda one: float(one.residual @ one.residual))
        linear = best.linear.reshape(self.inputs, -1)
        return SectionsFit(self, order, best.nonlinear, linear, best.residual)

    def nonlinear_of(self, poles: ComplexArray, late: FloatArray) -> FloatArray:
        """Return the nonlinear parameters: stable ``poles`` in w, scaled, delays [samples]."""
        scaled = ScaledStructure(Structure(len(poles), len(poles), False), RATE)
        tail = late * RATE if self.hold == BAND_LIMITED else np.empty(0)
        return np.concatenate([scaled.nonlinear_of(poles, 0.0), tail])

    def spread_start(self, order: int, late: FloatArray) -> FloatArray:
        """Return the nonlinear parameters that vector fitting reaches from spread poles.

        late: delays [samples]
        """
        data = []
        for one in self.spectra:
            angle, drives, output = one.excited
            w = variable(self.hold, angle / (2 * np.pi)) / RATE
            data.append((w, drives * np.exp(-1j * angle * late[:, np.newaxis]), output))
        # Lightly damped pairs over the excited lines.
        low = min(abs(w[0]) for w, *_ in data)
        high = min(max(abs(w[-1]) for w, *_ in data), 8 / RATE)
        even, ratios = (make(low, high, order // 2 + 2) for make in (np.linspace, np.geomspace))
        upper = np.sqrt(even * ratios)[1:-1] * (1j - _START_DAMPING)
        single = np.full(order % 2, -np.sqrt(low * high))
        poles = np.concatenate([upper, np.conj(upper), single])
        for _ in range(_RELOCATIONS):
            poles = relocated(poles, data)
        return self.nonlinear_of(poles, late)

    def covariance(self, fitted: SectionsFit, period: float) -> FloatArray:
        """Return the covariance (p, p) of the parameters of ``fitted.model(period)``.

        It is the sandwich of the least squares in coloured noise, with the autocovariance of the
        residual of each record, and a random walk where that shows one.
        """
        parts = [_Columns(self, one, fitted.nonlinear, fitted.order) for one in self.spectra]
        columns = [
            part.without_free(np.concatenate([part.rows, part.slopes(fitted.linear)]))
            for part in parts
        ]
        gram = np.sum([each @ each.T for each in columns], axis=0)
        # A direction lost in rounding is as uncertain as the weakest.
        root, score = inverse_root(gram, keep=True), np.zeros_like(gram)
        for part, missed in zip(parts, fitted.on_grids(), strict=True):
            one, basis = part.one, root.T @ columns.pop(0)
            length = 2 * fft.next_fast_len(len(missed) // 2 + 32, real=True)
            # An orthonormal basis of the responses to initial states and the offset.
            after = len(one.places) - part.free.shape[1]
            free = np.pad(part.free, ((0, 1), (0, after))) - np.append(part.mean, -1)[:, None]
            free = linalg.block_diag(part.root, len(one.places) ** -0.5).T @ free
            followed, used = np.concatenate([basis, free]), one.record.used
            noise = noise_before_fit(missed[used], followed, used, length)
            on_grid = np.zeros((len(basis), len(missed)))
            on_grid[:, used] = basis
            score += weighted_gram(fft.rfft(on_grid, length), length, noise)
        turn = self._coefficient_jacobian(fitted, RATE / period) @ root
        found = turn @ score @ turn.T
        return np.asarray(0.5 * (found + found.T))

    def _coefficient_jacobian(self, fitted: SectionsFit, unit: float) -> FloatArray:
        """Return d(parameters of the model)/d(linear, nonlinear); unit: of w [1/s]."""
        size, sections, inputs = fitted.linear.size, fitted.sections, self.inputs
        count, pairs = len(sections), int(np.sum(sections[:, 1] > 0))
        numerators = inputs * (1 + 2 * count)
        turn = np.zeros((numerators + 2 * count + inputs, size + len(fitted.nonlinear)))
        scale = np.append(1.0, np.tile([1.0, 1 / unit], count))
        kept = np.append(True, _numerator_places(sections))
        turn[np.flatnonzero(np.tile(kept, inputs)), np.arange(size)] = np.tile(scale[kept], inputs)
        down = np.arange(numerators, numerators + 2 * count, 2)
        turn[down, size + np.arange(count)] = sections[:, 0] / unit
        turn[down[:pairs] + 1, size + count + np.arange(pairs)] = sections[:pairs, 1] / unit**2
        if self.hold == BAND_LIMITED:
            turn[-inputs:, size + fitted.order :] = np.eye(inputs) / unit
        return turn


@dataclass(frozen=True, eq=False)
class _Columns:
    """The columns of one record at one ψ: driven ones, responses to initial states, an offset.

    rows: the driven ones, without means, (m + mn, places)
    free: responses to initial states at the first places, (q, e);  mean: over all places, (q,)
    root: (q, r), with which they have products of one, orthogonal to the offset
    """

    problem: SectionsProblem
    one: _Spectra
    nonlinear: FloatArray
    order: int

    @cached_property
    def drives(self) -> ComplexArray:
        """The delayed inputs, (m, k)."""
        late, one = self.problem.late(self.nonlinear, self.order)[:, np.newaxis], self.one
        return one.inputs * np.exp(-1j * one.angle * late) if np.any(late) else one.inputs

    @cached_property
    def _sections(self) -> FloatArray:
        return sections_of(self.nonlinear, self.order)

    @cached_property
    def _basis(self) -> ComplexArray:
        return basis_of(self._sections, self.one.w)

    @cached_property
    def rows(self) -> FloatArray:
        driven = self.drives[:, np.newaxis] * self._basis
        return self.one.in_time(driven.reshape(-1, len(self.one.w)))

    @cached_property
    def free(self) -> FloatArray:
        one, sections = self.one, self._sections
        downs = [recursion(d1 / RATE, d2 / RATE**2, one.hold, 1.0) for d1, d2 in sections]
        first, last = np.array([(*down[1:], 0.0)[:2] for down in downs]).reshape(-1, 2).T
        apart = np.sqrt(first**2 / 4 - last + 0j)
        slowest = np.max(np.abs([apart - first / 2, apart + first / 2]), initial=0.0)
        # Until even the slowest has decayed to rounding, e^-36; each can delay it by two decays.
        decays = (36 + 2 * self.order) / -np.log(np.clip(slowest, 1e-9, 1 - 1e-9))
        rows = orthogonal_decays(downs, min(int(decays) + 2, len(one.record)))
        return rows[:, without_copy(one.places[one.places < rows.shape[1]])]

    @cached_property
    def mean(self) -> FloatArray:
        return np.asarray(np.sum(self.free, axis=1) / len(self.one.places))

    @cached_property
    def root(self) -> FloatArray:
        offset = len(self.one.places) * np.outer(self.mean, self.mean)
        return inverse_root(self.free @ self.free.T - offset)

    @cached_property
    def along(self) -> FloatArray:
        """Coordinates (m + mn, r) of the driven columns along the free responses."""
        return self.along_free(self.rows)

    def along_free(self, values: FloatArray) -> FloatArray:
        """Return the coordinates (…, r) of ``values`` (…, places) without mean."""
        return np.asarray((values[..., : self.free.shape[1]] @ self.free.T) @ self.root)

    def add_free(self, along: FloatArray, values: FloatArray) -> None:
        """Add what has the coordinates ``along`` (…, r) to ``values`` (…, places)."""
        size = along @ self.root.T
        values[..., : self.free.shape[1]] += size @ self.free
        values -= (size @ self.mean)[..., np.newaxis]

    def without_free(self, values: FloatArray) -> FloatArray:
        """Make ``values`` (…, places) without mean orthogonal to them; return the same array."""
        self.add_free(-self.along_free(values), values)
        return values

    def slopes(self, linear: FloatArray) -> FloatArray:
        """Return d output / d nonlinear (p, places) at the ``linear`` parameters (m, 1 + n)."""
        one, sections, basis = self.one, self._sections, self._basis
        count, place = len(sections), 1
        found = np.empty((len(self.nonlinear), len(one.w)), np.complex128)
        # One section at a time, because its rows stay in the cache.
        for i, (d1, d2) in enumerate(sections):
            part = linear[:, place] @ self.drives
            if d2 > 0:
                part += one.w * (linear[:, place + 1] @ self.drives)
            part *= basis[place] * basis[place] * one.w
            np.multiply(-d1, part, out=found[i])
            if d2 > 0:
                np.multiply(-d2 * one.w, part, out=found[count + i])
            place += 1 + (d2 > 0)
        if one.hold == BAND_LIMITED:
            found[self.order :] = -1j * one.angle / RATE * (linear @ basis) * self.drives
        return one.in_time(found)


def _numerator_places(sections: FloatArray) -> BoolArray:
    """Return which of b0 and b1 each section has, (k, 2): a single pole has no b1."""
    return np.column_stack([np.full(len(sections), True), sections[:, 1] > 0])


def grown_starts(problem: SectionsProblem, smaller: SectionsFit, order: int) -> list[ComplexArray]:
    """Return starts, poles (order,) in w: of ``smaller``, and fast, slow or missing ones."""
    more, own = order - smaller.order, smaller.roots()
    fast = -5 / RATE * 1.5 ** np.arange(more)  # too fast to matter
    slowest = -1 / (0.5 * max(len(r) for r in problem.records) * RATE)
    found = [np.concatenate([own, fast]), np.concatenate([own, slowest * 1.5 ** np.arange(more)])]
    upper = _missing_pairs(problem, smaller, more // 2)
    if len(upper):
        found.append(np.concatenate([own, upper, np.conj(upper), fast[: more - 2 * len(upper)]]))
    return [np.asarray(poles, np.complex128) for poles in found]


def _missing_pairs(problem: SectionsProblem, fitted: SectionsFit, count: int) -> ComplexArray:
    """Return upper poles (≤ count,), in w, whose responses to the inputs explain most residual.

    They are chosen one by one at the lines of the largest residual of the longest record, because
    a disturbance or distortion may be stronger there than a mode that is missing.
    """
    index = int(np.argmax([len(one.places) for one in problem.spectra]))
    one = problem.spectra[index]
    spectrum = np.asarray(fft.rfft(fitted.on_grids()[index], one.length), np.complex128)
    power, shown = ndimage.uniform_filter1d(np.abs(spectrum) ** 2, 15), one.excited[0][[0, -1]]
    power[(one.angle < shown[0]) | (one.angle > shown[1])] = 0.0
    drives = _Columns(problem, one, fitted.nonlinear, fitted.order).drives[:, np.newaxis]
    peaks, tried = signal.find_peaks(power, distance=10)[0], []
    for line in peaks[np.argsort(power[peaks])[::-1][:_TRIED_LINES]] if count else ():
        rate = abs(one.w[line])
        for damping in _ADDED_DAMPINGS:
            basis = basis_of(np.array([[2 * damping / rate, 1 / rate**2]]), one.w)[1:]
            rows = stacked((drives * basis).reshape(-1, len(one.w)))
            tried.append((rate * (1j - damping), rows, inverse_gram(rows @ rows.T)))
    left, found = stacked(spectrum[np.newaxis])[0], []
    for _ in range(count if tried else 0):
        along = [rows @ left for _, rows, _ in tried]
        best = int(np.argmax([a @ one[2] @ a for a, one in zip(along, tried, strict=True)]))
        pole, rows, inverse = tried[best]
        left = left - (inverse @ along[best]) @ rows
        found.append(pole)
    return np.array(found, np.complex128)
