"""How much of a residual would one more term explain, and how large a term would stay hidden?

A score test (Rao 1948): the part of the term's column that the fitted parameters can imitate is
taken out, and the residual is projected on the rest. Its variance is that of the spectrum of the
residual *without* the term, because a large term would otherwise count as noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import fft, stats

from omsm_ros.core.fitting.covariance import noise_spectrum, weighted_gram
from omsm_ros.core.fitting.output_error import Fit, Problem
from omsm_ros.core.fitting.uneven_noise import scatter_in_time, uneven_rows
from omsm_ros.core.samples.blocks import FloatArray, IntArray
from omsm_ros.least_squares import unit_columns

# Of a column whose remainder is weaker than this, the fit imitates everything but rounding.
_IMITATED = 1e-4
# Directions this much weaker than the strongest are rounding.
_SPANNED = 1e-9
# That are in memory at a time beside the result.
_SAMPLES = 65_536
# Noise is averaged over at least this many lines: its level is then known to a quarter.
_LEAST_LINES = 8
# and over half an octave on either side where the lines are dense.
_HALF_WIDTH = 2**0.5


@dataclass(frozen=True, eq=False)
class Score:
    """What the residual says of one term.

    size: its coefficients (c,), and covariance (c, c) of them
    chi_square: of the hypothesis that they are zero;  degrees: coefficients that the fit does
        not imitate
    """

    size: FloatArray
    covariance: FloatArray
    chi_square: float
    degrees: int

    @property
    def log_p(self) -> float:
        """Return ln of the probability of ``chi_square`` or more if the term is absent."""
        return float(stats.chi2.logsf(self.chi_square, self.degrees)) if self.degrees else 0.0

    @property
    def uncertainty(self) -> float:
        """Return the standard uncertainty of the first coefficient, infinite if unknown."""
        return float(np.sqrt(self.covariance[0, 0]))


@dataclass(frozen=True, eq=False)
class ResidualSpace:
    """The residual of ``fitted`` and what its parameters can imitate."""

    problem: Problem
    fitted: Fit

    @cached_property
    def _basis(self) -> FloatArray:
        return self._decomposed[0]

    @cached_property
    def _decomposed(self) -> tuple[FloatArray, FloatArray]:
        """What the parameters can imitate: a basis (k, r), and its parameters (p, r)."""
        unit, scale = unit_columns(self.problem.sensitivity(self.fitted))
        left, values, right = np.linalg.svd(unit, full_matrices=False)
        kept = values > _SPANNED * values[0]
        return left[:, kept], right[kept].T / values[kept] / scale[:, np.newaxis]

    def imitating(self, column: FloatArray) -> FloatArray:
        """Return the parameters (p,) that come nearest to ``column`` (n,) where it is compared."""
        basis, parameters = self._decomposed
        return np.asarray(parameters @ (basis.T @ column[self.problem.used]))

    def _compared(self, columns: FloatArray) -> FloatArray:
        """Return those of ``columns`` (n, c) that are compared, (k, c), each in one piece."""
        first, last = self._places[0], self._places[-1]
        if last - first < len(self._places):
            # Without a gap there is nothing to pick.
            rows = columns.T[:, first : last + 1]
            return (rows if rows.strides[1] == rows.itemsize else np.ascontiguousarray(rows)).T
        return np.take(columns.T, self._places, axis=1).T

    @cached_property
    def _places(self) -> IntArray:
        return np.flatnonzero(self.problem.used)

    def freed(self, columns: FloatArray) -> FloatArray:
        """Return ``columns`` (n, c) less what the fit can imitate, where compared (k, c)."""
        rows = columns.T.copy()
        self._free(rows)
        return np.asarray(rows[:, self.problem.used].T)

    def _free(self, rows: FloatArray) -> None:
        """Take from ``rows`` (c, n) what is not compared, and what the fit can imitate."""
        rows[:, ~self.problem.used] = 0.0
        parts = [slice(i, i + _SAMPLES) for i in range(0, len(self._places), _SAMPLES)]
        imitated = np.zeros((len(rows), self._basis.shape[1]))
        for part in parts:
            imitated += rows[:, self._places[part]] @ self._basis[part]
        for part in parts:
            rows[:, self._places[part]] -= imitated @ self._basis[part].T

    def screen(self, columns: FloatArray, terms: int) -> FloatArray:
        """Return χ² of each group of ``terms`` neighbouring columns of (n, c), as for white noise.

        To find the best of many; :meth:`score` then judges it.
        """
        compared = self._compared(columns)
        imitated = (self._basis.T @ compared).reshape(self._basis.shape[1], -1, terms)
        moment = (compared.T @ self.fitted.residual).reshape(-1, terms)
        gram = np.empty((len(moment), terms, terms))
        for i in range(terms):
            for j in range(i + 1):
                both = np.einsum("kg,kg->g", compared[:, i::terms], compared[:, j::terms])
                both -= np.einsum("kg,kg->g", imitated[..., i], imitated[..., j])
                gram[:, i, j] = gram[:, j, i] = both
        inverse = np.linalg.pinv(gram, rcond=_IMITATED, hermitian=True)
        explained = np.einsum("gi,gij,gj->g", moment, inverse, moment)
        return np.asarray(explained / (self.fitted.sum_of_squares / self.fitted.samples))

    def score(self, columns: FloatArray) -> Score:
        """Judge the term of ``columns`` (n, c), all its coefficients together."""
        return self.judged(columns.T.copy())

    def judged(self, rows: FloatArray) -> Score:
        """Judge the term of ``rows`` (c, n), its columns, which are overwritten."""
        rows[:, ~self.problem.used] = 0.0
        before = _lengths(rows)
        self._free(rows)
        unit = _lengths(rows)
        free = unit > _IMITATED * np.where(before > 0, before, 1.0)
        terms = len(rows)
        size, covariance = np.zeros(terms), np.diag(np.full(terms, np.inf))
        if not np.any(free):
            return Score(size, covariance, 0.0, 0)
        rows, unit = rows[free] if not np.all(free) else rows, unit[free]
        rows /= unit[:, np.newaxis]
        inverse, degrees = _pseudo_inverse(rows @ rows.T, _IMITATED**2)
        found = inverse @ (rows @ self._residual)
        spread = inverse @ self._noise_of(rows, found) @ inverse.T
        chi_square = float(found @ np.linalg.pinv(spread, rcond=1e-9, hermitian=True) @ found)
        size[free] = found / unit
        covariance[np.ix_(free, free)] = spread / np.outer(unit, unit)
        return Score(size, covariance, chi_square, degrees)

    @cached_property
    def _residual(self) -> FloatArray:
        return self.problem.on_grid(self.fitted.residual, 0.0)

    def _noise_of(self, rows: FloatArray, found: FloatArray) -> FloatArray:
        """Return the covariance (c, c) of noise times ``rows`` (c, n).

        The noise is like what ``rows``, ``found`` (c,) times, leave of the residual.
        """
        used = self.problem.used
        samples = len(used)
        length = fft.next_fast_len(samples, real=True)
        residual = (self._residual - found @ rows)[used]
        noise = broad_noise(residual, self._places, samples, length)
        noise *= self.fitted.samples / max(self.fitted.samples - self.fitted.size, 1)
        even = weighted_gram(rows, length, noise)
        if self._scatter == 0 and self.problem.shared == 0:
            return even
        uneven = uneven_rows(self.problem, rows[:, used].T, self._scatter)
        return np.asarray(even + uneven.T @ uneven)

    @cached_property
    def _scatter(self) -> float:
        return scatter_in_time(self.problem, self.fitted.residual)


def _lengths(rows: FloatArray) -> FloatArray:
    """Return the lengths (c,) of ``rows`` (c, n); numpy's norm takes their memory again."""
    return np.asarray(np.sqrt(np.einsum("cn,cn->c", rows, rows)))


def _pseudo_inverse(gram: FloatArray, tolerance: float) -> tuple[FloatArray, int]:
    """Return the inverse (c, c) of ``gram`` where it is not zero, and in how many directions."""
    values, directions = np.linalg.eigh(gram)
    kept = values > tolerance * values[-1]
    strong = directions[:, kept]
    return np.asarray(strong / values[kept] @ strong.T), int(np.sum(kept))


def broad_noise(residual: FloatArray, place: IntArray, samples: int, length: int) -> FloatArray:
    """Return the variance spectrum of ``residual`` (k,) at ``length`` // 2 + 1 frequencies.

    place: index of each among ``samples``
    The larger of an autoregressive one, which misses slow drift, and of the periodogram
    smoothed over an octave, which does not.
    """
    on_grid = np.zeros(samples)
    on_grid[place] = residual
    power = np.abs(fft.rfft(on_grid, length)) ** 2 / len(residual)
    line = np.arange(len(power))
    low = np.minimum(line / _HALF_WIDTH, line - _LEAST_LINES / 2).astype(int)
    low = np.clip(low, 1, max(len(power) - _LEAST_LINES, 1))
    high = np.maximum(line * _HALF_WIDTH, low + _LEAST_LINES).astype(int)
    high = np.minimum(high, len(power))
    total = np.concatenate([[0.0], np.cumsum(power)])
    smooth = (total[high] - total[low]) / np.maximum(high - low, 1)
    return np.asarray(np.maximum(smooth, noise_spectrum(residual, length)))
