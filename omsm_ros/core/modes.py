"""How well are the poles of an identified response known, as frequencies and damping ratios?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import polynomial

from omsm_ros.core.calibration import Calibration
from omsm_ros.core.records import FloatArray
from omsm_ros.core.transfer_function import TransferFunction


@dataclass(frozen=True, slots=True)
class KnownMode:
    """A pole or a conjugate pair, with standard uncertainties: frequency [Hz], damping ratio [1].

    The damping of a real pole is 1 by definition, its uncertainty 0.
    """

    frequency: float
    frequency_uncertainty: float
    damping: float
    damping_uncertainty: float


def known_modes(calibration: Calibration) -> tuple[KnownMode, ...]:
    """Modes of G_m, slowest first; uncertainties linear in those of the denominator.

    From D(p) = 0 follows dp/dd_i = -p^i / D'(p). Of poles that nearly coincide the linear
    uncertainty is large without bound, and says no more than that.
    """
    dynamics = calibration.dynamics
    zeros, poles = len(dynamics.numerator), len(dynamics.denominator) - 1
    place = slice(zeros, zeros + poles)
    covariance = calibration.covariance[place, place]
    upper = [pole for pole in dynamics.poles() if pole.imag >= 0]
    return tuple(_known(dynamics, complex(p), covariance) for p in sorted(upper, key=abs))


def _known(dynamics: TransferFunction, pole: complex, covariance: FloatArray) -> KnownMode:
    powers = np.arange(1, len(dynamics.denominator))
    slope = polynomial.polyval(pole, polynomial.polyder(dynamics.denominator))
    relative = np.asarray(-(pole ** (powers - 1)) / slope, np.complex128)
    size, damping = abs(pole), -pole.real / abs(pole)
    # d ln p = d ln|p| + j d arg p, and damping = -cos(arg p).
    by_size, by_angle = relative.real, relative.imag * np.sqrt(max(1 - damping**2, 0.0))
    return KnownMode(
        frequency=size / (2 * np.pi),
        frequency_uncertainty=size / (2 * np.pi) * _spread(by_size, covariance),
        damping=damping,
        damping_uncertainty=_spread(by_angle, covariance),
    )


def _spread(direction: FloatArray, covariance: FloatArray) -> float:
    return float(np.sqrt(max(float(direction @ covariance @ direction), 0.0)))
