"""Shapes by a series of terms: XY polynomial, Zernike, and Forbes' Q polynomials."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval2d

from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.core.surface.aspheres import Asphere, checked_terms, curvature_of, root_of
from omsm_ros.core.surface.forbes import Series, bfs_series, con_series
from omsm_ros.core.surface.slopes import Gradient
from omsm_ros.core.surface.zernike_terms import (
    MOST_FRINGE,
    NUMBERING,
    Indexing,
    Norm,
    Term,
    first_terms,
    rms_of,
    zernike_slopes,
    zernike_values,
)
from omsm_ros.errors import SurfaceError
from omsm_ros.quantities import CONIC_CONSTANT, DISC_RADIUS, RADIUS, TERM_ORDER, TERM_SIZE

# Up to order 27; a picture of them takes two seconds and 400 MB.
MOST_ZERNIKES = 400


@dataclass(frozen=True, slots=True)
class XYTerm:
    """``value`` [m] times (x/radius)^``x`` (y/radius)^``y``."""

    x: int
    y: int
    value: float

    def __post_init__(self) -> None:
        TERM_ORDER.checked(self.x, SurfaceError, "power of x")
        TERM_ORDER.checked(self.y, SurfaceError, "power of y")
        TERM_SIZE.checked(self.value, SurfaceError, "value")


@dataclass(frozen=True, slots=True)
class XYPolynomial:
    """``z = Σ value (x/radius)^i (y/radius)^j``; ``radius`` [m] makes every value a length."""

    radius: float
    terms: tuple[XYTerm, ...]

    def __post_init__(self) -> None:
        DISC_RADIUS.checked(self.radius, SurfaceError, "radius")

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height [m] at x, y [m]."""
        return self._at(x, y, self._coefficients())

    def gradient(self, x: FloatArray, y: FloatArray) -> Gradient:
        """Return the slopes ∂z/∂x, ∂z/∂y [1]."""
        along_x, along_y = (
            np.asarray(polyder(self._coefficients(), axis=k) / self.radius, np.float64)
            for k in range(2)
        )
        return self._at(x, y, along_x), self._at(x, y, along_y)

    def _coefficients(self) -> FloatArray:
        """Return the value [m] of each pair of powers (i, j); terms of equal powers add up."""
        table = np.zeros([max((getattr(t, n) for t in self.terms), default=0) + 1 for n in "xy"])
        for term in self.terms:
            table[term.x, term.y] += term.value
        return table

    def _at(self, x: FloatArray, y: FloatArray, coefficients: FloatArray) -> FloatArray:
        u, v = np.broadcast_arrays(np.asarray(x) / self.radius, np.asarray(y) / self.radius)
        return np.asarray(polyval2d(u, v, coefficients), np.float64)


@dataclass(frozen=True, slots=True)
class ZernikeSurface:
    """A sum of Zernike polynomials over a disc about the origin.

    radius: of the disc [m], beyond which the polynomials go on
    coefficients: [m], from the first number of the ``indexing`` on: 1 for Noll and Fringe, 0 for
        ANSI;  norm: "peak": each term is one at the rim, "rms": of root mean square one

    Cosines have m > 0 and sines m < 0, their angle counts from x towards y.
    """

    radius: float
    coefficients: tuple[float, ...]
    indexing: Indexing = "fringe"
    norm: Norm = "peak"

    def __post_init__(self) -> None:
        DISC_RADIUS.checked(self.radius, SurfaceError, "radius")
        if self.indexing not in NUMBERING:
            raise SurfaceError(f"indexing is {self.indexing!r}, expected one of {list(NUMBERING)}")
        if self.norm not in ("peak", "rms"):
            raise SurfaceError(f"norm is {self.norm!r}, expected 'peak' or 'rms'")
        most = MOST_FRINGE if self.indexing == "fringe" else MOST_ZERNIKES
        if len(self.coefficients) > most:
            raise SurfaceError(
                f"coefficients are {len(self.coefficients)}, expected {most} at most in the "
                f"numbering {self.indexing!r}"
            )
        for place, value in enumerate(self.coefficients):
            TERM_SIZE.checked(value, SurfaceError, f"coefficients[{place}]")

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height [m] at x, y [m]."""
        u, v = self._on_the_disc(x, y)
        terms, sizes = self._terms()
        made = sizes @ zernike_values(u.ravel(), v.ravel(), terms) if terms else np.zeros(u.size)
        return np.asarray(made.reshape(u.shape), np.float64)

    def gradient(self, x: FloatArray, y: FloatArray) -> Gradient:
        """Return the slopes ∂z/∂x, ∂z/∂y [1]."""
        u, v = self._on_the_disc(x, y)
        terms, sizes = self._terms()
        if not terms:
            return np.zeros(u.shape), np.zeros(u.shape)
        along_x, along_y = (
            (sizes @ slopes / self.radius).reshape(u.shape)
            for slopes in zernike_slopes(u.ravel(), v.ravel(), terms)
        )
        return along_x, along_y

    def _on_the_disc(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        u, v = np.broadcast_arrays(x, y)
        return u / self.radius, v / self.radius

    def _terms(self) -> tuple[list[Term], FloatArray]:
        """Return the terms that are there, and their sizes at the rim [m]."""
        numbered = first_terms(len(self.coefficients), self.indexing)
        used = [(t, c) for t, c in zip(numbered, self.coefficients, strict=True) if c]
        scale = [1 / rms_of(t) if self.norm == "rms" else 1.0 for t, _ in used]
        return [t for t, _ in used], np.array([c for _, c in used]) * scale


@dataclass(frozen=True, slots=True)
class QBfs:
    """Forbes' mild asphere: a best-fit sphere and a departure along its normal.

    ``z = sphere + u²(1 − u²) Σ a_m Q_m^bfs(u²) / √(1 − r²/R²)``, ``u = r/aperture_radius``

    radius: R of the sphere [m], None for flat;  aperture_radius: where u is one [m]
    coefficients: a_0, a_1 … [m]
    """

    aperture_radius: float
    coefficients: tuple[float, ...]
    radius: float | None = None

    def __post_init__(self) -> None:
        _check_series(self.aperture_radius, self.radius, self.coefficients)

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height [m] at x, y [m]; NaN beyond the sphere's equator."""
        height, _ = self._by_square(np.square(x) + np.square(y))
        return height

    def gradient(self, x: FloatArray, y: FloatArray) -> Gradient:
        """Return the slopes ∂z/∂x, ∂z/∂y [1]."""
        _, rate = self._by_square(np.square(x) + np.square(y))
        return np.asarray(2 * rate * x), np.asarray(2 * rate * y)

    def _by_square(self, s: FloatArray) -> Series:
        """Return the height over s = r², and its derivative by s."""
        c, area = curvature_of(self.radius), self.aperture_radius**2
        u = s / area
        root = root_of(1 - c**2 * s)
        q, slope = bfs_series(self.coefficients, u)
        bump, bump_slope = u * (1 - u) * q, (1 - 2 * u) * q + u * (1 - u) * slope
        rate = c / (2 * root) + bump_slope / (area * root) + bump * c**2 / (2 * root**3)
        return np.asarray(c * s / (1 + root) + bump / root), np.asarray(rate)


@dataclass(frozen=True, slots=True)
class QCon:
    """Forbes' strong asphere: a conic and a departure along the axis.

    ``z = conic + u⁴ Σ a_m Q_m^con(u²)``, ``u = r/aperture_radius``

    radius, conic_constant: of the conic [m], [1], as in an asphere
    aperture_radius: where u is one [m];  coefficients: a_0, a_1 … [m]
    """

    aperture_radius: float
    coefficients: tuple[float, ...]
    radius: float | None = None
    conic_constant: float = 0.0

    def __post_init__(self) -> None:
        _check_series(self.aperture_radius, self.radius, self.coefficients)
        CONIC_CONSTANT.checked(self.conic_constant, SurfaceError)

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height [m] at x, y [m]; NaN where the conic has ended."""
        u = (np.square(x) + np.square(y)) / self.aperture_radius**2
        bump, _ = con_series(self.coefficients, u)
        return np.asarray(self._conic().height(x, y) + u**2 * bump)

    def gradient(self, x: FloatArray, y: FloatArray) -> Gradient:
        """Return the slopes ∂z/∂x, ∂z/∂y [1]."""
        area = self.aperture_radius**2
        u = (np.square(x) + np.square(y)) / area
        bump, slope = con_series(self.coefficients, u)
        rate = 2 * (2 * u * bump + u**2 * slope) / area
        along_x, along_y = self._conic().gradient(x, y)
        return np.asarray(along_x + rate * x), np.asarray(along_y + rate * y)

    def _conic(self) -> Asphere:
        return Asphere(self.radius, self.conic_constant)


def _check_series(
    aperture_radius: float, radius: float | None, coefficients: tuple[float, ...]
) -> None:
    DISC_RADIUS.checked(aperture_radius, SurfaceError, "aperture_radius")
    if radius is not None:
        RADIUS.checked(radius, SurfaceError)
    checked_terms(coefficients, "coefficients", TERM_SIZE)
