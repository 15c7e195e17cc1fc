"""Nominal surfaces: height and slope over the workpiece plane.

A surface is described in the workpiece frame of the scan: x, y in the plane of the chuck, height
along the spindle axis, all in metres.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from omsm_ros.core.kinematics.kinematics import PolynomialSurface, Surface
from omsm_ros.core.lti.transfer_function import ComplexArray
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.surface.aspheres import (
    Asphere,
    Biconic,
    Series,
    Sphere,
    Toroid,
    bfs_series,
    checked_terms,
    con_series,
    curvature_of,
    freeform_series,
    real_root,
)
from omsm_ros.core.surface.height_grid import Gradient
from omsm_ros.core.surface.posed import OffAxisSection, Sum
from omsm_ros.core.surface.zernike_terms import (
    MOST_FRINGE,
    NUMBERING,
    Indexing,
    Norm,
    ZernikeIndex,
    first_terms,
    rms_of,
    zernike_slopes,
    zernike_values,
)
from omsm_ros.errors import SurfaceError
from omsm_ros.quantities import (
    CONIC_CONSTANT,
    DISC_RADIUS,
    FOCAL_LENGTH,
    LENGTH,
    RADIUS,
    TERM_ORDER,
    TERM_SIZE,
    CheckedRecord,
)

# Most Zernike terms, up to order 27; a picture of them takes 2 s and 400 MB.
MOST_ZERNIKES = 400


@dataclass(frozen=True, slots=True)
class XYTerm(CheckedRecord):
    """``value`` [m] times (x/radius)^``x`` (y/radius)^``y``."""

    x: int = field(metadata=TERM_ORDER.metadata)
    y: int = field(metadata=TERM_ORDER.metadata)
    value: float = field(metadata=TERM_SIZE.metadata)
    error = SurfaceError


@dataclass(frozen=True, slots=True)
class XYPolynomial(CheckedRecord):
    """``z = Σ value (x/radius)^i (y/radius)^j``; ``radius`` [m] makes every value a length."""

    radius: float = field(metadata=DISC_RADIUS.metadata)
    terms: tuple[XYTerm, ...]
    error = SurfaceError

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height [m] at x, y [m]."""
        return self._polynomial().height(x, y)

    def gradient(self, x: FloatArray, y: FloatArray) -> Gradient:
        """Return the slopes ∂z/∂x, ∂z/∂y [1]."""
        return self._polynomial().gradient(x, y)

    def _polynomial(self) -> PolynomialSurface:
        powers = np.array([(0, 0), *((term.x, term.y) for term in self.terms)], int)
        table = np.zeros(np.max(powers, axis=0) + 1)
        np.add.at(table, tuple(powers.T), [0.0, *(term.value for term in self.terms)])
        return PolynomialSurface(table, self.radius)


@dataclass(frozen=True, slots=True)
class ZernikeSurface:
    """A sum of Zernike polynomials over a disc about the origin.

    radius: of the disc [m], beyond which the polynomials are extrapolated
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
            raise SurfaceError("surface.indexing", indexing=self.indexing, known=NUMBERING)
        if self.norm not in ("peak", "rms"):
            raise SurfaceError("surface.norm", norm=self.norm)
        most = MOST_FRINGE if self.indexing == "fringe" else MOST_ZERNIKES
        if len(self.coefficients) > most:
            raise SurfaceError(
                "surface.zernikes", terms=len(self.coefficients), most=most, indexing=self.indexing
            )
        for place, value in enumerate(self.coefficients):
            TERM_SIZE.checked(value, SurfaceError, f"coefficients[{place}]")

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height [m] at x, y [m]."""
        u, v = self._on_the_disc(x, y)
        terms, sizes = self._terms()
        made = sizes @ zernike_values(u.ravel(), v.ravel(), terms)
        return np.asarray(made.reshape(u.shape), np.float64)

    def gradient(self, x: FloatArray, y: FloatArray) -> Gradient:
        """Return the slopes ∂z/∂x, ∂z/∂y [1]."""
        u, v = self._on_the_disc(x, y)
        terms, sizes = self._terms()
        along_x, along_y = (
            (sizes @ slopes / self.radius).reshape(u.shape)
            for slopes in zernike_slopes(u.ravel(), v.ravel(), terms)
        )
        return along_x, along_y

    def _on_the_disc(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        u, v = np.broadcast_arrays(x, y)
        return u / self.radius, v / self.radius

    def _terms(self) -> tuple[list[ZernikeIndex], FloatArray]:
        """Return the terms that are not zero, and their sizes at the rim [m]."""
        numbered = first_terms(len(self.coefficients), self.indexing)
        used = [(t, c) for t, c in zip(numbered, self.coefficients, strict=True) if c]
        scale = [1 / rms_of(t) if self.norm == "rms" else 1.0 for t, _ in used]
        return [t for t, _ in used], np.array([c for _, c in used]) * scale


@dataclass(frozen=True, slots=True)
class QBfs(CheckedRecord):
    """Forbes' mild asphere: a best-fit sphere and a deviation along its normal.

    ``z = sphere + u²(1 − u²) Σ a_m Q_m^bfs(u²) / √(1 − r²/R²)``, ``u = r/aperture_radius``

    radius: R of the sphere [m], None for flat;  aperture_radius: where u is one [m]
    coefficients: a_0, a_1 … [m]
    """

    aperture_radius: float = field(metadata=DISC_RADIUS.metadata)
    coefficients: tuple[float, ...]
    radius: float | None = RADIUS.of_field(None)
    error = SurfaceError

    def __post_init__(self) -> None:
        CheckedRecord.__post_init__(self)
        checked_terms(self.coefficients, "coefficients", TERM_SIZE)

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height [m] at x, y [m]; NaN beyond the sphere's equator."""
        return self._freeform().height(x, y)

    def gradient(self, x: FloatArray, y: FloatArray) -> Gradient:
        """Return the slopes ∂z/∂x, ∂z/∂y [1]."""
        return self._freeform().gradient(x, y)

    def _freeform(self) -> QFreeform:
        terms = tuple(QTerm(n, 0, value) for n, value in enumerate(self.coefficients))
        return QFreeform(self.aperture_radius, terms, self.radius)


@dataclass(frozen=True, slots=True)
class QCon(CheckedRecord):
    """Forbes' strong asphere: a conic and a deviation along the axis.

    ``z = conic + u⁴ Σ a_m Q_m^con(u²)``, ``u = r/aperture_radius``

    radius, conic_constant: of the conic [m], [1], as in an asphere
    aperture_radius: where u is one [m];  coefficients: a_0, a_1 … [m]
    """

    aperture_radius: float = field(metadata=DISC_RADIUS.metadata)
    coefficients: tuple[float, ...]
    radius: float | None = RADIUS.of_field(None)
    conic_constant: float = CONIC_CONSTANT.of_field(0.0)
    error = SurfaceError

    def __post_init__(self) -> None:
        CheckedRecord.__post_init__(self)
        checked_terms(self.coefficients, "coefficients", TERM_SIZE)

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
class QFreeform(CheckedRecord):
    """Forbes' freeform: a sphere and a deviation along its normal (2012, eq. 2.2).

    ``z = sphere + δ / √(1 − r²/R²)``, ``u = r/aperture_radius``, ``δ = u²(1 − u²) Σ a_n Q_n^bfs(u²)
    + Σ u^m [a_nm cos mθ + b_nm sin mθ] Q_n^m(u²)``

    radius: R of the sphere [m], None for flat;  aperture_radius: where u is one [m]
    terms: those with m = 0 are those of QBfs; terms of equal n and m add up
    """

    aperture_radius: float = field(metadata=DISC_RADIUS.metadata)
    terms: tuple[QTerm, ...]
    radius: float | None = RADIUS.of_field(None)
    error = SurfaceError

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height [m] at x, y [m]; NaN beyond the sphere's equator."""
        square, c = np.square(x) + np.square(y), curvature_of(self.radius)
        root = real_root(1 - c**2 * square)
        deviation, _, _ = self._bump(x, y)
        return np.asarray(c * square / (1 + root) + deviation / root, np.float64)

    def gradient(self, x: FloatArray, y: FloatArray) -> Gradient:
        """Return the slopes ∂z/∂x, ∂z/∂y [1]."""
        c = curvature_of(self.radius)
        root = real_root(1 - c**2 * (np.square(x) + np.square(y)))
        deviation, along_x, along_y = self._bump(x, y)
        # Slopes of the sphere and of 1/root, divided by x or y.
        rate = c / root + deviation * c**2 / root**3
        return np.asarray(along_x / root + rate * x), np.asarray(along_y / root + rate * y)

    def _bump(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return δ [m] and its slopes [1], with u^m exp(imθ) = ((x + iy)/aperture_radius)^m."""
        w: ComplexArray = np.asarray(np.add(x, np.multiply(1j, y)) / self.aperture_radius)
        s = np.square(w.real) + np.square(w.imag)
        total = np.zeros((3, *w.shape))
        for m in {abs(t.m) for t in self.terms}:
            own = [t for t in self.terms if abs(t.m) == m]
            cosines, sines = ([0.0] * (1 + max(t.n for t in own)) for _ in range(2))
            for term in own:
                (sines if term.m < 0 else cosines)[term.n] += term.value
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


def _angular(
    series: Series, lower: ComplexArray, w: ComplexArray, m: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return Re(e wᵐ) q(|w|²) and its derivatives by the parts of w; ``lower`` is e w^(m−1)."""
    q, rate = series
    power = (lower * w).real
    # The derivative of an analytic function along y is i times that along x.
    along_x = m * lower.real * q + 2 * w.real * power * rate
    along_y = -m * lower.imag * q + 2 * w.imag * power * rate
    return power * q, along_x, along_y


@dataclass(frozen=True, slots=True)
class Flat(CheckedRecord):
    """A plane at constant ``level`` [m]."""

    level: float = LENGTH.of_field(0.0)
    error = SurfaceError

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height [m] at x, y [m]."""
        return np.full(np.broadcast(x, y).shape, self.level)

    def gradient(self, x: FloatArray, y: FloatArray) -> Gradient:
        """Return the slopes ∂z/∂x, ∂z/∂y [1]."""
        zero = np.zeros(np.broadcast(x, y).shape)
        return zero, zero


@dataclass(frozen=True, slots=True)
class OffAxisParaboloid(CheckedRecord):
    """A section of a paraboloid, with the height along the normal at its centre.

    parent_focal_length: f of the parent ``Z = R²/4f`` [m]
    off_axis_distance: from the parent's axis to the centre of the section [m]

    x points away from the parent's axis. Let ``m = d/2f`` be the slope at the centre and
    ``q² = 1 + m²``. A point (u, v, w) of the tangent frame lies on the parent if
    ``4 f q w = ((u - m w)/q)² + v²``. The smaller root of this quadratic is the height.
    """

    parent_focal_length: float = field(metadata=FOCAL_LENGTH.metadata)
    off_axis_distance: float = field(metadata=LENGTH.metadata)
    error = SurfaceError

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height [m] at x, y [m]."""
        b, c, root, _ = self._quadratic(x, y)
        # 2c / (b + √…) is the small root without the cancellation in (b - √…) / 2a.
        return np.asarray(2 * c / (b + root), np.float64)

    def gradient(self, x: FloatArray, y: FloatArray) -> Gradient:
        """Return the slopes ∂z/∂x, ∂z/∂y [1], from the derivative of ``a w² − b w + c = 0``."""
        b, c, root, slope = self._quadratic(x, y)
        q2 = 1 + slope**2
        w = 2 * c / (b + root)
        along_x = 2 * (np.asarray(x) - slope * w) / (q2 * root)
        return np.asarray(along_x), np.asarray(2 * np.asarray(y) / root)

    def _quadratic(
        self, x: FloatArray, y: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, float]:
        """Return b, c, √(b² − 4ac) and the slope m of ``a w² − b w + c = 0``, a = m²/q²."""
        slope = self.off_axis_distance / (2 * self.parent_focal_length)
        q2 = 1 + slope**2
        b = 2 * slope / q2 * np.asarray(x) + 4 * self.parent_focal_length * np.sqrt(q2)
        c = np.square(x) / q2 + np.square(y)
        with np.errstate(invalid="ignore"):  # NaN beyond the rim
            root = np.sqrt(b**2 - 4 * slope**2 / q2 * c)
        return b, c, root, slope


PAPER_MIRROR = OffAxisParaboloid(parent_focal_length=25.4e-3, off_axis_distance=50.8e-3)
"""The paper's mirror: 90° off-axis paraboloid of 50.8 mm effective focal length."""

PAPER_MIRROR_RADIUS_M = 12.7e-3
# A cylinder along the parent's axis, seen along the normal at 45°: an ellipse with a plane rim.
PAPER_MIRROR_HALF_LENGTH_M = PAPER_MIRROR_RADIUS_M * 2**0.5

SHAPES: dict[str, Callable[..., Surface]] = {
    "flat": Flat,
    "sphere": Sphere,
    "off_axis_paraboloid": OffAxisParaboloid,
    "asphere": Asphere,
    "toroid": Toroid,
    "biconic": Biconic,
    "xy_polynomial": XYPolynomial,
    "zernike": ZernikeSurface,
    "q_bfs": QBfs,
    "q_con": QCon,
    "q_freeform": QFreeform,
    "off_axis_section": OffAxisSection,
    "sum": Sum,
}
"""The surfaces by the name that a description gives their ``shape``."""
