"""Forbes' freeform: a best-fit sphere and gradient-orthogonal terms with and without an angle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from omsm_ros.core.dynamics.transfer_function import ComplexArray
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.core.surface.aspheres import curvature_of, root_of
from omsm_ros.core.surface.forbes import Series, bfs_series, freeform_series
from omsm_ros.core.surface.slopes import Gradient
from omsm_ros.errors import SurfaceError
from omsm_ros.quantities import DISC_RADIUS, RADIUS, TERM_ORDER, TERM_SIZE


@dataclass(frozen=True, slots=True)
class QTerm:
    """``value`` [m] of the term of degree ``n`` in u² and angular order ``m``.

    cos mθ for m > 0, sin |m|θ for m < 0, with θ from x towards y
    """

    n: int
    m: int
    value: float

    def __post_init__(self) -> None:
        TERM_ORDER.checked(self.n, SurfaceError, "degree n")
        TERM_ORDER.checked(abs(self.m), SurfaceError, "angular order |m|")
        TERM_SIZE.checked(self.value, SurfaceError, "value")


@dataclass(frozen=True, slots=True)
class QFreeform:
    """A sphere and a departure along its normal (Opt. Express 20, 2483, eq. 2.2).

    ``z = sphere + δ / √(1 − r²/R²)``, ``u = r/aperture_radius``, ``δ = u²(1 − u²) Σ a_n Q_n^bfs(u²)
    + Σ u^m [a_nm cos mθ + b_nm sin mθ] Q_n^m(u²)``

    radius: R of the sphere [m], None for flat;  aperture_radius: where u is one [m]
    terms: those of m = 0 are the ones of Q bfs; terms of equal n and m add up
    """

    aperture_radius: float
    terms: tuple[QTerm, ...]
    radius: float | None = None

    def __post_init__(self) -> None:
        DISC_RADIUS.checked(self.aperture_radius, SurfaceError, "aperture_radius")
        if self.radius is not None:
            RADIUS.checked(self.radius, SurfaceError)

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height [m] at x, y [m]; NaN beyond the sphere's equator."""
        square, c = np.square(x) + np.square(y), curvature_of(self.radius)
        root = root_of(1 - c**2 * square)
        departure, _, _ = self._departure(x, y)
        return np.asarray(c * square / (1 + root) + departure / root, np.float64)

    def gradient(self, x: FloatArray, y: FloatArray) -> Gradient:
        """Return the slopes ∂z/∂x, ∂z/∂y [1]."""
        c = curvature_of(self.radius)
        root = root_of(1 - c**2 * (np.square(x) + np.square(y)))
        departure, along_x, along_y = self._departure(x, y)
        # Of the sphere, and of 1/root, divided by x or y.
        rate = c / root + departure * c**2 / root**3
        return np.asarray(along_x / root + rate * x), np.asarray(along_y / root + rate * y)

    def _departure(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return δ [m] and its slopes [1]; u^m exp(imθ) is a power of (x + iy)/aperture_radius."""
        w: ComplexArray = np.asarray(np.add(x, np.multiply(1j, y)) / self.aperture_radius)
        s = np.square(w.real) + np.square(w.imag)
        total = np.zeros((3, *w.shape))
        for m, (cosines, sines) in self._by_order().items():
            if m == 0:
                q, rate = bfs_series(cosines, s)
                total[0] += s * (1 - s) * q
                radial = 2 * ((1 - 2 * s) * q + s * (1 - s) * rate)
                total[1:] += radial * np.stack([w.real, w.imag])
                continue
            lower: ComplexArray = w ** (m - 1)
            for values, phase in ((cosines, 1.0), (sines, -1j)):
                if not any(values):
                    continue
                turned = _angular(freeform_series(values, m, s), phase * lower, w, m)
                total += np.stack(turned)
        total[1:] /= self.aperture_radius
        return total[0], total[1], total[2]

    def _by_order(self) -> dict[int, tuple[list[float], list[float]]]:
        """Return the coefficients [m] of cosines and sines for each |m|, by degree from 0 on."""
        found: dict[int, tuple[list[float], list[float]]] = {}
        for m in {abs(t.m) for t in self.terms}:
            degrees = 1 + max(t.n for t in self.terms if abs(t.m) == m)
            found[m] = ([0.0] * degrees, [0.0] * degrees)
        for term in self.terms:
            found[abs(term.m)][term.m < 0][term.n] += term.value
        return found


def _angular(
    series: Series, lower: ComplexArray, w: ComplexArray, m: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return Re(e wᵐ) q(|w|²) and its derivatives by the parts of w; ``lower`` is e w^(m−1)."""
    q, rate = series
    power = (lower * w).real
    # An analytic function changes along y by i times what it does along x.
    along_x = m * lower.real * q + 2 * w.real * power * rate
    along_y = -m * lower.imag * q + 2 * w.imag * power * rate
    return power * q, along_x, along_y
