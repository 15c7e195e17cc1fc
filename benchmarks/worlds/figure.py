"""Draw figure errors and describe them: Zernike terms, rings, tool marks, PV and rms.

Zernike terms are Noll's, of unit rms over the aperture; the angle runs from x towards y.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import factorial

import numpy as np

Array = np.ndarray
TERMS = 15
RINGS_OF_GRID = 240
ANGLES_OF_GRID = 720


def noll(j: int) -> tuple[int, int]:
    """Return degree n and azimuthal order m (negative: sine) of Noll's term j, from 1."""
    n, rest = 0, j - 1
    while rest > n:
        n += 1
        rest -= n
    m = n % 2 + 2 * ((rest + (n + 1) % 2) // 2)
    return n, m if j % 2 == 0 else -m


def radial(n: int, m: int) -> Array:
    """Return R_n^m(r)/r^m as coefficients of powers of r², lowest first."""
    m = abs(m)
    half, other = (n - m) // 2, (n + m) // 2
    powers = np.zeros(half + 1)
    for k in range(half + 1):
        sign = (-1) ** k * factorial(n - k)
        powers[half - k] = sign / (factorial(k) * factorial(other - k) * factorial(half - k))
    return powers


def zernike(j: int, x: Array, y: Array) -> Array:
    """Return Noll's term j at x and y, in units of the aperture's radius."""
    return zernike_sum({j: 1.0}, x, y)


def zernike_sum(terms: dict[int, float], x: Array, y: Array) -> Array:
    """Return Σ value × term, the terms gathered by azimuthal order to be evaluated once each."""
    gathered: dict[int, Array] = {}
    for j, value in terms.items():
        n, m = noll(j)
        norm = np.sqrt((n + 1) * (1 if m == 0 else 2))
        new = value * norm * radial(n, m)
        old = gathered.get(m, np.zeros(1))
        gathered[m] = np.polynomial.polynomial.polyadd(old, new)
    r2 = np.square(x) + np.square(y)
    point = np.asarray(x) + 1j * np.asarray(y)
    total = np.zeros(r2.shape)
    for m, powers in gathered.items():
        turn = point ** abs(m)
        total += np.polynomial.polynomial.polyval(r2, powers) * (turn.real if m >= 0 else turn.imag)
    return total


@dataclass(frozen=True)
class Figure:
    """Figure error: Zernike terms, rings of some millimetres and tool marks of some micrometres."""

    radius: float
    terms: dict[int, float]
    rings: tuple[tuple[float, float, float], ...] = ()
    """Amplitude [m], period [m] and phase of each."""
    marks: tuple[float, float, float] = (0.0, 15e-6, 0.0)
    """Amplitude [m], period [m] and phase."""

    @classmethod
    def draw(
        cls, seed: int, radius: float, low: float = 35e-9, rings: float = 3e-9, marks: float = 1e-9
    ) -> Figure:
        """Draw a figure of given rms [m] of terms 4 to 36, of its rings and of its tool marks."""
        rng = np.random.default_rng([seed, 4201])
        numbers = range(4, 37)
        raw = np.array([rng.normal() / noll(j)[0] ** 1.5 for j in numbers])
        raw *= low / np.sqrt(np.sum(raw**2))
        amplitudes = np.abs(rng.normal(size=3))
        amplitudes *= rings * np.sqrt(2) / np.sqrt(np.sum(amplitudes**2))
        periods = radius * rng.uniform(0.1, 0.3, 3)
        phases = rng.uniform(0, 2 * np.pi, 4)
        mark = (marks * np.sqrt(2), rng.uniform(8e-6, 16e-6), phases[3])
        return cls(
            radius,
            {j: float(v) for j, v in zip(numbers, raw, strict=True)},
            tuple(zip(amplitudes, periods, phases[:3], strict=True)),
            mark,
        )

    def height(self, x: Array, y: Array) -> Array:
        """Return the height [m] at (x, y) [m] of the part's frame."""
        total = zernike_sum(self.terms, x / self.radius, y / self.radius)
        r = np.hypot(x, y)
        for amplitude, period, phase in (*self.rings, self.marks):
            if amplitude:
                total += amplitude * np.cos(2 * np.pi * r / period + phase)
        return total


@dataclass(frozen=True)
class Truth:
    """True figures of a deviation over the aperture, weighted by area [m].

    ``levelled``: after piston and both tilts are removed by least squares.
    """

    pv: float
    rms: float
    zernike: Array
    """(15,), Noll's terms from piston on, each of unit rms."""
    pv_levelled: float
    rms_levelled: float


def truth_of(error: Callable[[Array, Array], Array], radius: float) -> Truth:
    """Describe ``error(x, y)`` over the circle by Gauss–Legendre rings in r² and even angles."""
    nodes, weights = np.polynomial.legendre.leggauss(RINGS_OF_GRID)
    r = np.sqrt((nodes + 1) / 2)[:, None]
    theta = 2 * np.pi * np.arange(ANGLES_OF_GRID) / ANGLES_OF_GRID
    x, y = r * np.cos(theta), r * np.sin(theta)
    area = np.broadcast_to(weights[:, None] / (2 * ANGLES_OF_GRID), x.shape)
    at = error(radius * x, radius * y)
    rim = error(radius * np.cos(theta), radius * np.sin(theta))
    terms = np.array([np.sum(area * at * zernike(j, x, y)) for j in range(1, TERMS + 1)])
    plane = dict(zip((1, 2, 3), terms[:3], strict=True))
    level = at - zernike_sum(plane, x, y)
    level_rim = rim - zernike_sum(plane, np.cos(theta), np.sin(theta))
    return Truth(
        float(np.ptp(np.append(at, rim))),
        float(np.sqrt(np.sum(area * at**2))),
        terms,
        float(np.ptp(np.append(level, level_rim))),
        float(np.sqrt(np.sum(area * level**2))),
    )
