"""Where are the zeros of a continuous system whose input is a polynomial between samples?

The input in the step from sample k-1 to k is the polynomial of ``order`` m through the samples
k-m … k. The step is then integrated exactly:

``x[k] = exp(a) x[k-1] + Σ_j w_j u[k-j]``, ``y[k] = c x[k] + d u[k]``, j = 0 … m.

The zeros are those of the Rosenbrock pencil of this system. The state space is a series of
sections of first and second order, each scaled by its own frequency: in companion form the
products of poles that lie decades apart would drown the digits of the slow ones.
"""

from __future__ import annotations

from math import factorial
from typing import NamedTuple

import numpy as np
from numpy.polynomial import polynomial

from omsm_ros.core.dynamics.transfer_function import ComplexArray
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.scipy_parts import generalised_eigenvalues

# With a norm below one half the next term of the series is less than the rounding of 1.
_SERIES_TERMS = 16
# A zero this far out is a constant factor to 1e-9 of the gain, or infinity after rounding.
_FAR_ZERO = 1e9


class _StateSpace(NamedTuple):
    """x' = a x + b u, y = c x + d u: a (n, n), b (n,), c (n,), d."""

    a: FloatArray
    b: FloatArray
    c: FloatArray
    d: float


def held_zeros(
    zeros: ComplexArray, poles: ComplexArray, order: int, at_rest: int = 0
) -> ComplexArray:
    """Return the zeros in the z plane of the system with these roots, in radians a sample.

    at_rest: zeros at s = 0, which the interpolation maps to z = 1 exactly if it reproduces
        polynomials of that degree; among eigenvalues that coincide they would be blurred
    """
    if not len(poles):
        return np.empty(0, np.complex128)
    system = _series(zeros, poles)
    step, weights = _held_integrals(system.a, system.b, order)
    n = len(step)
    # States (x[k-1], u[k-1] … u[k-m]).
    transition = np.block([[step, weights[:, 1:]], [np.zeros((order, n)), np.eye(order, k=-1)]])
    entry = np.concatenate([weights[:, 0], np.eye(order)[0]])
    leaving = np.concatenate([system.c @ step, system.c @ weights[:, 1:]])
    direct = np.array([float(system.c @ weights[:, 0] + system.d)])
    pencil = np.block([[transition, entry[:, np.newaxis]], [leaving, direct]])
    finite = np.diag(np.append(np.ones(n + order), 0.0))
    found = generalised_eigenvalues(pencil, finite)
    found = found[np.isfinite(found) & (abs(found) < _FAR_ZERO)]
    found = _with_exact_ones(found, at_rest)
    upper = found[found.imag > 0]
    return np.concatenate([upper, upper.conj(), found[found.imag == 0]])


def _with_exact_ones(found: ComplexArray, count: int) -> ComplexArray:
    """Put 1 in the place of the ``count`` zeros nearest to it.

    Rounding may make a conjugate pair of one of them and a slow zero beside it: that one then
    gets what 1 leaves of the sum of the pair, which rounding does not move.
    """
    nearest = found[np.argsort(abs(found - 1))]
    taken, others = nearest[:count], nearest[count:]
    if np.sum(taken.imag > 0) != np.sum(taken.imag < 0):
        partner = int(np.argmin(abs(others - np.conj(taken[-1]))))
        others[partner] = 2 * taken[-1].real - 1
    return np.asarray(np.append(np.ones(len(taken)), others), np.complex128)


def _series(zeros: ComplexArray, poles: ComplexArray) -> _StateSpace:
    """Return the sections in series; the gain is arbitrary."""
    whole = _StateSpace(np.empty((0, 0)), np.empty(0), np.empty(0), 1.0)
    for numerator, denominator in _sections(zeros, poles):
        part = _section(numerator, denominator)
        corner = np.zeros((len(whole.a), len(part.a)))
        whole = _StateSpace(
            np.block([[whole.a, corner], [np.outer(part.b, whole.c), part.a]]),
            np.concatenate([whole.b, part.b * whole.d]),
            np.concatenate([part.d * whole.c, part.c]),
            part.d * whole.d,
        )
    return whole


def _sections(zeros: ComplexArray, poles: ComplexArray) -> list[tuple[FloatArray, FloatArray]]:
    """Return proper ratios of real, monic, ascending polynomials, of second order but for one."""
    denominators = [*_quadratics(_pairs(poles)), *_by_two(_reals(poles))]
    pairs, reals = _quadratics(_pairs(zeros)), _reals(zeros)
    numerators = []
    for denominator in denominators:
        room = len(denominator) - 1
        if room == 2 and pairs:
            numerators.append(pairs.pop(0))
        else:
            taken, reals = reals[:room], reals[room:]
            numerators.append(_expanded(taken))
    return list(zip(numerators, denominators, strict=True))


def _pairs(roots: ComplexArray) -> ComplexArray:
    upper = roots[roots.imag > 0]
    return np.asarray(upper[np.argsort(abs(upper))], np.complex128)


def _reals(roots: ComplexArray) -> FloatArray:
    real = roots[roots.imag == 0].real
    return np.asarray(real[np.argsort(abs(real))], np.float64)


def _quadratics(upper: ComplexArray) -> list[FloatArray]:
    return [np.array([abs(r) ** 2, -2 * r.real, 1.0]) for r in upper]


def _by_two(reals: FloatArray) -> list[FloatArray]:
    return [_expanded(reals[i : i + 2]) for i in range(0, len(reals), 2)]


def _expanded(roots: FloatArray) -> FloatArray:
    return np.asarray(polynomial.polyfromroots(roots), np.float64)


def _section(numerator: FloatArray, denominator: FloatArray) -> _StateSpace:
    """Return a ratio of first or second order with states y and y'/ω and an output near 1."""
    n = len(denominator) - 1
    omega = abs(denominator[0]) ** (1 / n)
    powers = omega ** np.arange(n + 1)
    padded = np.append(numerator, np.zeros(n + 1 - len(numerator))) * powers
    padded /= max(abs(padded))
    direct = float(padded[n])
    # In units of ω the denominator is 1 + … + 1, monic at both ends.
    monic = denominator * powers / powers[n]
    c = padded[:n] - direct * monic[:n]
    a = omega * np.eye(n, k=1)
    a[-1] = -omega * monic[:n]
    return _StateSpace(a, omega * np.eye(n)[-1], c, direct)


def _held_integrals(a: FloatArray, b: FloatArray, order: int) -> tuple[FloatArray, FloatArray]:
    """Return exp(a) and the weights w_j (n, order + 1) of u[k], u[k-1], … from k-1 to k."""
    n = len(a)
    # Driving states by a chain of integrators makes one exponential hold ∫ e^{a(1-v)} b v^j/j! dv.
    chain = np.zeros((n + order + 1, n + order + 1))
    chain[:n, :n] = a
    chain[:n, n] = b
    chain[n:, n:] = np.eye(order + 1, k=1)
    exponential = matrix_exponential(chain)
    monomials = exponential[:n, n:] * [factorial(j) for j in range(order + 1)]
    nodes = 1.0 - np.arange(order + 1)
    coefficients = np.linalg.inv(np.vander(nodes, increasing=True))
    return exponential[:n, :n], np.asarray(monomials @ coefficients)


def matrix_exponential(matrix: FloatArray) -> FloatArray:
    """Return exp(``matrix``) (n, n): its Taylor series at a 2^k-th part of it, squared k times.

    For the few states here; scipy's takes a tenth of a second to load.
    """
    norm = float(np.linalg.norm(matrix, 1))
    squarings = max(int(np.ceil(np.log2(norm))) + 1, 0) if norm > 0 else 0
    scaled = matrix / 2**squarings
    result = np.eye(len(matrix))
    for k in range(_SERIES_TERMS, 0, -1):
        result = np.eye(len(matrix)) + scaled @ result / k
    for _ in range(squarings):
        result = result @ result
    return result
