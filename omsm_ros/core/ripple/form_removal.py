"""Remove form, tilt and drift from the heights of a scan, to leave its ripple.

On a turning part: Zernike polynomials over the scanned disc, of the degree that the data need, and
harmonics of the spindle with the same amplitude at every radius, which no form has at its centre.
Otherwise: polynomials of time.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import TypeAlias

import numpy as np
from numpy.polynomial import legendre

from omsm_ros.core.ripple.scan_signal import TURN, ScanSignal
from omsm_ros.core.ripple.spectral_line import SpectralLine
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.surface.zernike_terms import ZernikeIndex, zernike_values
from omsm_ros.linear_algebra import inverse_gram

Waves: TypeAlias = "Callable[[np.ndarray], FloatArray]"
"""Columns (m, q) to fit together with the form, at the samples (m,) asked for."""

# Harmonics of the spindle need more than a turn.
LEAST_TURNS = 1.5
# Highest harmonic of the spindle that is separated from form.
HIGHEST_ORDER = 12
# One wave a turn is the mounting of the part.
LOWEST_ORDER = 2
# On one circle, two waves a turn are astigmatism as well.
LOWEST_ON_CIRCLE = 3
# Degree of the drift over time in a scan that turns; faster changes are searched as lines.
_DRIFT_DEGREE = 3
# Even degrees of Zernike terms. Those above the usual one are tried only where it is needed.
_DEGREES = range(2, 15, 2)
_USUAL_DEGREE = 6
# Least share of the residual power that a higher degree must remove, otherwise it fits noise and
# lines; a smaller share once the lines are known and subtracted.
_WORTH, _WORTH_WITHOUT_LINES = 0.2, 0.05
# Samples that determine the smooth form.
_MOST_FITTED = 100_000
# Samples at a time: 150 columns of them are 20 MB.
_CHUNK = 16_384
# An order that exceeds the sum of itself and the form by this factor is not determined.
_LARGEST_CANCELLATION = 1.5
# Distance from a whole number of waves a turn, in resolutions, that counts as whole.
_HARMONIC_WIDTH = 0.6
# Radii within this share of the largest are one circle.
_CIRCLE = 0.02
# Eigenvalues below this share of the largest are not determined by the scan.
_LEAST_DETERMINED = 1e-12


@dataclass(frozen=True, eq=False)
class FormRemoved:
    """Scan without its form.

    residual: (n,) [m];  degree: of the polynomials;  removed: rms of the form [m]
    orders: harmonics of the spindle, also removed
    on_circle: True for a single radius, where form and spindle are not separable
    """

    residual: FloatArray
    degree: int
    removed: float
    orders: tuple[SpectralLine, ...]
    on_circle: bool


class FormFit:
    """Fit of form and spindle harmonics of one scan, repeated once its lines are known."""

    def __init__(self, signal: ScanSignal) -> None:
        self._signal = signal
        self._height = signal.height - np.mean(signal.height)
        every = max(len(signal) // _MOST_FITTED, 1)
        self._chosen = np.arange(0, len(signal), every)
        drawn = np.random.default_rng(0).permutation(len(self._chosen))[:_CHUNK]
        self._some = self._chosen[np.sort(drawn)]
        self._orthogonal = cache(partial(_orthogonal, signal, self._some))
        self._degree = self._sufficient_degree(self._height, _WORTH)

    @property
    def _basis(self) -> _Basis:
        return _Basis.of(self._signal).up_to(self._degree)

    def _sufficient_degree(self, values: FloatArray, worth: float) -> int:
        """Return the highest degree that is worth all degrees up to it.

        A form with six lobes, for example, needs the sixth degree although the fourth removes
        nothing. Degrees above the usual one are computed where the usual one is worth it.
        """
        residual, degree, left = values[self._some], 0, np.inf
        for higher in _DEGREES:
            rows, own = self._orthogonal(higher > _USUAL_DEGREE)
            part = rows[:, own <= higher]
            residual = residual - part @ (part.T @ residual)
            now = float(residual @ residual)
            if now <= (1 - worth) ** ((higher - degree) // _DEGREES.step) * left:
                left, degree = now, higher
            if degree < _USUAL_DEGREE <= higher:
                break
        return degree

    def refine(self, heights: FloatArray) -> None:
        """Choose the degree again with the ``heights`` of all lines (n,) [m] subtracted."""
        bare = self._height - heights
        self._degree = max(self._degree, self._sufficient_degree(bare, _WORTH_WITHOUT_LINES))

    def without(self, waves: Waves | None = None) -> FormRemoved:
        """Remove form, drift and orders, fitted together with ``waves``, which are kept."""
        basis, signal, chosen = self._basis, self._signal, self._chosen
        own = len(basis.names)
        bare, solution = self._height, np.zeros(1)
        for _ in range(2):  # the second pass removes rounding errors of millimetres
            gram, moment = _normal_equations(basis, signal, bare, chosen, waves)
            inverse = inverse_gram(gram, _LEAST_DETERMINED)
            solution = solution + inverse @ moment
            form = partial(basis.columns, signal)
            residual = self._height - _evaluated(form, len(signal), solution[:own])
            bare = residual
            if waves is not None:
                bare = residual - _evaluated(waves, len(signal), solution[own:])
        variance = float(np.mean(bare[chosen] ** 2))
        spread = np.sqrt(np.maximum(np.diag(inverse)[:own], 0.0) * variance)
        return FormRemoved(
            residual=residual,
            degree=self._degree,
            removed=float(np.std(self._height - residual)),
            orders=tuple(_orders(basis, solution, spread, gram / len(chosen))),
            on_circle=basis.on_circle,
        )

    def reserved_orders(self) -> list[tuple[float, float]]:
        """Return the waves a turn of form and orders, and the width of each in resolutions.

        A harmonic with q radial functions extends q/2 resolutions to either side.
        """
        if self._signal.turns < LEAST_TURNS:
            return []
        radial = Counter(abs(m) for kind, _, m in self._basis.names if kind == "form" and m >= 0)
        highest = max([HIGHEST_ORDER, *radial])
        return [(float(k), _HARMONIC_WIDTH + 0.5 * radial[k]) for k in range(1, highest + 1)]


@dataclass(frozen=True, eq=False)
class _Basis:
    """Columns of the fit, named by kind (drift, order or form), degree and harmonic."""

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

    def up_to(self, degree: int) -> _Basis:
        """Return the columns of a fit of ``degree``."""
        kept = tuple(name for name in self.names if self.degree(name) <= degree)
        return replace(self, names=kept)

    def degree(self, name: tuple[str, int, int]) -> int:
        """Return the lowest degree of a fit that includes the column ``name``."""
        kind, n, _ = name
        free = kind == "order" or (kind == "drift" and n <= _DRIFT_DEGREE and self._turning)
        return 0 if free else n

    @property
    def _turning(self) -> bool:
        return any(kind == "order" for kind, _, _ in self.names)

    def columns(self, signal: ScanSignal, chosen: np.ndarray) -> FloatArray:
        """Return the values of all columns at the samples ``chosen`` (m,): (m, p)."""
        time = 2 * signal.sample[chosen] / max(int(signal.sample[-1]), 1) - 1
        rho, angle = signal.radius[chosen] / self.largest, 2 * np.pi * signal.turn[chosen]
        turns = np.vander(np.exp(1j * angle), HIGHEST_ORDER + 1, increasing=True).T
        found = np.empty((len(self.names), len(chosen)))
        for place, (kind, n, m) in enumerate(self.names):
            if kind == "drift":
                found[place] = legendre.legval(time, [0.0] * n + [1.0])
            elif kind == "order":
                found[place] = turns[m].real if m >= 0 else turns[-m].imag
        form = [place for place, name in enumerate(self.names) if name[0] == "form"]
        terms = [ZernikeIndex(*self.names[place][1:]) for place in form]
        found[form] = zernike_values(rho * turns[1].real, rho * turns[1].imag, terms)
        return found.T


def _orthogonal(signal: ScanSignal, some: np.ndarray, every: bool) -> tuple[FloatArray, np.ndarray]:
    """Return orthogonal columns (m, p) of usual degrees, or of ``every`` one, and their degrees."""
    basis = _Basis.of(signal).up_to(_DEGREES[-1] if every else _USUAL_DEGREE)
    own = np.array([basis.degree(name) for name in basis.names])
    order = np.argsort(own, kind="stable")
    columns = basis.columns(signal, some)[:, order]
    columns /= np.linalg.norm(columns, axis=0)
    rows, upper = np.linalg.qr(columns)
    free = abs(np.diag(upper)) > _LEAST_DETERMINED**0.5
    return rows if free.all() else np.linalg.qr(columns[:, free])[0], own[order][free]


def _normal_equations(
    basis: _Basis, signal: ScanSignal, values: FloatArray, chosen: np.ndarray, waves: Waves | None
) -> tuple[FloatArray, FloatArray]:
    products = []
    for first in range(0, len(chosen), _CHUNK):
        part = chosen[first : first + _CHUNK]
        columns = basis.columns(signal, part)
        if waves is not None:
            columns = np.hstack([columns, waves(part)])
        products.append((columns.T @ columns, columns.T @ values[part]))
    gram, moment = (np.sum(parts, axis=0) for parts in zip(*products, strict=True))
    return gram, moment


def _evaluated(columns: Waves, count: int, solution: FloatArray) -> FloatArray:
    """Return the sum (count,) [m] of ``columns`` with the coefficients ``solution`` (p,)."""
    parts = [
        columns(np.arange(first, min(first + _CHUNK, count))) @ solution
        for first in range(0, count, _CHUNK)
    ]
    return np.concatenate(parts)


def _orders(
    basis: _Basis, solution: FloatArray, spread: FloatArray, mean: FloatArray
) -> Iterator[SpectralLine]:
    """Yield the orders that are separable from form; ``mean``: products of columns (p, p).

    Where the radius changes little, an order and a form of the same harmonic may both become large
    with opposite signs; the order then counts as form.
    """
    found = {name: place for place, name in enumerate(basis.names) if name[0] == "order"}
    lowest = LOWEST_ON_CIRCLE if basis.on_circle else LOWEST_ORDER
    for k in range(lowest, HIGHEST_ORDER + 1):
        if ("order", k, k) in found:
            cosine, sine = found["order", k, k], found["order", k, -k]
            worse = float(max(spread[cosine], spread[sine]))
            own = SpectralLine(
                coordinate=TURN, frequency=float(k), cosine=float(solution[cosine]),
                sine=float(solution[sine]), amplitude_uncertainty=worse,
            )  # fmt: skip
            alike = [i for i, (kind, _, m) in enumerate(basis.names) if abs(m) == k]
            part = solution[alike]
            together = float(part @ mean[np.ix_(alike, alike)] @ part)
            if own.amplitude**2 / 2 <= _LARGEST_CANCELLATION**2 * together:
                yield own
