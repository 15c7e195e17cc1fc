"""Repeatability and trend of calibrations, and change of a machine between two of them.

Two identified responses are compared over their common valid band with both covariances. The
result is the change and its significance in standard deviations.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy  # whose parts are loaded when they are used

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.lti.frequency_response import relative_response_jacobian
from omsm_ros.core.streams.blocks import BoolArray, FloatArray
from omsm_ros.errors import CalibrationError
from omsm_ros.linear_algebra import inverse_root

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
class CalibrationChange:
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


def compare_calibrations(old: Calibration, new: Calibration) -> CalibrationChange:
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
    p_value = float(scipy.stats.chi2.sf(statistic + gain_sigmas**2, known + (gain_sigma > 0)))
    delay = new.dynamics.low_frequency_delay - old.dynamics.low_frequency_delay
    sigma = math.hypot(*(c.low_frequency_delay_noise for c in (old, new)))
    worst = int(np.argmax(np.abs(ratio)))
    return CalibrationChange(
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
        raise CalibrationError("calibration.no_common_band", limits=limits)
    return np.asarray(np.linspace(top / _LINES, top, _LINES))


def response_covariance(calibration: Calibration, lines: FloatArray) -> FloatArray:
    """Return the covariance (2k, 2k) of relative gain, then phase [rad], at ``lines`` (k,) [Hz].

    That of the noise: undetected model errors are the same in each test of one machine, and
    do not distinguish two of them.
    """
    jacobian = relative_response_jacobian(calibration.dynamics, lines).reshape(2 * len(lines), -1)
    return np.asarray(jacobian @ calibration.noise_covariance @ jacobian.T)


def mahalanobis(
    difference: FloatArray, covariance: FloatArray, tolerance: float = _RANK_TOLERANCE
) -> tuple[float, int]:
    """Return χ² of ``difference`` in the directions that ``covariance`` spans, and their number.

    tolerance: directions of the correlation with less than this part of the largest are left out
    """
    root = inverse_root(covariance, tolerance)
    return float(np.sum((difference @ root) ** 2)), root.shape[1]


# Scatter of repeated step tests, compared with the uncertainty that each states.


@dataclass(frozen=True)
class Spread:
    """mean;  deviation: standard, of one calibration, n - 1;  stated: rms of the uncertainties."""

    mean: float
    deviation: float
    stated: float

    @property
    def ratio(self) -> float:
        """Deviation over the stated uncertainty; NaN where none is stated."""
        return self.deviation / self.stated if self.stated else float("nan")


@dataclass(frozen=True, eq=False)
class Repeatability:
    """Scatter of ``count`` calibrations of one machine.

    delay: low-frequency [s];  static_gain: [1]
    frequency: (k,) [Hz], at which gain [1, relative] and phase [rad] have a standard deviation
        and a stated standard uncertainty, all (k,)
    p_value: of a machine that repeats perfectly showing at least this scatter
    repeatable: verdict
    """

    count: int
    delay: Spread
    static_gain: Spread
    frequency: FloatArray
    gain_deviation: FloatArray
    phase_deviation: FloatArray
    gain_stated: FloatArray
    phase_stated: FloatArray
    p_value: float
    repeatable: bool


def repeatability(calibrations: Sequence[Calibration]) -> Repeatability:
    """Compare the scatter of independent ``calibrations`` of one machine with their uncertainty.

    χ² sums the squared deviations from the mean, in the directions of the response that the
    mean covariance knows, and of the static gain where its uncertainty is stated.

    Raises CalibrationError for fewer than three, or where there is no band that all know.
    """
    count = len(calibrations)
    if count < 3:
        raise CalibrationError("calibration.too_few", count=count)
    lines = common_lines(calibrations)
    responses = np.array([np.log(c.dynamics.response(lines)) for c in calibrations])
    off = np.concatenate([responses.real, np.unwrap(responses.imag, axis=0)], axis=1)
    off = np.asarray(off - np.mean(off, axis=0))
    covariance = np.mean([response_covariance(c, lines) for c in calibrations], axis=0)
    deviation, stated = np.std(off, axis=0, ddof=1), np.sqrt(np.diag(covariance))
    delay = _spread(
        [c.dynamics.low_frequency_delay for c in calibrations],
        [c.low_frequency_delay_noise for c in calibrations],
    )
    static_gain = _spread(
        [c.static_gain for c in calibrations], [c.static_gain_uncertainty for c in calibrations]
    )
    p_value = _chance(off, covariance, static_gain)
    k = len(lines)
    return Repeatability(
        count=count,
        delay=delay,
        static_gain=static_gain,
        frequency=lines,
        gain_deviation=deviation[:k],
        phase_deviation=deviation[k:],
        gain_stated=stated[:k],
        phase_stated=stated[k:],
        p_value=p_value,
        repeatable=p_value >= SIGNIFICANCE,
    )


def _spread(values: Sequence[float], uncertainties: Sequence[float]) -> Spread:
    return Spread(
        float(np.mean(values)),
        float(np.std(values, ddof=1)),
        float(np.sqrt(np.mean(np.square(uncertainties)))),
    )


def _chance(off: FloatArray, covariance: FloatArray, static_gain: Spread) -> float:
    free = len(off) - 1
    found = [mahalanobis(row, covariance) for row in off]
    statistic, known = sum(value for value, _ in found), found[0][1] * free
    if static_gain.stated:
        statistic, known = statistic + free * static_gain.ratio**2, known + free
    return float(scipy.stats.chi2.sf(statistic, known))


# Iglewicz and Hoaglin, How to Detect and Handle Outliers, 1993: 3.5 of the modified z-score.
_LIMIT = 3.5
# The median absolute deviation of a normal distribution is 0.6745 of its standard deviation.
_NORMAL = 0.6745
# A median and its spread are not reliable for fewer values.
FEWEST = 5
# Limits the number of slopes between two points to half a million, a few megabytes.
_MOST = 1000


def outliers(values: FloatArray) -> BoolArray:
    """Return True for each of ``values`` (n,) that lies far from the others; NaN never does.

    The criterion is the modified z-score ``0.6745 |v − median| / MAD`` > 3.5. Fewer than five
    values have no outliers. Where half the values are equal, the mean deviation replaces the MAD.
    """
    found = np.zeros(len(values), np.bool_)
    known = np.isfinite(values)
    if np.sum(known) < FEWEST:
        return found
    away = np.abs(values[known] - np.median(values[known]))
    spread = np.median(away) / _NORMAL or np.mean(away) * np.sqrt(np.pi / 2)
    found[known] = away > _LIMIT * spread if spread > 0 else False
    return found


@dataclass(frozen=True, slots=True)
class LinearTrend:
    """The slope of values over time [unit/s], with the ends of its 95 % interval."""

    slope: float
    low: float
    high: float

    @property
    def significant(self) -> bool:
        """Whether zero lies outside the interval."""
        return self.low > 0 or self.high < 0


def trend(times: FloatArray, values: FloatArray) -> LinearTrend | None:
    """Return the slope of ``values`` (n,) over ``times`` [s] (n,) after Theil and Sen.

    It is the median of all slopes between two points: a third of the points may be wrong. More
    than 1000 points are thinned evenly to 1000. None for fewer than five known values, or where
    all were taken at one time.
    """
    known = np.flatnonzero(np.isfinite(values) & np.isfinite(times))
    if len(known) < FEWEST or np.ptp(times[known]) <= 0:
        return None
    if len(known) > _MOST:
        known = known[np.argsort(times[known], kind="stable")]
        known = known[np.linspace(0, len(known) - 1, _MOST).round().astype(np.int64)]
    found = scipy.stats.theilslopes(values[known], times[known], alpha=0.95)
    return LinearTrend(float(found.slope), float(found.low_slope), float(found.high_slope))
