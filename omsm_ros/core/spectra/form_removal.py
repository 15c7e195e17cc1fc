"""What is no ripple: the part's form, its tilt and the drift, millimetres above nanometres.

On a turned part Zernike polynomials over the scanned disc, of no higher degree than the data
ask for, beside what repeats with the spindle alike at every radius, which no figure of a part
can do at its centre. Elsewhere polynomials of time.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import comb

import numpy as np
from numpy.polynomial import legendre

from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.core.spectra.scan_signal import ScanSignal

# Fewer turns do not tell what repeats with the turn.
LEAST_TURNS = 1.5
# Harmonics of a turn that may be the spindle's beside the figure's.
HIGHEST_ORDER = 12
_DRIFT_DEGREE = 3
_DEGREES = range(2, 15, 2)
# A higher degree has to take away this share of what is left, or it fits noise and lines.
_WORTH = 0.02
# Even samples that determine the form; it is smooth, and the rest would only cost time.
_MOST_FITTED = 100_000
_CHUNK = 16_384
# Radii within this part of the largest are one circle.
_CIRCLE = 0.02
# Directions that the scan determines worse than this, of its best, stay at zero.
_LEAST_DETERMINED = 1e-12


@dataclass(frozen=True, slots=True)
class Order:
    """``cosine · cos(2π order · turn) + sine · sin(…)`` [m], alike at every radius.

    uncertainty: standard, of cosine and of sine [m]
    """

    order: int
    cosine: float
    sine: float
    uncertainty: float

    @property
    def amplitude(self) -> float:
        """[m]"""
        return float(np.hypot(self.cosine, self.sine))


@dataclass(frozen=True, eq=False)
class Formless:
    """A scan without its form.

    residual: what is left (n,) [m];  degree: of the polynomials;  removed: rms of the form [m]
    orders: what repeats with the spindle, taken out as well
    on_circle: True where figure and spindle cannot be told apart, for there is one radius
    """

    residual: FloatArray
    degree: int
    removed: float
    orders: tuple[Order, ...]
    on_circle: bool


def without_form(signal: ScanSignal) -> Formless:
    """Take form, drift and what repeats with the spindle out of the heights of ``signal``."""
    basis = _Basis.of(signal)
    every = max(len(signal) // _MOST_FITTED, 1)
    chosen = np.arange(0, len(signal), every)
    height = signal.height - np.mean(signal.height)
    gram, moment = _normal_equations(basis, signal, height, chosen)
    degree, columns = _enough(basis, gram, moment, float(np.sum(height[chosen] ** 2)))
    solution = np.zeros(len(basis.names))
    residual = height
    for _ in range(2):  # the second takes out what rounding left of millimetres
        solution[columns] += _solved(gram, moment, columns)
        residual = height - _evaluated(basis, signal, solution)
        _, moment = _normal_equations(basis, signal, residual, chosen)
    variance = float(np.mean(residual[chosen] ** 2))
    spread = np.zeros(len(basis.names))
    inverse = _inverse(gram[np.ix_(columns, columns)])
    spread[columns] = np.sqrt(np.maximum(np.diag(inverse), 0.0) * variance)
    return Formless(
        residual=residual,
        degree=degree,
        removed=float(np.std(height - residual)),
        orders=tuple(_orders(basis, solution, spread)),
        on_circle=basis.on_circle,
    )


@dataclass(frozen=True, eq=False)
class _Basis:
    """Names of the columns: (kind, degree, harmonic); kinds are drift, order and form."""

    names: tuple[tuple[str, int, int], ...]
    on_circle: bool
    largest: float

    @classmethod
    def of(cls, signal: ScanSignal) -> _Basis:
        largest = float(signal.radius.max()) or 1.0
        on_circle = float(np.ptp(signal.radius)) < _CIRCLE * largest
        top = max(_DEGREES)
        if signal.turns < LEAST_TURNS:
            return cls(tuple(("drift", n, 0) for n in range(top + 1)), False, largest)
        names = [("drift", n, 0) for n in range(_DRIFT_DEGREE + 1)]
        names += [("order", k, s * k) for k in range(1, HIGHEST_ORDER + 1) for s in (1, -1)]
        if not on_circle:
            names += [
                ("form", n, s * k)
                for n in range(2, top + 1)
                for k in range(n % 2, n + 1, 2)
                for s in ((1, -1) if k else (1,))
            ]
            names += [("form", 1, 1), ("form", 1, -1)]
        return cls(tuple(names), on_circle, largest)

    def degree(self, name: tuple[str, int, int]) -> int:
        """From which degree on a column belongs to the fit; of a scan along no turn, of time."""
        kind, n, _ = name
        free = kind == "order" or (kind == "drift" and n <= _DRIFT_DEGREE and self._turning)
        return 0 if free else n

    @property
    def _turning(self) -> bool:
        return any(kind == "order" for kind, _, _ in self.names)

    def columns(self, signal: ScanSignal, chosen: np.ndarray) -> FloatArray:
        """Values of all columns at the samples ``chosen`` (m,): (m, p)."""
        time = 2 * signal.sample[chosen] / max(int(signal.sample[-1]), 1) - 1
        rho, angle = signal.radius[chosen] / self.largest, 2 * np.pi * signal.turn[chosen]
        turns = {k: np.exp(1j * k * angle) for k in range(max(max(_DEGREES), HIGHEST_ORDER) + 1)}
        found = np.empty((len(chosen), len(self.names)))
        for place, (kind, n, m) in enumerate(self.names):
            wave = turns[abs(m)].real if m >= 0 else turns[-m].imag
            if kind == "drift":
                found[:, place] = legendre.legval(time, [0.0] * n + [1.0])
            elif kind == "order":
                found[:, place] = wave
            else:
                found[:, place] = _radial(n, abs(m), rho) * wave
        return found


def _radial(degree: int, harmonic: int, rho: FloatArray) -> FloatArray:
    """Radial part of a Zernike polynomial, by its sum (Noll 1976, Eq. 2)."""
    half = (degree - harmonic) // 2
    terms = [
        (-1) ** s * comb(degree - s, s) * comb(degree - 2 * s, half - s) for s in range(half + 1)
    ]
    return np.asarray(np.polyval(terms, rho**2) * rho**harmonic)


def _normal_equations(
    basis: _Basis, signal: ScanSignal, values: FloatArray, chosen: np.ndarray
) -> tuple[FloatArray, FloatArray]:
    size = len(basis.names)
    gram, moment = np.zeros((size, size)), np.zeros(size)
    for first in range(0, len(chosen), _CHUNK):
        part = chosen[first : first + _CHUNK]
        columns = basis.columns(signal, part)
        gram += columns.T @ columns
        moment += columns.T @ values[part]
    return gram, moment


def _enough(
    basis: _Basis, gram: FloatArray, moment: FloatArray, energy: float
) -> tuple[int, np.ndarray]:
    """The degree beyond which nothing worth it is taken away, and its columns."""
    needed = np.array([basis.degree(name) for name in basis.names])
    left, kept = energy, (0, np.flatnonzero(needed == 0))
    for degree in _DEGREES:
        columns = np.flatnonzero(needed <= degree)
        solution = _solved(gram, moment, columns)
        now = energy - float(solution @ moment[columns])
        if degree > _DEGREES[0] and now > (1 - _WORTH) * left:
            break
        left, kept = now, (degree, columns)
    return kept


def _solved(gram: FloatArray, moment: FloatArray, columns: np.ndarray) -> FloatArray:
    return np.asarray(_inverse(gram[np.ix_(columns, columns)]) @ moment[columns])


def _inverse(gram: FloatArray) -> FloatArray:
    scale = 1 / np.sqrt(np.diag(gram))
    values, vectors = np.linalg.eigh(gram * np.outer(scale, scale))
    kept = values > _LEAST_DETERMINED * values[-1]
    half = vectors[:, kept] / np.sqrt(values[kept]) * scale[:, np.newaxis]
    return np.asarray(half @ half.T)


def _evaluated(basis: _Basis, signal: ScanSignal, solution: FloatArray) -> FloatArray:
    parts = [
        basis.columns(signal, np.arange(first, min(first + _CHUNK, len(signal)))) @ solution
        for first in range(0, len(signal), _CHUNK)
    ]
    return np.concatenate(parts)


def _orders(basis: _Basis, solution: FloatArray, spread: FloatArray) -> Iterator[Order]:
    found = {name: place for place, name in enumerate(basis.names) if name[0] == "order"}
    for k in range(2, HIGHEST_ORDER + 1):
        if ("order", k, k) in found:
            cosine, sine = found["order", k, k], found["order", k, -k]
            worse = float(max(spread[cosine], spread[sine]))
            yield Order(k, float(solution[cosine]), float(solution[sine]), worse)
