"""Modes of a response with their uncertainties (Eq. 8), and the two-mass model (Eq. 6, 7).

G without its delay is a sum over its poles. A conjugate pair adds, except for a part in s,
``residue / (s² + 2 ζ ω s + ω²)``; the printed Eq. 8 lacks the s after 2 ζ ω.

The two-mass model is a chain from the ground: ``m1`` on ``k1, c1``, and ``m2`` on ``m1`` through
``k2, c2``, driven by a force on ``m1``. Eq. 7 is the motion of ``m2`` (non-collocated); that of
``m1`` is the collocated one. The printed ``a1 = (k1 + k2) c1`` does not follow from the equations
of motion and is unstable for ordinary machines; correct is ``a1 = k1 c2 + k2 c1``. A response does
not determine the common scale of masses and stiffnesses, so ``m1`` must be known, or is the unit.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy  # whose parts are loaded when they are used
from numpy.polynomial import polynomial
from numpy.typing import ArrayLike

from omsm_ros.core.lti.frequency_response import (
    GRID_POINTS,
    relative_response_jacobian,
    spread_along,
)
from omsm_ros.core.lti.transfer_function import ComplexArray, TransferFunction
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import DataError, IdentificationError
from omsm_ros.linear_algebra import inverse_root

# Order of the uncertainties of a fitted two-mass model; m1 is given.
FITTED = ("m2", "k1", "k2", "c1", "c2")
# Frequencies at which the shape of a response is read over three decades, 0.2 % apart: closer than
# the width of any mode of a metal structure.
_SHAPE_LINES = 4000
# Search range of a mass or a spring about its start value, as natural logarithm.
_SEARCHED = 8.0
# Least prominence of a peak in ln of the gain; less is rounding.
_LEAST_PROMINENCE = 1e-6
# Model error that is allowed besides the stated uncertainty, relative to it.
_MODEL_ERROR = 0.1
# Least eigenvalue of a correlation relative to the greatest; less is rounding.
_INDEFINITE = 1e-9
# Evaluations for each of six start values, of which the best is continued. With eight evaluations
# one record in eight led into a valley that the search did not leave in 500.
_RACE_EVALUATIONS = 30


@dataclass(frozen=True, slots=True)
class KnownMode:
    """A pole or a conjugate pair, with standard uncertainties.

    frequency: undamped [Hz];  damping: ratio [1];  residue: of Eq. 8 with G(0) = 1 [1/s²]
    The damping of a real pole is 1 by definition, its uncertainty 0, and its residue None. The
    uncertainties of coinciding poles are infinite.
    """

    frequency: float
    frequency_uncertainty: float
    damping: float
    damping_uncertainty: float
    residue: float | None
    residue_uncertainty: float | None


def modal_sum(modes: Sequence[KnownMode], frequency: ArrayLike) -> ComplexArray:
    """Return the response of Eq. 8 at ``frequency`` [Hz], of the same shape; not normalised."""
    s = np.asarray(2j * np.pi * np.asarray(frequency, np.float64), np.complex128)
    response = np.zeros_like(s)
    for mode in modes:
        if mode.residue is not None:
            omega = 2 * np.pi * mode.frequency
            response = response + mode.residue / (s**2 + 2 * mode.damping * omega * s + omega**2)
    return response


def known_modes(
    dynamics: TransferFunction, covariance: FloatArray | None = None
) -> tuple[KnownMode, ...]:
    """Return the modes of G, slowest first, with first-order uncertainties.

    covariance: (p, p), order numerator, denominator[1:], delay; None for no uncertainty

    The first-order uncertainty of nearly coinciding poles grows without bound.
    """
    if covariance is None:
        covariance = np.zeros((len(dynamics.numerator) + len(dynamics.denominator),) * 2)
    upper = sorted((pole for pole in dynamics.poles() if pole.imag >= 0), key=abs)
    # Where poles coincide, D'(p) = 0.
    with np.errstate(divide="ignore", invalid="ignore"):
        return tuple(_known(dynamics, complex(pole), covariance) for pole in upper)


def mode_entries(
    dynamics: TransferFunction, covariance: FloatArray
) -> list[dict[str, float | None]]:
    """Return the modes as JSON values for a certificate, with None for infinite values."""
    units = {"frequency": "_hz", "damping": "", "residue": "_per_s2"}
    return [
        {
            f"{name}{kind}{unit}": value if value is not None and np.isfinite(value) else None
            for name, unit in units.items()
            for kind in ("", "_uncertainty")
            for value in [getattr(mode, f"{name}{kind}")]
        }
        for mode in known_modes(dynamics, covariance)
    ]


def modal_remainder(dynamics: TransferFunction, up_to: float) -> float | None:
    """Return max ``|G - Eq. 8|`` / max ``|G|`` below ``up_to`` [Hz], without the delay.

    The terms of Eq. 8 lack real poles and the parts in s. None without an oscillating mode.
    """
    modes = known_modes(dynamics)
    if all(mode.residue is None for mode in modes):
        return None
    lines = np.linspace(0.0, up_to, GRID_POINTS)
    whole = replace(dynamics, delay=0.0).normalised().response(lines)
    return float(np.max(np.abs(whole - modal_sum(modes, lines))) / np.max(np.abs(whole)))


def _known(dynamics: TransferFunction, pole: complex, covariance: FloatArray) -> KnownMode:
    # dp/dd_i = -p^i / D'(p), as D(p) = 0.
    powers = np.arange(1, len(dynamics.denominator))
    slope = polynomial.polyval(pole, polynomial.polyder(dynamics.denominator))
    zeros = np.zeros(len(dynamics.numerator))
    moved = np.concatenate([zeros, -(pole**powers) / slope, [0.0]])
    size, damping = abs(pole), -pole.real / abs(pole)
    # d ln p = d ln|p| + j d arg p, and damping = -cos(arg p).
    relative = moved / pole
    by_angle = relative.imag * np.sqrt(max(1 - damping**2, 0.0))
    residue, by_residue = _residue(dynamics, pole, moved) if pole.imag else (None, None)
    return KnownMode(
        frequency=size / (2 * np.pi),
        frequency_uncertainty=size / (2 * np.pi) * _spread(relative.real, covariance),
        damping=damping,
        damping_uncertainty=_spread(by_angle, covariance),
        residue=residue,
        residue_uncertainty=None if by_residue is None else _spread(by_residue, covariance),
    )


def _residue(
    dynamics: TransferFunction, pole: complex, moved: ComplexArray
) -> tuple[float, FloatArray]:
    """Return the residue of Eq. 8 and its derivative by the coefficients, (p,).

    The partial fractions ``r/(s-p) + r*/(s-p*)``, r = N(p) / (N(0) D'(p)), have the value
    ``-2 Re(r p*) / |p|²`` at s = 0; the term of Eq. 8 with that value has -2 Re(r p*).
    """
    numerator, denominator = dynamics.numerator, dynamics.denominator
    first, second = (polynomial.polyder(denominator, k) for k in (1, 2))
    slope, bend = (polynomial.polyval(pole, d) for d in (first, second))
    residue = polynomial.polyval(pole, numerator) / (numerator[0] * slope)
    up, down = np.arange(len(numerator)), np.arange(1, len(denominator))
    by_numerator = pole**up / (numerator[0] * slope)
    by_numerator[0] -= residue / numerator[0]
    by_coefficient = np.concatenate(
        [by_numerator, -residue * down * pole ** (down - 1) / slope, [0.0]]
    )
    steepness = polynomial.polyval(pole, polynomial.polyder(numerator)) / (numerator[0] * slope)
    by_pole = steepness - residue * bend / slope
    change = by_coefficient + by_pole * moved
    derivative = -2 * np.real(change * np.conj(pole) + residue * np.conj(moved))
    return float(-2 * np.real(residue * np.conj(pole))), np.asarray(derivative, np.float64)


def _spread(direction: FloatArray, covariance: FloatArray) -> float:
    spread = float(spread_along(direction, covariance))
    return spread if np.isfinite(spread) else np.inf


@dataclass(frozen=True)
class TwoMass:
    """m1, m2 [kg];  k1, k2 [N/m];  c1, c2 [N·s/m]; all positive."""

    m1: float
    m2: float
    k1: float
    k2: float
    c1: float
    c2: float

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (np.isfinite(value) and value > 0):
                raise DataError("lti.two_mass", name=name, value=value)

    def polynomials(self, *, collocated: bool) -> tuple[list[float], list[float]]:
        """Return ascending numerator and denominator of the motion of m1, or of m2 (Eq. 7)."""
        m1, m2, k1, k2, c1, c2 = self.m1, self.m2, self.k1, self.k2, self.c1, self.c2
        return [k2, c2, *([m2] if collocated else [])], [
            k1 * k2,
            k1 * c2 + k2 * c1,
            (m1 + m2) * k2 + m2 * k1 + c1 * c2,
            (m1 + m2) * c2 + m2 * c1,
            m1 * m2,
        ]


@dataclass(frozen=True, eq=False)
class TwoMassFit:
    """A fitted two-mass model.

    uncertainty: standard, relative, of m2, k1, k2, c1, c2, shape (5,)
    misfit: root of the reduced χ² of the difference of the responses; about 1 if the model is
        right, infinite if the search did not converge
    """

    model: TwoMass
    uncertainty: FloatArray
    misfit: float


def fit_two_mass(
    dynamics: TransferFunction,
    covariance: FloatArray,
    *,
    table_mass: float,
    collocated: bool,
    frequencies: ArrayLike,
) -> TwoMassFit:
    """Return the masses, springs and dampers whose Eq. 7 fits an identified ``dynamics`` best.

    covariance: of its coefficients (p, p), for the weights and the uncertainty
    table_mass: m1 [kg], which a response does not determine; 1 for values relative to it
    frequencies: at which the responses are compared [Hz]

    Raises IdentificationError if G has fewer than two oscillating modes.
    """
    lines = np.asarray(frequencies, np.float64)
    oscillating = oscillations(dynamics)
    if len(oscillating) < 2:
        raise IdentificationError("lti.few_modes", modes=len(oscillating))
    target = np.log(dynamics.response(lines))
    powers = (2j * np.pi * lines) ** np.arange(5)[:, np.newaxis]
    jacobian = relative_response_jacobian(dynamics, lines).reshape(2 * len(lines), -1)
    whiten = _whitener(jacobian, covariance)

    def model(logs: FloatArray) -> TwoMass:
        return TwoMass(table_mass, *(float(v) for v in np.exp(logs)))

    def polynomials(logs: FloatArray) -> list[tuple[ComplexArray, float]]:
        # A transfer function, which checks its coefficients, would take three times as long.
        each = model(logs).polynomials(collocated=collocated)
        return [(one @ powers[: len(one)], one[0]) for one in each]

    def residual(logs: FloatArray) -> FloatArray:
        (up, up_0), (down, down_0) = polynomials(logs)
        difference = np.log(up / down * (down_0 / up_0)) - target
        turned = np.angle(np.exp(1j * difference.imag))
        return np.asarray(whiten @ np.concatenate([difference.real, turned]))

    def slopes(logs: FloatArray) -> FloatArray:
        # Each coefficient is linear in each of the five: doubled, one adds its derivative by ln.
        (up, up_0), (down, down_0) = polynomials(logs)
        rows = []
        for each in logs + np.log(2) * np.eye(len(logs)):
            (more_up, more_up_0), (more_down, more_down_0) = polynomials(each)
            rows.append(more_up / up - more_up_0 / up_0 - more_down / down + more_down_0 / down_0)
        both = np.concatenate([np.real(rows), np.imag(rows)], axis=1)
        return np.asarray(whiten @ both.T)

    best = _least(residual, slopes, _starts(oscillating, table_mass))
    spread = np.linalg.pinv(best.jac) @ whiten @ jacobian
    dof = max(np.count_nonzero(np.diag(covariance)) - len(FITTED), 1)
    misfit = np.sqrt(2 * best.cost / dof) if best.success else np.inf
    return TwoMassFit(model(best.x), spread_along(spread, covariance), float(misfit))


def _least(
    residual: Callable[[FloatArray], FloatArray],
    slopes: Callable[[FloatArray], FloatArray],
    starts: Sequence[FloatArray],
) -> "scipy.optimize.OptimizeResult":
    """Minimise the sum of squares from all ``starts`` briefly, then from the best to the end."""

    def descend(start: FloatArray, evaluations: int | None) -> "scipy.optimize.OptimizeResult":
        box = (start - _SEARCHED, start + _SEARCHED)
        return scipy.optimize.least_squares(
            residual, start, slopes, x_scale="jac", bounds=box, max_nfev=evaluations
        )

    raced = [descend(start, _RACE_EVALUATIONS) for start in starts]
    return descend(min(raced, key=lambda found: float(found.cost)).x, None)


def _whitener(jacobian: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return W (k, k) with Wᵀ W the inverse covariance of the response at all lines.

    The covariance of the response of a few coefficients is singular, so a model error of a tenth
    of the standard uncertainty is added, independent from line to line.
    """
    stated = jacobian @ covariance @ jacobian.T
    variance = np.maximum(np.diag(stated), 0.0)
    floor = 1e-6 * float(np.max(variance)) or 1.0
    further = _MODEL_ERROR**2 * np.diag(np.maximum(variance, floor))
    # Coefficients of very different size make the covariance indefinite by rounding.
    return inverse_root(stated + further, _INDEFINITE, keep=True).T


def oscillations(dynamics: TransferFunction) -> tuple[float, ...]:
    """Return the frequencies of the conjugate pairs of poles [Hz], lowest first."""
    return tuple(mode.frequency for mode in known_modes(dynamics) if mode.residue is not None)


def _starts(oscillating: tuple[float, ...], table_mass: float) -> list[FloatArray]:
    low, high = (2 * np.pi * frequency for frequency in oscillating[:2])
    starts = []
    for ratio in (0.05, 0.2, 0.8):
        for first, second in ((low, high), (high, low)):
            m2 = ratio * table_mass
            k1, k2 = table_mass * first**2, m2 * second**2
            c1, c2 = 0.05 * np.sqrt(k1 * table_mass), 0.05 * np.sqrt(k2 * m2)
            starts.append(np.log([m2, k1, k2, c1, c2]))
    return starts


def response_features(dynamics: TransferFunction, up_to: float) -> dict[str, float | None]:
    """Return the salient points of |G| below ``up_to`` [Hz]; None where there is none.

    resonance, resonance_gain: highest peak of the gain;  minimum, minimum_gain: lowest dip
    bandwidth_3db, bandwidth_1_percent: where the gain first differs from 1 by 3 dB and by 1 %
    """
    frequency = np.geomspace(1e-3 * up_to, up_to, _SHAPE_LINES)
    gain = np.abs(dynamics.response(frequency)) / abs(dynamics.dc_gain)
    found: dict[str, float | None] = {}
    for name, sign in (("resonance", 1), ("minimum", -1)):
        peaks, _ = scipy.signal.find_peaks(sign * np.log(gain), prominence=_LEAST_PROMINENCE)
        peak = peaks[np.argmax(sign * gain[peaks])] if len(peaks) else None
        found[name] = None if peak is None else float(frequency[peak])
        found[f"{name}_gain"] = None if peak is None else float(gain[peak])
    for name, inside in (("3db", np.log(10 ** (3 / 20))), ("1_percent", -np.log(0.99))):
        outside = np.flatnonzero(np.abs(np.log(gain)) > inside)
        found[f"bandwidth_{name}"] = float(frequency[outside[0]]) if len(outside) else None
    return found
