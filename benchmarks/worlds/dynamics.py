"""Move what moves: linear systems, delays, backlash and friction on a fine, even grid of time."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import signal

Array = np.ndarray
EQ_12_NUMERATOR = (1.29e5, -3.07e8, 1.26e12)
EQ_12_DENOMINATOR = (1.0, 5.17e4, 1.22e8, 1.27e12)
"""Eq. 12 of doi 10.37188/lam.2025.078, with the ``s`` that its print lacks at 1.22e8."""


@dataclass(frozen=True)
class LinearSystem:
    """Transfer function of s, coefficients from the highest power down."""

    numerator: tuple[float, ...]
    denominator: tuple[float, ...]

    @classmethod
    def paper(cls, unit_gain: bool = True) -> LinearSystem:
        """Return Eq. 12, by default divided by its DC gain, 0.9921."""
        gain = EQ_12_NUMERATOR[-1] / EQ_12_DENOMINATOR[-1] if unit_gain else 1.0
        return cls(tuple(a / gain for a in EQ_12_NUMERATOR), EQ_12_DENOMINATOR)

    @classmethod
    def lag(cls, tau: float) -> LinearSystem:
        """Return 1/(1 + τ s)."""
        return cls((1.0,), (tau, 1.0))

    @classmethod
    def second_order(cls, frequency: float, damping: float = 1.0) -> LinearSystem:
        """Return a mass on a spring of unit gain, natural ``frequency`` in Hz."""
        w = 2 * np.pi * frequency
        return cls((w**2,), (1.0, 2 * damping * w, w**2))

    @classmethod
    def side_mode(cls, frequency: float, damping: float, share: float) -> LinearSystem:
        """Return 1 + share × (mode − 1): a weakly excited mode."""
        top, bottom = (np.array(a) for a in _second(frequency, damping))
        total = np.polyadd((1 - share) * bottom, share * top)
        return cls(tuple(total), tuple(bottom))

    @classmethod
    def creep(cls, share: float, tau: float) -> LinearSystem:
        """Return 1 − ε + ε/(1 + τ s)."""
        return cls(((1 - share) * tau, 1.0), (tau, 1.0))

    def after(self, other: LinearSystem) -> LinearSystem:
        """Return both in series."""
        return LinearSystem(
            tuple(np.polymul(self.numerator, other.numerator)),
            tuple(np.polymul(self.denominator, other.denominator)),
        )

    def scaled(self, frequency_ratio: float) -> LinearSystem:
        """Return the same system with all its frequencies times ``frequency_ratio``."""

        def scale(a: tuple[float, ...]) -> tuple[float, ...]:
            return tuple(v * frequency_ratio ** -(len(a) - 1 - i) for i, v in enumerate(a))

        return LinearSystem(scale(self.numerator), scale(self.denominator))

    def at(self, frequency: Array) -> Array:
        """Return the complex response at ``frequency`` [Hz]."""
        s = 2j * np.pi * np.asarray(frequency)
        return np.polyval(self.numerator, s) / np.polyval(self.denominator, s)

    def respond(self, u: Array, dt: float) -> Array:
        """Integrate the state equations, exact for input linear between the points of the grid.

        Starts in steady state at the first value of ``u``.
        """
        # Time in units of dt keeps the matrices near 1, where their exponential is accurate.
        top = _unscaled(self.numerator, dt)
        bottom = _unscaled(self.denominator, dt)
        a, b, c, d, _ = signal.cont2discrete(signal.tf2ss(top, bottom), 1.0, method="foh")
        num, den = signal.ss2tf(a, b, c, d)
        num = np.atleast_2d(num)[0]
        # Deviations from the first value start at zero, so that a slow pole needs no warm-up.
        gain = self.numerator[-1] / self.denominator[-1]
        return gain * u[0] + signal.lfilter(num, den, u - u[0])


def _second(frequency: float, damping: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return numerator and denominator of a second-order system, of equal length."""
    system = LinearSystem.second_order(frequency, damping)
    return (0.0, 0.0, *system.numerator), system.denominator


def _unscaled(a: tuple[float, ...], dt: float) -> Array:
    """Return coefficients of s × dt: the k-th power's is divided by dt to the k."""
    powers = np.arange(len(a) - 1, -1, -1.0)
    return np.array(a) / dt**powers


def sample(grid: Array, start: float, dt: float, t: Array) -> Array:
    """Interpolate ``grid``, values at start + k dt, at times ``t`` by cubics through 4 points."""
    place = (np.asarray(t) - start) / dt
    k = np.clip(np.floor(place).astype(int), 1, len(grid) - 3)
    f = place - k
    return (
        -grid[k - 1] * f * (f - 1) * (f - 2) / 6
        + grid[k] * (f + 1) * (f - 1) * (f - 2) / 2
        - grid[k + 1] * (f + 1) * f * (f - 2) / 2
        + grid[k + 2] * (f + 1) * f * (f - 1) / 6
    )


def delayed(u: Array, dt: float, delay: Array | float) -> Array:
    """Return u(t − delay(t)) on its own grid, delay in seconds and negative for a lead."""
    t = dt * np.arange(len(u))
    return sample(u, 0.0, dt, t - delay)


def turning_points(u: Array) -> Array:
    """Return the indices where ``u`` turns, with the first and the last."""
    step = np.sign(np.diff(u))
    moving = np.flatnonzero(step)
    turns = moving[1:][step[moving[1:]] != step[moving[:-1]]]
    return np.concatenate(([0], turns, [len(u) - 1]))


def backlash(u: Array, width: float) -> Array:
    """Follow ``u`` through play of ``width``: the output stands still until a flank is touched."""
    out = np.array(u, dtype=float)
    last = u[0]
    points = turning_points(u)
    for i, j in pairwise(points):
        piece = u[i : j + 1]
        if u[j] >= u[i]:
            out[i : j + 1] = np.maximum(last, piece - width / 2)
        else:
            out[i : j + 1] = np.minimum(last, piece + width / 2)
        last = out[j]
    return out


def presliding(u: Array, force: float, length: float) -> Array:
    """Follow ``u`` against Dahl's friction: a lag of ``force`` [m] built up over ``length`` [m]."""
    state = np.zeros(len(u))
    last = 0.0
    points = turning_points(u)
    for i, j in pairwise(points):
        way = np.sign(u[j] - u[i])
        state[i : j + 1] = way + (last - way) * np.exp(-np.abs(u[i : j + 1] - u[i]) / length)
        last = state[j]
    return u - force * state
