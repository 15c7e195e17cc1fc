"""Has the machine changed since it was calibrated? Compare two identified responses.

The comparison is of the responses over the band both know, through both covariances: the
same, or changed by so much at so many sigma.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.dynamics.response_band import relative_response_jacobian
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.errors import CalibrationError
from omsm_ros.readable import chance, quantity
from omsm_ros.units import PPM

# Evenly over the common band; covariances have fewer independent directions than that.
_LINES = 30
# One in a thousand comparisons of an unchanged machine calls it changed.
SIGNIFICANCE = 1e-3
# Near the end of the trusted band two structures may differ by more than the noise of either.
_COMPARED_PART = 1 / 3
# Directions of the response known this much worse than the best say nothing.
_RANK_TOLERANCE = 1e-2
# Below it a response is the static gain and nothing else.
_LEAST_BAND_HZ = 0.1


@dataclass(frozen=True)
class Change:
    """From an old to a new calibration.

    delay: change of the low-frequency delay [s];  delay_sigmas: over its uncertainty
    gain_at, phase_at: largest change of gain [1] and phase [rad], at ``frequency`` [Hz]
    static_gain, static_gain_sigmas: change of the probe's static gain, as a share of it [1], and
        over its own
    p_value: of an unchanged machine showing at least this;  changed: verdict
    """

    delay: float
    delay_sigmas: float
    frequency: float
    gain_at: float
    phase_at: float
    static_gain: float
    static_gain_sigmas: float
    p_value: float
    changed: bool

    def text(self) -> str:
        """Return one line for a reader."""
        if not self.changed:
            return f"the same ({chance(self.p_value)})"
        return (
            f"changed: lag by {quantity(self.delay, 's', signed=True)} "
            f"({self.delay_sigmas:.1f} sigma), static gain by "
            f"{quantity(self.static_gain / PPM, 'ppm', signed=True)} "
            f"({self.static_gain_sigmas:.1f} sigma), {chance(self.p_value)}"
        )


def compare(old: Calibration, new: Calibration) -> Change:
    """Return what changed between two calibrations of one machine, independent of each other.

    Raises CalibrationError when there is no band that both know.
    """
    lines = common_lines((old, new))
    ratio = np.log(new.dynamics.response(lines) / old.dynamics.response(lines))
    difference = np.concatenate([ratio.real, np.angle(np.exp(1j * ratio.imag))])
    covariance = response_covariance(old, lines) + response_covariance(new, lines)
    statistic, known = mahalanobis(difference, covariance)
    gain_change = new.static_gain - old.static_gain
    gain_sigma = math.hypot(*(c.static_gain_uncertainty for c in (old, new)))
    gain_sigmas = abs(gain_change) / gain_sigma if gain_sigma else 0.0
    p_value = float(stats.chi2.sf(statistic + gain_sigmas**2, known + (gain_sigma > 0)))
    delay = new.dynamics.low_frequency_delay - old.dynamics.low_frequency_delay
    sigma = math.hypot(*(c.low_frequency_delay_noise for c in (old, new)))
    worst = int(np.argmax(np.abs(ratio)))
    return Change(
        delay=float(delay),
        delay_sigmas=float(abs(delay) / sigma) if sigma else float("inf"),
        frequency=float(lines[worst]),
        gain_at=float(difference[worst]),
        phase_at=float(difference[_LINES + worst]),
        static_gain=float(gain_change / old.static_gain),
        static_gain_sigmas=float(gain_sigmas),
        p_value=p_value,
        changed=p_value < SIGNIFICANCE,
    )


def common_lines(calibrations: Sequence[Calibration]) -> FloatArray:
    """Return frequencies (k,) [Hz] that all ``calibrations`` know; CalibrationError if none."""
    limits = [calibration.valid_up_to for calibration in calibrations]
    top = min(limits) * _COMPARED_PART
    if not top > _LEAST_BAND_HZ:
        raise CalibrationError(
            f"the calibrations have no common band: they are valid up to {limits!r} Hz; identify "
            "the one that ends lowest again"
        )
    return np.asarray(np.linspace(top / _LINES, top, _LINES))


def response_covariance(calibration: Calibration, lines: FloatArray) -> FloatArray:
    """Return the covariance (2k, 2k) of relative gain, then phase [rad], at ``lines`` (k,) [Hz].

    That of the noise: what could hide in a step test hides in each of one machine alike, and
    does not distinguish two of them.
    """
    jacobian = relative_response_jacobian(calibration.dynamics, lines).reshape(2 * len(lines), -1)
    return np.asarray(jacobian @ calibration.noise_covariance @ jacobian.T)


def mahalanobis(difference: FloatArray, covariance: FloatArray) -> tuple[float, int]:
    """Return χ² of ``difference`` in the directions that ``covariance`` spans, and their number."""
    scale = np.sqrt(np.diag(covariance))
    scale[scale == 0] = 1.0
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    known = values > _RANK_TOLERANCE * values[-1]
    along = vectors[:, known].T @ (difference / scale)
    return float(np.sum(along**2 / values[known])), int(np.sum(known))
