"""Conics with aspheric terms, toroids, biconics and Forbes' polynomials.

Radii are positive for a concave surface, whose edge is higher than its vertex. The height is NaN
beyond the end of a conic. Sags are written without differences of nearly equal numbers:
``C s / (1 + √(1 − (1 + k) C² s))`` is exact to rounding for any radius.

Forbes' polynomials are functions of ``x = (r/radius)²``: G. W. Forbes, "Shape specification for
axially symmetric optical surfaces", Opt. Express 15, 5218 (2007), "Robust, efficient computational
methods for axially symmetric optical aspheres", Opt. Express 18, 19700 (2010), and "Characterizing
the shape of freeform optics", Opt. Express 20, 2483 (2012).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.polynomial.polynomial import polyval

from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.surface.height_grid import Gradient
from omsm_ros.core.surface.zernike_terms import jacobi
from omsm_ros.errors import SurfaceError
from omsm_ros.quantities import COEFFICIENT, CONIC_CONSTANT, RADIUS, CheckedRecord, Quantity

# Most coefficients: twelve even powers are already nearly linearly dependent (condition 3e16).
MOST_TERMS = 20


def checked_terms(values: tuple[float, ...], name: str, quantity: Quantity = COEFFICIENT) -> None:
    """Raise SurfaceError for more than MOST_TERMS coefficients or implausible ones."""
    if len(values) > MOST_TERMS:
        raise SurfaceError("surface.terms", name=name, terms=len(values), most=MOST_TERMS)
    for place, value in enumerate(values):
        quantity.checked(value, SurfaceError, f"{name}[{place}]")


def curvature_of(radius: float | None) -> float:
    """Return 1/radius [1/m], zero for None, which is flat."""
    return 0.0 if radius is None else 1 / radius


def real_root(argument: FloatArray) -> FloatArray:
    """Return the square root, NaN unless the argument is positive."""
    return np.where(argument > 0, np.sqrt(np.maximum(argument, 0.0)), np.nan)


@dataclass(frozen=True, slots=True)
class Asphere(CheckedRecord):
    """A conic with aspheric terms (ISO 10110-12), its vertex at the origin.

    ``z = s/R / (1 + √(1 − (1 + k) s/R²)) + Σ even_i s^(i+1) + r Σ odd_i s^i``, ``s = r²``

    radius: at the vertex [m], None for flat;  conic_constant: k [1], 0 sphere, -1 paraboloid
    even_terms: of r², r⁴, r⁶ …;  odd_terms: of r, r³, r⁵ … [m^(1 - power)]
    """

    radius: float | None = RADIUS.of_field(None)
    conic_constant: float = CONIC_CONSTANT.of_field(0.0)
    even_terms: tuple[float, ...] = ()
    odd_terms: tuple[float, ...] = ()
    error = SurfaceError

    def __post_init__(self) -> None:
        CheckedRecord.__post_init__(self)
        checked_terms(self.even_terms, "even_terms")
        checked_terms(self.odd_terms, "odd_terms")

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height [m] at x, y [m]; NaN where the conic has ended."""
        s, c = np.square(x) + np.square(y), curvature_of(self.radius)
        height = c * s / (1 + real_root(1 - (1 + self.conic_constant) * c**2 * s))
        if self.even_terms:
            height = height + s * polyval(s, self.even_terms)
        if self.odd_terms:
            height = height + np.sqrt(s) * polyval(s, self.odd_terms)
        return np.asarray(height, np.float64)

    def gradient(self, x: FloatArray, y: FloatArray) -> Gradient:
        """Return the slopes ∂z/∂x, ∂z/∂y [1]; zero at the tip of a cone."""
        s, c = np.square(x) + np.square(y), curvature_of(self.radius)
        # (dz/dr)/r, which is finite at the centre.
        each = c / real_root(1 - (1 + self.conic_constant) * c**2 * s)
        if self.even_terms:
            powers = [2 * (i + 1) * a for i, a in enumerate(self.even_terms)]
            each = each + polyval(s, powers)
        if self.odd_terms:
            powers = [(2 * i + 1) * a for i, a in enumerate(self.odd_terms)]
            r = np.sqrt(s)
            with np.errstate(divide="ignore", invalid="ignore"):
                each = each + np.where(r > 0, polyval(s, powers) / r, 0.0)
        return np.asarray(each * x), np.asarray(each * y)


@dataclass(frozen=True, slots=True)
class Sphere(CheckedRecord):
    """A sphere of ``radius`` [m] touching the plane at the origin; concave if positive."""

    radius: float = field(metadata=RADIUS.metadata)
    error = SurfaceError

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height [m] at x, y [m]; NaN from the equator on."""
        return Asphere(self.radius).height(x, y)

    def gradient(self, x: FloatArray, y: FloatArray) -> Gradient:
        """Return the slopes ∂z/∂x, ∂z/∂y [1]; NaN from the equator on."""
        return Asphere(self.radius).gradient(x, y)


@dataclass(frozen=True, slots=True)
class Toroid(CheckedRecord):
    """A conic in the plane of y and z, rotated about a line parallel to y above its vertex.

    ``z = R_x − √((R_x − g(y))² − x²)``, g the conic of ``radius_y`` and ``conic_constant``

    radius_x: from the vertex to the line [m];  radius_y: of the conic [m], None for a cylinder
    """

    radius_x: float = field(metadata=RADIUS.metadata)
    radius_y: float | None = RADIUS.of_field(None)
    conic_constant: float = CONIC_CONSTANT.of_field(0.0)
    error = SurfaceError

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
        root = real_root((self.radius_x - profile) ** 2 - np.square(x))
        return np.asarray(np.sign(self.radius_x) * root)

    def _profile(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return height and slope of the conic in the plane of y."""
        c = curvature_of(self.radius_y)
        root = real_root(1 - (1 + self.conic_constant) * c**2 * np.square(y))
        return np.asarray(c * np.square(y) / (1 + root)), np.asarray(c * y / root)


@dataclass(frozen=True, slots=True)
class Biconic(CheckedRecord):
    """A surface with one conic along x and another along y.

    ``z = (C_x x² + C_y y²) / (1 + √(1 − (1 + k_x) C_x² x² − (1 + k_y) C_y² y²))``

    radius_x, radius_y: at the vertex [m], None for flat;  conic_x, conic_y: k_x, k_y [1]
    """

    radius_x: float | None = RADIUS.of_field(None)
    radius_y: float | None = RADIUS.of_field(None)
    conic_x: float = CONIC_CONSTANT.of_field(0.0)
    conic_y: float = CONIC_CONSTANT.of_field(0.0)
    error = SurfaceError

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height [m] at x, y [m]; NaN where the conics have ended."""
        sag, root, _, _ = self._parts(x, y)
        return np.asarray(sag / (1 + root), np.float64)

    def gradient(self, x: FloatArray, y: FloatArray) -> Gradient:
        """Return the slopes ∂z/∂x, ∂z/∂y [1]."""
        sag, root, p, q = self._parts(x, y)
        share = sag / ((1 + root) ** 2 * root)
        cx, cy = curvature_of(self.radius_x), curvature_of(self.radius_y)
        return (
            np.asarray(2 * cx * x / (1 + root) + share * p * x),
            np.asarray(2 * cy * y / (1 + root) + share * q * y),
        )

    def _parts(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, float, float]:
        cx, cy = curvature_of(self.radius_x), curvature_of(self.radius_y)
        p, q = (1 + self.conic_x) * cx**2, (1 + self.conic_y) * cy**2
        root = real_root(1 - p * np.square(x) - q * np.square(y))
        return np.asarray(cx * np.square(x) + cy * np.square(y)), root, p, q


Series = tuple[FloatArray, FloatArray]


def bfs_series(coefficients: Sequence[float], x: FloatArray) -> Series:
    """Return Σ a_m Q_m^bfs(x) of mild aspheres, and its derivative.

    The functions ``u²(1 − u²) Q_m(u²)`` are orthonormal in the slope, averaged over u with the
    weight 1/√(1 − u²) (2007).
    """
    return _orthonormal_series(coefficients, 0, (0.5, 1.5), x)


def con_series(coefficients: Sequence[float], x: FloatArray) -> Series:
    """Return Σ a_m Q_m^con(x) of strong aspheres, and its derivative.

    ``Q_m^con(x) = P_m^(0,4)(2x − 1)``, Jacobi polynomials (2007, eq. 2.4).
    """
    return _jacobi_series(coefficients, 0.0, 4.0, x)


def freeform_series(coefficients: Sequence[float], m: int, x: FloatArray) -> Series:
    """Return Σ a_n Q_n^m(x) of freeforms, m ≥ 1, and its derivative by x.

    Q_n^m has degree n and a leading coefficient of sign (−1)ⁿ (2012, sec. 3). The functions
    ``u^m cos mθ Q_n^m(u²)`` are orthonormal in the gradient, averaged over θ and, with the weight
    1/√(1 − u²), over u.
    """
    return _orthonormal_series(coefficients, m, (-0.5, m - 1.5), x)


def _orthonormal_series(
    coefficients: Sequence[float], m: int, orders: tuple[float, float], x: FloatArray
) -> Series:
    """Return the series by Jacobi polynomials of ``orders``, which condition it well."""
    changed = _orthonormal(len(coefficients), m, orders) @ np.asarray(coefficients, np.float64)
    return _jacobi_series([float(a) for a in changed], *orders, x)


@lru_cache(maxsize=64)
def _orthonormal(count: int, m: int, orders: tuple[float, float]) -> FloatArray:
    """Return the upper triangle (count, count) whose columns are Q_n^m in Jacobi polynomials.

    The mean of ``|∇(u^m Q cos mθ)|²`` over θ is ``(A² + m² B²)/2``, with A = ∂/∂u (u^m Q) and
    B = u^(m−1) Q; that of the form of revolution is ``A²``, A = ∂/∂u (u²(1 − u²) Q). The mean over
    u = sin φ is a sum over even steps of φ, exact for polynomials.
    """
    steps = m + 2 * count + 4
    u = np.sin((np.arange(steps) + 0.5) * np.pi / (2 * steps))
    columns = []
    for unit in np.eye(count):
        value, rate = _jacobi_series([float(a) for a in unit], *orders, u**2)
        if m == 0:
            along = 2 * u * ((1 - 2 * u**2) * value + u**2 * (1 - u**2) * rate)
            columns.append(np.sqrt(2.0) * along)
            continue
        along = u ** (m - 1) * (m * value + 2 * u**2 * rate)
        columns.append(np.concatenate([along, m * u ** (m - 1) * value]))
    root = np.linalg.qr(np.array(columns).T / np.sqrt(2 * steps), mode="r")
    signs = np.sign(np.diag(root)) * (-1.0) ** np.arange(count)
    return np.asarray(np.linalg.inv(root) * signs, np.float64)


def _jacobi_series(
    coefficients: Sequence[float], alpha: float, beta: float, x: FloatArray
) -> Series:
    """Return Σ a_k P_k^(α,β)(2x − 1) and its derivative by x."""
    total = slope = np.zeros_like(x)
    terms = jacobi(2 * x - 1, alpha, beta, len(coefficients) - 1, slopes=True)
    for coefficient, (value, rate) in zip(coefficients, terms, strict=False):
        total, slope = total + coefficient * value, slope + 2 * coefficient * rate
    return total, slope
