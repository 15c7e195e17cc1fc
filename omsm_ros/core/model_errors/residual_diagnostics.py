"""Score tests of a residual: model errors, and differences between parts of a step test.

The score test (Rao 1948) of a term projects its columns orthogonally to those of the fitted
parameters, and the residual on the rest. The variance is that of the spectrum of the residual
*without* the term, because a large term would otherwise count as noise.

A linear, time-invariant response has one lag and one gain. A contrast lets them differ between two
parts of the test (steps up and down, small and large, early and late) by ``±d`` and tests d.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from math import inf, log

import numpy as np
from scipy import fft, special

from omsm_ros.core.calibration.certificate import PartsCompared
from omsm_ros.core.estimation.covariance import noise_spectrum, weighted_gram
from omsm_ros.core.estimation.model_order import ABOVE_CONTENT, coarser
from omsm_ros.core.estimation.model_structure import Fit
from omsm_ros.core.estimation.noise import RandomWalk, scatter_in_time, uneven_rows, with_walk
from omsm_ros.core.estimation.output_error import ENOUGH_SAMPLES, Problem
from omsm_ros.core.estimation.steps import Edge, Steps, segments
from omsm_ros.core.lti.transfer_function import ComplexArray
from omsm_ros.core.model_errors.families import (
    BACKLASH,
    CREEP,
    DRIFT,
    FASTEST_MODE_HZ,
    FRICTION,
    MODE,
    PERIODIC,
    VIBRATION,
    ModelErrorFamilies,
    ModelErrorFamily,
    ModelErrorTerm,
)
from omsm_ros.core.streams.blocks import FloatArray, IntArray
from omsm_ros.linear_algebra import BLOCK_ROWS, BLOCK_VALUES, basis_and_inverse, inverse_root

# A column with a weaker remainder is collinear with the fitted parameters but for rounding.
_COLLINEAR_SHARE = 1e-4
# Directions this much weaker than the strongest are rounding.
_SPANNED = 1e-9
# Fewest lines over which noise is averaged: its level is then known to a quarter,
_LEAST_LINES = 8
# and the factor of frequency on either side where lines are dense, half an octave.
_HALF_WIDTH = 2**0.5


@dataclass(frozen=True, eq=False)
class Score:
    """Score test of one term without the correction for the number of terms.

    size: its coefficients (c,), and covariance (c, c) of them
    chi_square: of the hypothesis that they are zero
    degrees: number of coefficients that are not collinear with the fit
    """

    size: FloatArray
    covariance: FloatArray
    chi_square: float
    degrees: int

    @property
    def log_p(self) -> float:
        """Return ln of the probability of ``chi_square`` or more if the term is absent."""
        p = float(special.chdtrc(self.degrees, self.chi_square)) if self.degrees else 1.0
        return log(p) if p > 0 else -inf

    @property
    def uncertainty(self) -> float:
        """Return the standard uncertainty of the first coefficient, infinite if unknown."""
        return float(np.sqrt(self.covariance[0, 0]))


@dataclass(frozen=True, eq=False)
class ResidualSpace:
    """The residual of ``fitted``, orthogonal to the columns of its parameters."""

    problem: Problem
    fitted: Fit

    @cached_property
    def _basis(self) -> FloatArray:
        return self._decomposed[0]

    @cached_property
    def _decomposed(self) -> tuple[FloatArray, FloatArray]:
        """A basis (k, r) of the columns of the parameters, and its parameters (p, r)."""
        return basis_and_inverse(self.problem.sensitivity(self.fitted), _SPANNED)

    def collinear_parameters(self, column: FloatArray) -> FloatArray:
        """Return the parameters (p,) nearest to ``column`` (n,) over the compared samples."""
        basis, parameters = self._decomposed
        return np.asarray(parameters @ (basis.T @ column[self.problem.used]))

    def _free(self, rows: FloatArray) -> None:
        kept = self.problem.kept
        # A few rows at a time: the remainder of many would double the memory of a long record.
        for part in np.array_split(rows, -(-rows.size // BLOCK_VALUES)):
            inside = part[:, kept]
            part[:, kept] = inside - (inside @ self._basis) @ self._basis.T

    def screen(self, columns: FloatArray, terms: int) -> FloatArray:
        """Return χ² in white noise of each group of ``terms`` neighbouring columns of (n, c).

        It finds the best of many terms; :meth:`score` then tests it.
        """
        compared = columns.T[:, self.problem.kept]
        if compared.strides[1] != compared.itemsize:  # each in one piece
            compared = np.ascontiguousarray(compared)
        moment = (compared @ self.fitted.residual).reshape(-1, terms)
        whole, collinear = (
            rows.reshape(len(moment), terms, -1) for rows in (compared, compared @ self._basis)
        )
        gram = whole @ whole.transpose(0, 2, 1) - collinear @ collinear.transpose(0, 2, 1)
        inverse = np.linalg.pinv(gram, rcond=_COLLINEAR_SHARE, hermitian=True)
        explained = np.einsum("gi,gij,gj->g", moment, inverse, moment)
        return np.asarray(explained / (self.fitted.sum_of_squares / self.fitted.samples))

    def score(self, columns: FloatArray, family: str = "") -> Score:
        """Test the term of ``columns`` (n, c) of ``family``, all its coefficients together."""
        return self.judged(columns.T.copy(), family)

    def judged(self, rows: FloatArray, family: str = "") -> Score:
        """Test the term whose columns are ``rows`` (c, n), which are overwritten."""
        rows[:, ~self.problem.used] = 0.0
        before = _lengths(rows)
        self._free(rows)
        unit = _lengths(rows)
        free = unit > _COLLINEAR_SHARE * np.where(before > 0, before, 1.0)
        terms = len(rows)
        size, covariance = np.zeros(terms), np.diag(np.full(terms, np.inf))
        if not np.any(free):
            return Score(size, covariance, 0.0, 0)
        rows, unit = rows[free] if not np.all(free) else rows, unit[free]
        rows /= unit[:, np.newaxis]
        values, directions = np.linalg.eigh(rows @ rows.T)
        kept = values > _COLLINEAR_SHARE**2 * values[-1]
        inverse = directions[:, kept] / values[kept] @ directions[:, kept].T
        found = inverse @ (rows @ self._residual)
        walk = explained = 0.0
        # Drift is what walks.
        if self._walk is not None and family != DRIFT:
            walk, explained = self._walk.variance(self._residual, rows)
        spread = inverse @ self._noise_of(rows, found, walk) @ inverse.T
        chi_square = float(np.sum((found @ inverse_root(spread, _SPANNED)) ** 2))
        size[free] = found / unit
        covariance[np.ix_(free, free)] = spread / np.outer(unit, unit)
        # Rounding that is common to a plateau would count as a walk, which the rows explain.
        explained *= self.problem.shared == 0
        return Score(size, covariance, max(chi_square, explained), int(np.sum(kept)))

    @cached_property
    def _residual(self) -> FloatArray:
        return self.problem.on_grid(self.fitted.residual, 0.0)

    @cached_property
    def _spectra(self) -> list[ComplexArray]:
        """The transform of the residual of each recording."""
        parts = [self._residual[part] for part in self.problem.recordings]
        return [fft.rfft(part, fft.next_fast_len(len(part), real=True)) for part in parts]

    def _noise_of(self, rows: FloatArray, found: FloatArray, walk: float) -> FloatArray:
        """Return the covariance (c, c) of noise times ``rows`` (c, n).

        walk: variance per sample of the increments of a random walk in it

        The noise is the residual without ``rows`` times ``found`` (c,).
        """
        used, even = self.problem.used, np.zeros((len(rows), len(rows)))
        missed = self._residual - found @ rows
        # Each recording has noise of its own.
        for part, before in zip(self.problem.recordings, self._spectra, strict=True):
            length = fft.next_fast_len(part.stop - part.start, real=True)
            spectra = fft.rfft(rows[:, part], length)
            own = missed[part][used[part]]
            noise = smooth_noise_spectrum(own, before - found @ spectra, length)
            noise *= self.fitted.samples / max(self.fitted.samples - self.fitted.size, 1)
            even += weighted_gram(spectra, length, with_walk(noise, walk, length))
        if self._scatter == 0 and self.problem.shared == self.problem.input_error == 0:
            return even
        uneven = uneven_rows(self.problem, rows[:, used].T, self._scatter)
        return np.asarray(even + uneven.T @ uneven)

    @cached_property
    def _walk(self) -> RandomWalk | None:
        """A random walk in the residual, None where it shows none."""
        walk = RandomWalk.of(self.problem.used, self._basis, self.problem.recordings)
        return walk if walk.variance(self._residual)[0] > 0 else None

    @cached_property
    def _scatter(self) -> float:
        return scatter_in_time(self.problem, self.fitted.residual)


def _lengths(rows: FloatArray) -> FloatArray:
    """Return the lengths (c,) of ``rows`` (c, n), in less memory than numpy's norm."""
    return np.asarray(np.sqrt(np.einsum("cn,cn->c", rows, rows)))


def smooth_noise_spectrum(residual: FloatArray, spectrum: ComplexArray, length: int) -> FloatArray:
    """Return the variance spectrum of ``residual`` (k,) at ``length`` // 2 + 1 frequencies.

    spectrum: transform of it, 0 where nothing is compared, filled to ``length``

    It is the larger of an autoregressive spectrum, which misses slow drift, and of the periodogram
    smoothed over an octave, which does not.
    """
    power = (spectrum.real**2 + spectrum.imag**2) / len(residual)
    low, high = _octaves(len(power))
    total = np.concatenate([[0.0], np.cumsum(power)])
    smooth = (total[high] - total[low]) / np.maximum(high - low, 1)
    return np.asarray(np.maximum(smooth, noise_spectrum(residual, length)))


@lru_cache(maxsize=2)
def _octaves(lines: int) -> tuple[IntArray, IntArray]:
    """Return the first of ``lines`` lines near each, and the end of those near it."""
    line = np.arange(lines)
    low = np.minimum(line / _HALF_WIDTH, line - _LEAST_LINES / 2).astype(int)
    low = np.clip(low, 1, max(lines - _LEAST_LINES, 1))
    high = np.maximum(line * _HALF_WIDTH, low + _LEAST_LINES).astype(int)
    return low, np.minimum(high, lines)


# Probability of a false alarm of one family; that of ten families is 1e-3.
FALSE_ALARM = 1e-4
# Lags [samples] tested for correlation, as resid of the System Identification Toolbox takes.
LAGS = 25
# Largest share of moving samples of a step test that is decimated.
_MOSTLY = 0.5
# Families tested with all samples: reversals and lines need them, and their terms are few.
_BY_ALL = (VIBRATION, BACKLASH, FRICTION)


@dataclass(frozen=True, eq=False)
class ScoreTest:
    """A term of a family and its score test."""

    term: ModelErrorTerm
    score: Score

    @property
    def log_p(self) -> float:
        """Natural logarithm of the probability of such a score anywhere in its family."""
        return self.score.log_p + float(np.log(self.term.trials))

    def evidence(self, samples: int) -> float:
        """Return ln of the odds for this term, with the penalty of Schwarz (1978)."""
        return 0.5 * (self.score.chi_square - self.score.degrees * float(np.log(samples)))

    @property
    def significant(self) -> bool:
        """Return whether chance is less likely than FALSE_ALARM."""
        return bool(self.log_p < np.log(FALSE_ALARM))


@dataclass(frozen=True, eq=False)
class ResidualDiagnostics:
    """The score tests of ``fitted`` for all families, or those in ``only``, each computed once.

    slower: see :class:`ModelErrorFamilies`
    """

    problem: Problem
    fitted: Fit
    steps: Steps
    only: Collection[str] = ()
    slower: float = 1.0

    @cached_property
    def space(self) -> ResidualSpace:
        """The residual and the columns of the fit."""
        return ResidualSpace(self.problem, self.fitted)

    @cached_property
    def model_errors(self) -> ModelErrorFamilies:
        """The columns of all families."""
        return ModelErrorFamilies(self.problem, self.fitted, self.steps, self.slower)

    @cached_property
    def best(self) -> Mapping[str, ScoreTest]:
        """Return the most significant term of each family, by the name of the family."""
        found: dict[str, ScoreTest] = {}
        for family in self.model_errors.families(self.only):
            if family.name == DRIFT and family.width != (self._drift_columns or family.width):
                continue
            term = self._best_of(family)
            if family.name == PERIODIC:
                term = self._best_of(self.model_errors.periodic(term.parameter))
            judged, before = self.tested(term), found.get(family.name)
            if before is None or self.evidence(judged) > self.evidence(before):
                found[family.name] = judged
        return found

    @cached_property
    def _drift_columns(self) -> int | None:
        """Number of columns of the best drift of the thinned record; None where there is none."""
        if self.thinned is None:
            return None
        terms = (family.term(0) for family in self.thinned.model_errors.drift())
        best = max(map(self.thinned.tested, terms), key=self.evidence)
        return int(best.term.columns.shape[1])

    def tested(self, term: ModelErrorTerm) -> ScoreTest:
        """Return the test of ``term``."""
        return ScoreTest(term, self.space.score(term.columns, term.family))

    def _best_of(self, family: ModelErrorFamily) -> ModelErrorTerm:
        if len(family.parameters) == 1:
            return family.term(0)
        if self.thinned is None or family.name in _BY_ALL:
            return family.term(int(np.argmax(self.screening_scores(family))))
        alike = self.thinned.model_errors.alike(family)
        return family.term(int(np.argmax(self.thinned.screening_scores(alike))))

    def screening_scores(self, family: ModelErrorFamily) -> FloatArray:
        """Return χ² in white noise of each term of ``family``."""
        every = len(family.parameters)
        step = max(BLOCK_VALUES // (len(self.problem.input) * family.width), 1)
        return np.concatenate(
            [
                self.space.screen(family.part(i, min(i + step, every)), family.width)
                for i in range(0, every, step)
            ]
        )

    @cached_property
    def thinned(self) -> ResidualDiagnostics | None:
        """The diagnostics of a long step test decimated, for slow model errors.

        None where there are few samples, where the motion is rarely stationary, so that much of it
        may be fast, or where rounding is shared by the readings of a plateau.
        """
        problem, steps = self.problem, self.steps
        fastest = problem.rate / (2 * np.pi)
        if not self.only or MODE in self.only:
            fastest = max(fastest, FASTEST_MODE_HZ)
        per_content = 0.5 / (problem.period * fastest * ABOVE_CONTENT)
        every = int(min(len(problem.input) / ENOUGH_SAMPLES, per_content))
        rests = bool(steps.edges) and float(np.mean(steps.moving)) < _MOSTLY
        if every < 2 or not rests or problem.shared > 0:
            return None
        fewer = coarser(problem, every)
        fitted = fewer.evaluated(self.fitted.structure, self.fitted.nonlinear)
        edges = tuple(
            Edge(edge.start // every, -(-edge.stop // every), edge.height) for edge in steps.edges
        )
        moved = replace(steps, edges=edges, moving=steps.moving[::every])
        return replace(self, problem=fewer, fitted=fitted, steps=moved)

    @cached_property
    def creep(self) -> tuple[ScoreTest, ...]:
        """Return the tests of a relaxation of each time constant."""
        family = self.model_errors.creep()
        terms = (family.term(index) for index in range(len(family.parameters)))
        return tuple(ScoreTest(t, self.space.score(t.columns[:, :1], CREEP)) for t in terms)

    @cached_property
    def independence(self) -> float:
        """Return the p-value of the correlation of the residual with the rate of the motion."""
        rate = np.concatenate([np.zeros(LAGS - 1), np.gradient(self.problem.motion)])
        # The last values of the rate, the newest last, 0 before the record.
        past = np.lib.stride_tricks.sliding_window_view(rate, len(rate) - LAGS + 1)
        parts = (past[:, i : i + BLOCK_ROWS].copy() for i in range(0, past.shape[1], BLOCK_ROWS))
        mixed = inverse_root(np.sum([each @ each.T for each in parts], axis=0)).T
        if not mixed.size:
            return 1.0
        columns = np.array([np.correlate(rate, row, "valid") for row in mixed])
        return float(np.exp(self.space.judged(columns).log_p))

    def significant(self, but: Collection[str] = ()) -> list[ScoreTest]:
        """Return the significant tests, that of most evidence first, without families ``but``."""
        shown = [j for j in self.best.values() if j.term.family not in but and j.significant]
        return sorted(shown, key=self.evidence, reverse=True)

    def evidence(self, judged: ScoreTest) -> float:
        """Return the logarithm of the odds for ``judged``."""
        return judged.evidence(self.fitted.samples)

    @property
    def longest_time_constant(self) -> float:
        """Return the longest time constant [s] that was tried."""
        return float(self.model_errors.time_constants()[-1])

    @property
    def plateau(self) -> float:
        """Time from one edge to the next [s]; without edges the duration of the record."""
        starts = [edge.start for edge in self.steps.edges]
        if len(starts) < 2:
            return self.model_errors.duration
        return float(np.median(np.diff(starts))) * self.problem.period


UP_DOWN = "steps up against steps down"
HALVES = "first half against second"
SIZES = "small steps against large"
RECORDING = "recording {} against the others"
# Fewest edges: two of each kind show their scatter.
_LEAST_EDGES = 4
# Least ratio of heights that are intended to differ.
_TWO_SIZES = 1.5


def differ(compared: PartsCompared) -> bool:
    """Return whether chance is less likely than FALSE_ALARM."""
    return compared.p is not None and compared.p < FALSE_ALARM


def contrasts(diagnostics: ResidualDiagnostics) -> list[PartsCompared]:
    """Return the contrasts that the steps of this test allow."""
    starts, samples = diagnostics.problem.starts, len(diagnostics.problem.input)
    weights = dict(_weights(diagnostics.steps, samples))
    if len(starts) > 1:
        weights.pop(HALVES, None)
    place = np.searchsorted(starts, np.arange(samples), side="right")
    # The second of two recordings adds nothing to the first.
    for number in range(1, len(starts) + 1 - (len(starts) <= 2)):
        weights[RECORDING.format(number)] = np.where(place == number, 1.0, -1.0)
    return [_contrast_of(diagnostics, name, weight) for name, weight in weights.items()]


def _weights(steps: Steps, samples: int) -> Iterator[tuple[str, FloatArray]]:
    """Yield 1 in the first part and -1 in the second, (n,), for each pair of parts."""
    if len(steps.edges) < _LEAST_EDGES:
        return
    heights = np.array([edge.height for edge in steps.edges])
    length = np.array([stop - start for start, stop in segments(steps, samples, _LEAST_EDGES)])
    sizes = np.abs(heights)
    up, early = heights > 0, np.arange(len(heights)) < len(heights) / 2
    split = {UP_DOWN: up}
    if not (np.array_equal(up, early) or np.array_equal(up, ~early)):
        split[HALVES] = early
    if np.max(sizes) > _TWO_SIZES * np.min(sizes):
        split[SIZES] = sizes < np.sqrt(np.max(sizes) * np.min(sizes))
    for name, first in split.items():
        if 0 < np.sum(first) < len(first):
            yield name, np.repeat(np.where(first, 1.0, -1.0), length)


def _contrast_of(diagnostics: ResidualDiagnostics, name: str, weight: FloatArray) -> PartsCompared:
    fitted, problem = diagnostics.fitted, diagnostics.problem
    answer = fitted.gain * problem.response(fitted)
    by_gain = np.cumsum(weight * np.diff(answer, prepend=answer[0]))
    by_lag = -weight * np.gradient(answer, problem.period)
    score = diagnostics.space.score(np.column_stack([by_gain, by_lag]))
    size, spread = 2 * score.size, 2 * np.sqrt(np.diag(score.covariance))
    gain, gain_u, lag, lag_u = (
        float(value) if np.isfinite(value) else None for value in np.ravel([size, spread], "F")
    )
    return PartsCompared(
        parts=name,
        gain_difference=gain,
        gain_difference_uncertainty=gain_u,
        lag_difference_s=lag,
        lag_difference_uncertainty_s=lag_u,
        p=float(np.exp(score.log_p)),
    )
