"""Shapes of revolution and their relatives: conic with aspheric terms, toroid, biconic.

Radii are positive for a concave surface, whose edge is higher than its vertex. A surface has no
height, NaN, beyond where its conic ends. Sags are written without the difference of nearly equal
numbers: ``C s / (1 + √(1 − (1 + k) C² s))`` is exact to rounding for any radius.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.core.surface.slopes import Gradient
from omsm_ros.errors import SurfaceError
from omsm_ros.quantities import COEFFICIENT, CONIC_CONSTANT, RADIUS, Quantity

# Twelve even powers differ by no more than rounding (their products have a condition of 3e16).
MOST_TERMS = 20


def checked_terms(values: tuple[float, ...], name: str, quantity: Quantity = COEFFICIENT) -> None:
    """Raise SurfaceError unless these are plausible coefficients, and not too many."""
    if len(values) > MOST_TERMS:
        raise SurfaceError(
            f"{name} has {len(values)} coefficients, expected {MOST_TERMS} at most; leave out the "
            "others, or describe the surface by a grid"
        )
    for place, value in enumerate(values):
        quantity.checked(value, SurfaceError, f"{name}[{place}]")


def curvature_of(radius: float | None) -> float:
    """Return 1/radius [1/m], zero for None, which is flat."""
    return 0.0 if radius is None else 1 / radius


def root_of(argument: FloatArray) -> FloatArray:
    """Return the square root, NaN where there is none."""
    return np.where(argument > 0, np.sqrt(np.maximum(argument, 0.0)), np.nan)


@dataclass(frozen=True, slots=True)
class Asphere:
    """A conic with aspheric terms (ISO 10110-12), its vertex at the origin.

    ``z = s/R / (1 + √(1 − (1 + k) s/R²)) + Σ even_i s^(i+1) + r Σ odd_i s^i``, ``s = r²``

    radius: at the vertex [m], None for flat;  conic_constant: k [1], 0 sphere, -1 paraboloid
    even_terms: of r², r⁴, r⁶ …;  odd_terms: of r, r³, r⁵ … [m^(1 - power)]
    """

    radius: float | None = None
    conic_constant: float = 0.0
    even_terms: tuple[float, ...] = ()
    odd_terms: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.radius is not None:
            RADIUS.checked(self.radius, SurfaceError)
        CONIC_CONSTANT.checked(self.conic_constant, SurfaceError)
        checked_terms(self.even_terms, "even_terms")
        checked_terms(self.odd_terms, "odd_terms")

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height [m] at x, y [m]; NaN where the conic has ended."""
        s, c = np.square(x) + np.square(y), curvature_of(self.radius)
        height = c * s / (1 + root_of(1 - (1 + self.conic_constant) * c**2 * s))
        if self.even_terms:
            height = height + s * _polynomial(self.even_terms, s)
        if self.odd_terms:
            height = height + np.sqrt(s) * _polynomial(self.odd_terms, s)
        return np.asarray(height, np.float64)

    def gradient(self, x: FloatArray, y: FloatArray) -> Gradient:
        """Return the slopes ∂z/∂x, ∂z/∂y [1]; zero at the tip of a cone, which has none."""
        s, c = np.square(x) + np.square(y), curvature_of(self.radius)
        # Of dz/dr over r, so that nothing is divided at the centre.
        each = c / root_of(1 - (1 + self.conic_constant) * c**2 * s)
        if self.even_terms:
            powers = [2 * (i + 1) * a for i, a in enumerate(self.even_terms)]
            each = each + _polynomial(powers, s)
        if self.odd_terms:
            powers = [(2 * i + 1) * a for i, a in enumerate(self.odd_terms)]
            r = np.sqrt(s)
            with np.errstate(divide="ignore", invalid="ignore"):
                each = each + np.where(r > 0, _polynomial(powers, s) / r, 0.0)
        return np.asarray(each * x), np.asarray(each * y)


@dataclass(frozen=True, slots=True)
class Toroid:
    """A conic in the plane of y and z, turned about a line parallel to y above its vertex.

    ``z = R_x − √((R_x − g(y))² − x²)``, g the conic of ``radius_y`` and ``conic_constant``

    radius_x: from the vertex to the line [m];  radius_y: of the conic [m], None for a cylinder
    """

    radius_x: float
    radius_y: float | None = None
    conic_constant: float = 0.0

    def __post_init__(self) -> None:
        RADIUS.checked(self.radius_x, SurfaceError, "radius_x")
        if self.radius_y is not None:
            RADIUS.checked(self.radius_y, SurfaceError, "radius_y")
        CONIC_CONSTANT.checked(self.conic_constant, SurfaceError)

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height [m] at x, y [m]; NaN beyond the tube."""
        profile, _ = self._profile(y)
        square = profile * (2 * self.radius_x - profile) + np.square(x)
        return np.asarray(square / (self.radius_x + self._root(x, profile)), np.float64)

    def gradient(self, x: FloatArray, y: FloatArray) -> Gradient:
        """Return the slopes ∂z/∂x, ∂z/∂y [1]."""
        profile, slope = self._profile(y)
        root = self._root(x, profile)
        return np.asarray(x / root), np.asarray((self.radius_x - profile) * slope / root)

    def _root(self, x: FloatArray, profile: FloatArray) -> FloatArray:
        root = root_of((self.radius_x - profile) ** 2 - np.square(x))
        return np.asarray(np.sign(self.radius_x) * root)

    def _profile(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return height and slope of the conic in the plane of y."""
        c = curvature_of(self.radius_y)
        root = root_of(1 - (1 + self.conic_constant) * c**2 * np.square(y))
        return np.asarray(c * np.square(y) / (1 + root)), np.asarray(c * y / root)


@dataclass(frozen=True, slots=True)
class Biconic:
    """A conic of its own along x and along y.

    ``z = (C_x x² + C_y y²) / (1 + √(1 − (1 + k_x) C_x² x² − (1 + k_y) C_y² y²))``

    radius_x, radius_y: at the vertex [m], None for flat;  conic_x, conic_y: k_x, k_y [1]
    """

    radius_x: float | None = None
    radius_y: float | None = None
    conic_x: float = 0.0
    conic_y: float = 0.0

    def __post_init__(self) -> None:
        for name in ("radius_x", "radius_y"):
            if (value := getattr(self, name)) is not None:
                RADIUS.checked(value, SurfaceError, name)
        for name in ("conic_x", "conic_y"):
            CONIC_CONSTANT.checked(getattr(self, name), SurfaceError, name)

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height [m] at x, y [m]; NaN where the conics have ended."""
        bent, root, _, _ = self._parts(x, y)
        return np.asarray(bent / (1 + root), np.float64)

    def gradient(self, x: FloatArray, y: FloatArray) -> Gradient:
        """Return the slopes ∂z/∂x, ∂z/∂y [1]."""
        bent, root, p, q = self._parts(x, y)
        share = bent / ((1 + root) ** 2 * root)
        cx, cy = curvature_of(self.radius_x), curvature_of(self.radius_y)
        return (
            np.asarray(2 * cx * x / (1 + root) + share * p * x),
            np.asarray(2 * cy * y / (1 + root) + share * q * y),
        )

    def _parts(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, float, float]:
        cx, cy = curvature_of(self.radius_x), curvature_of(self.radius_y)
        p, q = (1 + self.conic_x) * cx**2, (1 + self.conic_y) * cy**2
        root = root_of(1 - p * np.square(x) - q * np.square(y))
        return np.asarray(cx * np.square(x) + cy * np.square(y)), root, p, q


def _polynomial(coefficients: tuple[float, ...] | list[float], s: FloatArray) -> FloatArray:
    """Return Σ c_i s^i by Horner's rule."""
    value = np.zeros_like(s, np.float64)
    for coefficient in reversed(coefficients):
        value = value * s + coefficient
    return value
