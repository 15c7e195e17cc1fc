"""Zernike circle polynomials: their numbering, their values and their slopes.

``Z_n^m = R_n^|m|(ρ) cos mθ`` for m ≥ 0 and ``R_n^|m|(ρ) sin |m|θ`` for m < 0, with θ from x
towards y, and ``R(1) = 1`` (ISO 14999-2; "peak"). Noll's and ANSI Z80.28's are these times
``sqrt((2 − δ_m0)(n + 1))``, of root mean square one over the disc ("rms").

``R_n^m(ρ) = ρ^m P_k^(0,m)(2ρ² − 1)``, ``k = (n − m)/2``. The angular part with its ρ^m is a power
of x + i y. The Jacobi polynomials P follow from their three-term recurrence. No angle and no
factorial is computed.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.streams.blocks import FloatArray

Norm: TypeAlias = Literal["peak", "rms"]
Indexing: TypeAlias = Literal["noll", "fringe", "ansi"]

# The Fringe set ends here by definition.
MOST_FRINGE = 37


class ZernikeIndex(NamedTuple):
    """One polynomial: ``n`` radial order, ``m`` angular order, negative for sines."""

    n: int
    m: int


def noll(j: int) -> ZernikeIndex:
    """Return the term of Noll's number j = 1, 2, … (J. Opt. Soc. Am. 66, 207)."""
    n = int((np.sqrt(8 * j - 7) - 1) // 2)
    place = j - n * (n + 1) // 2 - 1
    m = 2 * ((place + 1) // 2) if n % 2 == 0 else 2 * (place // 2) + 1
    return ZernikeIndex(n, m if j % 2 == 0 else -m)


def fringe(j: int) -> ZernikeIndex:
    """Return the term of the Fringe number j = 1 to 37 (University of Arizona; ISO 14999-2).

    The last one, 37, is the rotationally symmetric term of order twelve, out of sequence.
    """
    if j == MOST_FRINGE:
        return ZernikeIndex(12, 0)
    half = int(np.ceil(np.sqrt(j))) - 1
    place = j - half**2 - 1
    m = half - place // 2
    return ZernikeIndex(2 * half - m, m if place % 2 == 0 else -m)


def ansi(j: int) -> ZernikeIndex:
    """Return the term of the ANSI Z80.28 number j = 0, 1, …"""
    n = int((np.sqrt(8 * j + 1) - 1) // 2)
    return ZernikeIndex(n, 2 * j - n * (n + 2))


NUMBERING: dict[str, tuple[Callable[[int], ZernikeIndex], int]] = {
    "noll": (noll, 1), "fringe": (fringe, 1), "ansi": (ansi, 0),
}  # fmt: skip
"""Each numbering with its first number."""


def first_terms(count: int, indexing: Indexing = "fringe") -> tuple[ZernikeIndex, ...]:
    """Return the first ``count`` terms of a numbering."""
    term_of, first = NUMBERING[indexing]
    return tuple(term_of(j) for j in range(first, first + count))


def terms_up_to(order: int, least: int = 0) -> tuple[ZernikeIndex, ...]:
    """Return all terms of radial orders ``least`` to ``order``."""
    return tuple(ZernikeIndex(n, m) for n in range(least, order + 1) for m in range(-n, n + 1, 2))


def rms_of(term: ZernikeIndex) -> float:
    """Return the root mean square over the disc of a term that is 1 at the rim."""
    return float(1 / np.sqrt((1 if term.m == 0 else 2) * (term.n + 1)))


def _jacobi_step(k: int, alpha: float, beta: float) -> tuple[float, float, float]:
    """Return a, b, c of ``P_(k+1)(t) = (a t + b) P_k(t) − c P_(k−1)(t)``, P = P^(alpha, beta)."""
    both = alpha + beta
    if k == 0:
        return (both + 2) / 2, (alpha - beta) / 2, 0.0
    scale = 2 * (k + 1) * (k + 1 + both) * (2 * k + both)
    a = (2 * k + both + 1) * (2 * k + both + 2) * (2 * k + both) / scale
    b = (2 * k + both + 1) * (alpha**2 - beta**2) / scale
    c = 2 * (k + alpha) * (k + beta) * (2 * k + both + 2) / scale
    return a, b, c


def jacobi(
    t: FloatArray, alpha: float, beta: float, highest: int, slopes: bool
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield P_k^(α,β)(t) and its derivative, 0 unless ``slopes``, for k = 0 to ``highest``."""
    before, value = np.zeros_like(t), np.ones_like(t)
    before_slope, slope = (np.zeros_like(t) if slopes else np.zeros(()) for _ in range(2))
    yield value, slope
    for k in range(highest):
        a, b, c = _jacobi_step(k, alpha, beta)
        factor = a * t
        factor += b
        if slopes:
            slope, before_slope = factor * slope + a * value - c * before_slope, slope
        if k:  # else P_0 is one, and nothing is before it
            factor *= value
            factor -= c * before
        value, before = factor, value
        yield value, slope


def _by_angle(terms: Sequence[ZernikeIndex]) -> dict[int, list[tuple[int, int, bool]]]:
    """Return for each |m| the position of each term, its k, and True for a sine."""
    found: dict[int, list[tuple[int, int, bool]]] = {}
    for place, (n, m) in enumerate(terms):
        found.setdefault(abs(m), []).append((place, (n - abs(m)) // 2, m < 0))
    return found


def zernike_values(x: FloatArray, y: FloatArray, terms: Sequence[ZernikeIndex]) -> FloatArray:
    """Return the terms (k, n), 1 at the rim, at x, y (n,) of the unit disc."""
    made = np.empty((len(terms), *np.shape(x)))
    t = 2 * (x**2 + y**2) - 1
    # Real and imaginary part of (x + iy)^m separately, for contiguous memory.
    real, imaginary = np.ones_like(t), np.zeros_like(t)
    groups = _by_angle(terms)
    for m in range(max(groups, default=0) + 1):
        if m:
            real, imaginary = real * x - imaginary * y, real * y + imaginary * x
        wanted = groups.get(m, ())
        radial = [v for v, _ in jacobi(t, 0, m, max((k for _, k, _ in wanted), default=0), False)]
        for place, k, sine in wanted:
            # P_0 and the real part for m = 0 are one.
            angular = imaginary if sine else real
            if k and m:
                np.multiply(radial[k], angular, out=made[place])
            else:
                made[place] = radial[k] if k else angular
    return made


def zernike_slopes(
    x: FloatArray, y: FloatArray, terms: Sequence[ZernikeIndex]
) -> tuple[FloatArray, FloatArray]:
    """Return ∂Z/∂x and ∂Z/∂y, each (k, n), of the terms at x, y (n,) of the unit disc."""
    along_x, along_y = (np.empty((len(terms), *np.shape(x))) for _ in range(2))
    t, base = 2 * (x**2 + y**2) - 1, x + 1j * y
    for m, wanted in _by_angle(terms).items():
        power = base**m
        # Derivative of (x + iy)^m: m (x + iy)^(m-1) along x, i times that along y.
        turned = m * base ** max(m - 1, 0)
        radial = list(jacobi(t, 0, m, max(k for _, k, _ in wanted), True))
        for place, k, sine in wanted:
            value, slope = radial[k]
            along_x[place] = _part(turned, sine) * value + 4 * x * _part(power, sine) * slope
            along_y[place] = _part(1j * turned, sine) * value + 4 * y * _part(power, sine) * slope
    return along_x, along_y


def _part(values: NDArray[np.complex128], sine: bool) -> FloatArray:
    return np.asarray(values.imag if sine else values.real)
