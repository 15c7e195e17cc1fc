"""The modes of a response, Eq. 8, and how well they are known of an identified one.

G without its delay is a sum over its poles. A conjugate pair adds, up to a part in s,
``residue / (s² + 2 ζ ω s + ω²)``; the print lacks the s behind 2 ζ ω.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import ArrayLike
from scipy import optimize, signal

from omsm_ros.core.lti.frequency_response import relative_response_jacobian, spread_along
from omsm_ros.core.lti.transfer_function import ComplexArray, TransferFunction
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import DataError, IdentificationError

# Evenly up to the highest frequency: the terms are compared with the response at each.
_LINES = 400


@dataclass(frozen=True, slots=True)
class ModalTerm:
    """One term of Eq. 8: residue α/m [1/s²], undamped frequency [Hz], damping ratio."""

    residue: float
    frequency: float
    damping: float


def modal_sum(terms: Sequence[ModalTerm], frequency: ArrayLike) -> ComplexArray:
    """Return the response of Eq. 8 at ``frequency`` [Hz], of the same shape; not normalised."""
    s = np.asarray(2j * np.pi * np.asarray(frequency, np.float64), np.complex128)
    response = np.zeros_like(s)
    for term in terms:
        omega = 2 * np.pi * term.frequency
        response = response + term.residue / (s**2 + 2 * term.damping * omega * s + omega**2)
    return response


@dataclass(frozen=True, slots=True)
class KnownMode:
    """A pole or a conjugate pair, with standard uncertainties.

    frequency: undamped [Hz];  damping: ratio [1];  residue: of Eq. 8 where G(0) = 1 [1/s²]
    The damping of a real pole is 1 by definition, its uncertainty 0; it has no residue.
    Of poles that coincide the uncertainties are infinite.
    """

    frequency: float
    frequency_uncertainty: float
    damping: float
    damping_uncertainty: float
    residue: float | None
    residue_uncertainty: float | None

    def term(self) -> ModalTerm | None:
        """Return its term of Eq. 8, None for a real pole."""
        if self.residue is None:
            return None
        return ModalTerm(self.residue, self.frequency, self.damping)


def known_modes(dynamics: TransferFunction, covariance: FloatArray) -> tuple[KnownMode, ...]:
    """Return the modes of G, slowest first, with uncertainties linear in those of the coefficients.

    covariance: (p, p), order numerator, denominator[1:], delay

    Of poles that nearly coincide the linear uncertainty is large without bound, and says
    no more than that.
    """
    upper = sorted((pole for pole in dynamics.poles() if pole.imag >= 0), key=abs)
    # Where poles coincide, D'(p) = 0.
    with np.errstate(divide="ignore", invalid="ignore"):
        return tuple(_known(dynamics, complex(pole), covariance) for pole in upper)


def mode_entries(dynamics: TransferFunction, covariance: FloatArray) -> list[dict[str, object]]:
    """Return the modes as JSON values with units, for a certificate; what is not finite as None."""
    return [
        {
            "frequency_hz": mode.frequency,
            "frequency_uncertainty_hz": _finite(mode.frequency_uncertainty),
            "damping": mode.damping,
            "damping_uncertainty": _finite(mode.damping_uncertainty),
            "residue_per_s2": _finite(mode.residue),
            "residue_uncertainty_per_s2": _finite(mode.residue_uncertainty),
        }
        for mode in known_modes(dynamics, covariance)
    ]


def _finite(value: float | None) -> float | None:
    return value if value is not None and np.isfinite(value) else None


def modal_remainder(dynamics: TransferFunction, up_to: float) -> float | None:
    """Return max ``|G - Eq. 8|`` over max ``|G|`` below ``up_to`` [Hz], without the delay.

    What the terms do not say: real poles and the parts in s. None where nothing oscillates.
    """
    size = len(dynamics.numerator) + len(dynamics.denominator)
    modes = known_modes(dynamics, np.zeros((size, size)))
    terms = [term for term in (mode.term() for mode in modes) if term is not None]
    if not terms:
        return None
    lines = np.linspace(0.0, up_to, _LINES)
    whole = replace(dynamics, delay=0.0).normalised().response(lines)
    return float(np.max(np.abs(whole - modal_sum(terms, lines))) / np.max(np.abs(whole)))


def _known(dynamics: TransferFunction, pole: complex, covariance: FloatArray) -> KnownMode:
    moved = _pole_jacobian(dynamics, pole)
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


def _pole_jacobian(dynamics: TransferFunction, pole: complex) -> ComplexArray:
    """Return dp/d(numerator, denominator[1:], delay), (p,); dp/dd_i = -p^i / D'(p), as D(p) = 0."""
    powers = np.arange(1, len(dynamics.denominator))
    slope = polynomial.polyval(pole, polynomial.polyder(dynamics.denominator))
    zeros = np.zeros(len(dynamics.numerator))
    return np.concatenate([zeros, -(pole**powers) / slope, [0.0]])


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


# The machine as masses, springs and dampers: the paper's Eq. 6 and 7, and their fit to a G(s).
#
# Two masses in a chain from the ground: ``m1`` on ``k1, c1``, and ``m2`` on ``m1`` through
# ``k2, c2``, driven by a force on ``m1``. Eq. 7 is the motion of ``m2`` (non-collocated); of
# ``m1`` itself it is the collocated one. Its printed ``a1 = (k1 + k2) c1`` does not follow
# from the equations of motion, and is unstable for ordinary machines; it is
# ``a1 = k1 c2 + k2 c1``. A response says nothing of the scale of masses and stiffnesses
# together, so one of them has to be known, ``m1``, or taken as the unit of the others.

# What a fit finds, in the order of its uncertainties; m1 is given.
FITTED = ("m2", "k1", "k2", "c1", "c2")
# Times twenty over three decades: 0.2 % apart, closer than the width of any mode of metal.
_LINES_MASSES_AND_SPRINGS = 200
# Natural logarithm of how far from its guess a mass or a spring may come out.
_SEARCHED = 8.0
# In ln of the gain: less is rounding.
_LEAST_PROMINENCE = 1e-6
# Of the stated uncertainty, where no coefficient could follow the model.
_UNSTATED = 0.1
# Of the greatest eigenvalue of a correlation; rounding leaves less.
_INDEFINITE = 1e-9
# The six guesses race for this many steps; the best of them is followed to its end. After eight
# steps the leader of one record in eight led into a valley that it left in no 500 steps.
_RACE_EVALUATIONS = 30


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
                raise DataError(f"two-mass model: {name} is {value!r}, expected a positive number")

    def _denominator(self) -> list[float]:
        m1, m2, k1, k2, c1, c2 = self.m1, self.m2, self.k1, self.k2, self.c1, self.c2
        return [
            k1 * k2,
            k1 * c2 + k2 * c1,
            (m1 + m2) * k2 + m2 * k1 + c1 * c2,
            (m1 + m2) * c2 + m2 * c1,
            m1 * m2,
        ]

    def non_collocated(self) -> TransferFunction:
        """Return Eq. 7 scaled to G(0) = 1: the probe's mass, m2."""
        return TransferFunction.from_ascending([self.k2, self.c2], self._denominator()).normalised()

    def collocated(self) -> TransferFunction:
        """Return the driven mass, m1, scaled to G(0) = 1."""
        numerator = [self.k2, self.c2, self.m2]
        return TransferFunction.from_ascending(numerator, self._denominator()).normalised()


@dataclass(frozen=True, eq=False)
class TwoMassFit:
    """model: fitted;  uncertainty: standard, relative, of m2, k1, k2, c1, c2, shape (5,)
    misfit: root of χ² per degree of freedom, of the response's difference over what is
        stated of it; about 1 where the model is right, infinite where the search did not end
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
    """Return masses, springs and dampers whose Eq. 7 comes closest to an identified ``dynamics``.

    covariance: of its coefficients (p, p), weighs the fit and gives the uncertainty; a delay
        among them is one more thing that the model has to explain
    table_mass: m1 [kg], which no response determines; 1 for all others relative to it
    frequencies: lines to compare at [Hz]

    Raises IdentificationError when G has fewer than two modes to explain.
    """
    lines = np.asarray(frequencies, np.float64)
    oscillating = oscillations(dynamics)
    if len(oscillating) < 2:
        raise IdentificationError(
            f"the two-mass model needs two oscillating modes, the response has {len(oscillating)!r}"
        )
    target = np.log(dynamics.response(lines))
    jacobian = _stacked_jacobian(dynamics, lines)
    whiten = _whitener(jacobian, covariance)

    def model(logs: FloatArray) -> TwoMass:
        return TwoMass(table_mass, *(float(v) for v in np.exp(logs)))

    def residual(logs: FloatArray) -> FloatArray:
        two = model(logs)
        found = two.collocated() if collocated else two.non_collocated()
        difference = np.log(found.response(lines)) - target
        turned = np.angle(np.exp(1j * difference.imag))
        return np.asarray(whiten @ np.concatenate([difference.real, turned]))

    best = _least(residual, _starts(oscillating, table_mass))
    spread = np.linalg.pinv(best.jac) @ whiten @ jacobian
    dof = max(np.count_nonzero(np.diag(covariance)) - len(FITTED), 1)
    misfit = np.sqrt(2 * best.cost / dof) if best.success else np.inf
    return TwoMassFit(model(best.x), spread_along(spread, covariance), float(misfit))


def _least(
    residual: Callable[[FloatArray], FloatArray], starts: Sequence[FloatArray]
) -> optimize.OptimizeResult:
    """Return the least sum of squares; all ``starts`` race, and the best of them is followed."""

    def descend(start: FloatArray, evaluations: int | None) -> optimize.OptimizeResult:
        box = (start - _SEARCHED, start + _SEARCHED)
        # What is well stated weighs 10⁴ times what is not: one-sided differences are too coarse.
        return optimize.least_squares(
            residual, start, jac="3-point", x_scale="jac", bounds=box, max_nfev=evaluations
        )

    raced = [descend(start, _RACE_EVALUATIONS) for start in starts]
    return descend(min(raced, key=lambda found: float(found.cost)).x, None)


def _stacked_jacobian(dynamics: TransferFunction, lines: FloatArray) -> FloatArray:
    return relative_response_jacobian(dynamics, lines).reshape(2 * len(lines), -1)


def _whitener(jacobian: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return W with Wᵀ W the inverse covariance of the response at all lines together, (k, k).

    The response of a few coefficients is the same statement many times over. What it cannot
    state at all, for it has no coefficient for it, counts ten times as much as its variance.
    """
    stated = jacobian @ covariance @ jacobian.T
    variance = np.maximum(np.diag(stated), 0.0)
    floor = 1e-6 * float(np.max(variance)) or 1.0
    further = _UNSTATED**2 * np.diag(np.maximum(variance, floor))
    total = stated + further
    deviation = np.sqrt(np.maximum(np.diag(total), np.diag(further)))
    values, directions = np.linalg.eigh(total / np.outer(deviation, deviation))
    # Coefficients far apart in size leave a covariance that rounding makes indefinite.
    least = _INDEFINITE * float(values[-1])
    return np.asarray((directions / np.sqrt(np.maximum(values, least))).T / deviation)


def oscillations(dynamics: TransferFunction) -> tuple[float, ...]:
    """Return the frequencies of the conjugate pairs of poles [Hz], lowest first."""
    return tuple(mode.frequency for mode in dynamics.modes() if mode.damping < 1)


def _starts(oscillating: tuple[float, ...], table_mass: float) -> list[FloatArray]:
    """Return the uncoupled guesses with either mode belonging to the second mass."""
    low, high = (2 * np.pi * frequency for frequency in oscillating[:2])
    starts = []
    for ratio in (0.05, 0.2, 0.8):
        for first, second in ((low, high), (high, low)):
            m2 = ratio * table_mass
            k1, k2 = table_mass * first**2, m2 * second**2
            c1, c2 = 0.05 * np.sqrt(k1 * table_mass), 0.05 * np.sqrt(k2 * m2)
            starts.append(np.log([m2, k1, k2, c1, c2]))
    return starts


@dataclass(frozen=True)
class ResponseFeatures:
    """What a response looks like; Hz, NaN where it has no such point below ``up_to``.

    resonance: of the highest peak of the gain, and that gain;  minimum: of the lowest dip
    bandwidth_3db: where the gain first leaves 1 by 3 dB;  bandwidth_1_percent: by 1 %
    """

    resonance: float
    resonance_gain: float
    minimum: float
    minimum_gain: float
    bandwidth_3db: float
    bandwidth_1_percent: float


def response_features(dynamics: TransferFunction, up_to: float) -> ResponseFeatures:
    """Read the salient points of |G| below ``up_to`` [Hz]."""
    frequency = np.geomspace(1e-3 * up_to, up_to, 20 * _LINES_MASSES_AND_SPRINGS)
    gain = np.abs(dynamics.response(frequency)) / abs(dynamics.dc_gain)
    highest, lowest = _highest_peak(np.log(gain)), _highest_peak(-np.log(gain))

    def point(index: int | None) -> tuple[float, float]:
        if index is None:
            return float("nan"), float("nan")
        return float(frequency[index]), float(gain[index])

    def leaves(inside: float) -> float:
        outside = np.flatnonzero(np.abs(np.log(gain)) > inside)
        return float(frequency[outside[0]]) if len(outside) else float("nan")

    return ResponseFeatures(
        *point(highest), *point(lowest), leaves(np.log(10 ** (3 / 20))), leaves(-np.log(0.99))
    )


def finite_values(read: ResponseFeatures) -> dict[str, float | None]:
    """Return the fields of ``read`` as JSON values, None for NaN."""
    return {name: value if np.isfinite(value) else None for name, value in asdict(read).items()}


def _highest_peak(values: FloatArray) -> int | None:
    """Return the index of the highest peak, None without one; an end is no peak."""
    peaks, _ = signal.find_peaks(values, prominence=_LEAST_PROMINENCE)
    return int(peaks[np.argmax(values[peaks])]) if len(peaks) else None
