"""Plausibility of a calibration: can a machine have these dynamics, and can they be computed with?

A calibration comes from a file or over the network. Numbers that no machine has (a delay of
minutes, a pole in a million years) are not only wrong: filters made of them take all memory.
"""

import numpy as np

from omsm_ros.core.lti.transfer_function import ComplexArray, TransferFunction
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import CalibrationError
from omsm_ros.quantities import DELAY, ORDER, SAMPLE_PERIOD, TIME_CONSTANT

# G_m(0) = 1 by definition; rounding of the coefficients leaves far less than this.
_UNIT_GAIN = 1e-6
# A wrong initial state decays to 1e-9 after 21 time constants: some six million samples.
MAX_TIME_CONSTANT_SAMPLES = 300_000
# The filter has a section for two samples of delay, and each costs time for every sample.
MAX_DELAY_SAMPLES = 10_000
# Uncertainty of the response at the end of its trusted band that a coefficient alone may bring.
_MAX_UNCERTAINTY = 1e9
# Rounding makes a semidefinite correlation matrix this little indefinite.
_INDEFINITE = 1e-6


def check_dynamics(dynamics: TransferFunction, sample_period: float) -> None:
    """Raise CalibrationError for a G_m that no machine sampled every ``sample_period`` [s] has.

    Whether it is stable is the calibration's own question.
    """
    SAMPLE_PERIOD.checked(sample_period, CalibrationError, "sample_period")
    ORDER.checked(len(dynamics.denominator) - 1, CalibrationError, "order of the denominator")
    if abs(dynamics.dc_gain - 1) > _UNIT_GAIN:
        raise CalibrationError("calibration.dc_gain", gain=dynamics.dc_gain)
    DELAY.checked(dynamics.delay, CalibrationError)
    _check_samples("delay", dynamics.delay, sample_period, MAX_DELAY_SAMPLES)
    poles, zeros = checked_roots(dynamics, "poles"), checked_roots(dynamics, "zeros")
    with np.errstate(divide="ignore"):
        # A zero may be as good as infinite: its coefficient is nothing then.
        ends = np.maximum(1 / abs(zeros), TIME_CONSTANT.low)
        times, decays = 1 / abs(poles), 1 / abs(poles.real)
    for time in [*ends.tolist(), *times.tolist()]:
        TIME_CONSTANT.checked(time, CalibrationError, "time constant of G_m")
    if len(poles):
        slowest = float(np.max(decays))
        TIME_CONSTANT.checked(slowest, CalibrationError, "slowest decay of G_m")
        _check_samples("slowest decay", slowest, sample_period, MAX_TIME_CONSTANT_SAMPLES)


def check_covariance(covariance: FloatArray, dynamics: TransferFunction, trusted: float) -> None:
    """Raise CalibrationError unless this is the covariance of the parameters of ``dynamics``.

    covariance: (p, p), order numerator, denominator[1:], delay
    trusted: highest frequency at which the response is trusted [Hz]
    """
    variance = np.diag(covariance)
    if np.any(variance < 0):
        raise CalibrationError("calibration.negative_variance")
    deviation = np.sqrt(variance)
    scale = deviation[:, np.newaxis] * deviation
    if np.any(abs(covariance - covariance.T) > 1e-9 * scale):
        raise CalibrationError("calibration.asymmetric_covariance")
    free = np.flatnonzero(np.diag(scale))
    correlation = (covariance / np.where(scale > 0, scale, 1.0))[np.ix_(free, free)]
    least = float(np.min(np.linalg.eigvalsh(correlation), initial=0.0))
    if least < -_INDEFINITE or np.any(covariance[scale == 0] != 0):
        raise CalibrationError("calibration.indefinite_covariance", eigenvalue=least)
    powers = [*range(len(dynamics.numerator)), *range(1, len(dynamics.denominator)), 1]
    with np.errstate(over="ignore"):
        at_end = deviation * (2 * np.pi * trusted) ** np.array(powers, np.float64)
    if np.any(~(at_end <= _MAX_UNCERTAINTY)):
        raise CalibrationError(
            "calibration.large_covariance", frequency=trusted, factor=float(np.max(at_end))
        )


def _check_samples(name: str, seconds: float, sample_period: float, most: int) -> None:
    if seconds > most * sample_period:
        raise CalibrationError(
            "calibration.too_many_samples",
            name=name,
            time=seconds,
            samples=seconds / sample_period,
            period=sample_period,
            most=most,
        )


def checked_roots(dynamics: TransferFunction, kind: str) -> ComplexArray:
    """Return the ``kind`` of ``dynamics``, "poles" or "zeros" [rad/s].

    Raises CalibrationError where they cannot be computed.
    """
    with np.errstate(all="ignore"):
        try:
            roots = dynamics.poles() if kind == "poles" else dynamics.zeros()
        except (np.linalg.LinAlgError, ZeroDivisionError, OverflowError):
            roots = np.array([np.nan + 0j])
    if not np.all(np.isfinite(roots)):
        raise CalibrationError("calibration.roots", kind=kind)
    return roots
