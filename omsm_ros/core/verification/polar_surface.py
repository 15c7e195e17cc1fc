"""A smooth surface of unknown shape: cubic B-splines of radius times harmonics of the angle.

``S(r, θ) = Σ_jm B_j(r) (a_jm cos mθ + b_jm sin mθ)``. Within one interval of radius only four
splines differ from zero, so the normal equations are gathered interval by interval.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from omsm_ros.core.samples.blocks import FloatArray, IntArray

# B-splines of the third degree over one interval, ascending powers of u in 0…1, a row each.
_SPLINES = np.array([[1, -3, 3, -1], [4, 0, -6, 3], [1, 3, 3, -3], [0, 0, 0, 1]]) / 6
_SLOPES = _SPLINES[:, 1:] * np.arange(1, 4)
SUPPORT = len(_SPLINES)


@dataclass(frozen=True, slots=True)
class PolarBasis:
    """Terms of the surface between two radii.

    inner, outer: [m];  intervals: of radius, of equal width;  harmonics: highest of the angle
    """

    inner: float
    outer: float
    intervals: int
    harmonics: int

    @property
    def waves(self) -> int:
        """Functions of the angle: 1, cos θ … cos Mθ, sin θ … sin Mθ."""
        return 2 * self.harmonics + 1

    @property
    def size(self) -> int:
        """Terms of the surface, spline by spline."""
        return (self.intervals + SUPPORT - 1) * self.waves

    @property
    def width(self) -> float:
        """Of one interval [m]."""
        return (self.outer - self.inner) / self.intervals

    def interval(self, radius: FloatArray) -> IntArray:
        """Return the interval in which ``radius`` (n,) [m] lies, (n,)."""
        place = ((radius - self.inner) / self.width).astype(np.int64)
        return np.asarray(np.clip(place, 0, self.intervals - 1), np.int64)

    def terms(self, interval: int) -> slice:
        """Return where the terms that differ from zero in ``interval`` stand among all."""
        return slice(interval * self.waves, (interval + SUPPORT) * self.waves)

    def amplitudes(self, coefficients: FloatArray) -> FloatArray:
        """Return the rms over radius of each harmonic's amplitude, from 1, (harmonics,) [m]."""
        shape = coefficients.reshape(-1, self.waves)
        middle = _SPLINES @ 0.5 ** np.arange(4)
        at_middles = sum(
            w * shape[k : k + self.intervals] for k, w in enumerate(middle)
        )  # fmt: skip
        power = np.mean(np.asarray(at_middles)[:, 1:] ** 2, axis=0)
        return np.asarray(np.sqrt(power[: self.harmonics] + power[self.harmonics :]))

    def rows(self, interval: int, radius: FloatArray, angle: FloatArray) -> PolarRows:
        """Return the terms of ``interval`` at points (n,) in it, or just beside it."""
        u = (radius - self.inner) / self.width - interval
        powers = u[:, np.newaxis] ** np.arange(4)
        wave = np.exp(1j * angle)
        turns = np.cumprod(np.repeat(wave[:, np.newaxis], self.harmonics, axis=1), axis=1)
        waves = np.concatenate([np.ones((len(u), 1)), turns.real, turns.imag], axis=1)
        slopes = powers[:, :3] @ _SLOPES.T / self.width
        return PolarRows(powers @ _SPLINES.T, slopes, waves)


@dataclass(frozen=True, eq=False)
class PolarRows:
    """Splines (n, 4), their slopes (n, 4) [1/m], and functions of the angle (n, waves)."""

    splines: FloatArray
    slopes: FloatArray
    waves: FloatArray

    def matrix(self) -> FloatArray:
        """Return the terms of one interval, (n, 4 · waves)."""
        product = self.splines[:, :, np.newaxis] * self.waves[:, np.newaxis, :]
        return np.asarray(product.reshape(len(self.splines), -1))

    def heights(self, coefficients: FloatArray) -> FloatArray:
        """Return S (n,) of the surface with ``coefficients`` (4 · waves,)."""
        shape = coefficients.reshape(SUPPORT, -1)
        return np.asarray(np.sum(self.splines * (self.waves @ shape.T), axis=1))

    def derivatives(self, coefficients: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return ∂S/∂r (n,) and ∂S/∂θ (n,) of the surface with ``coefficients`` (4 · waves,)."""
        shape = coefficients.reshape(SUPPORT, -1)
        along_radius = np.sum(self.slopes * (self.waves @ shape.T), axis=1)
        along_angle = np.sum(self.splines * (self.waves @ _turned(shape).T), axis=1)
        return along_radius, along_angle


def spline_columns(place: FloatArray, intervals: int) -> FloatArray:
    """Return cubic B-splines over ``intervals`` unit intervals at ``place``, (n, intervals + 3)."""
    interval = np.clip(place.astype(np.int64), 0, intervals - 1)
    powers = (place - interval)[:, np.newaxis] ** np.arange(4)
    columns = np.zeros((len(place), intervals + SUPPORT - 1))
    spline = interval[:, np.newaxis] + np.arange(SUPPORT)
    columns[np.arange(len(place))[:, np.newaxis], spline] = powers @ _SPLINES.T
    return columns


def _turned(shape: FloatArray) -> FloatArray:
    """Return the coefficients of ∂S/∂θ: (cos mθ)' = -m sin mθ, (sin mθ)' = m cos mθ."""
    harmonics = (shape.shape[1] - 1) // 2
    order = np.arange(1, harmonics + 1)
    cosines, sines = shape[:, 1 : harmonics + 1], shape[:, harmonics + 1 :]
    return np.concatenate([np.zeros((SUPPORT, 1)), order * sines, -order * cosines], axis=1)
