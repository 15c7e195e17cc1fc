"""How well do repeated step tests agree, and is that as well as each says of itself?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.core.verification.change import (
    SIGNIFICANCE,
    common_lines,
    mahalanobis,
    response_covariance,
)
from omsm_ros.errors import CalibrationError
from omsm_ros.readable import chance, measured, plain


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
    """Of ``count`` calibrations of one machine.

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

    def text(self) -> str:
        """Return one line for a reader."""
        verdict = "as repeatable as stated" if self.repeatable else "scatter more than they state"
        lag, gain = self.delay, self.static_gain
        return (
            f"{self.count} calibrations {verdict} ({chance(self.p_value)}): "
            f"lag {measured(lag.mean, lag.deviation, 's')}{_of_stated(lag)}, "
            f"static gain {measured(gain.mean, gain.deviation, digits=6)}{_of_stated(gain)}"
        )


def _of_stated(spread: Spread) -> str:
    return f" ({plain(spread.ratio)} of stated)" if spread.stated else ""


def repeatability(calibrations: Sequence[Calibration]) -> Repeatability:
    """Compare the scatter of independent ``calibrations`` of one machine with their uncertainty.

    χ² sums the squared deviations from the mean, in the directions of the response that the
    mean covariance knows, and of the static gain where its uncertainty is stated.

    Raises CalibrationError for fewer than three, or where there is no band that all know.
    """
    count = len(calibrations)
    if count < 3:
        raise CalibrationError(f"{count!r} calibrations: repeatability needs three or more")
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
        [c.static_gain for c in calibrations],
        [c.static_gain_uncertainty for c in calibrations],
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
    """Return p-value of deviations from the mean, of the response ``off`` (n, 2k) and the gain."""
    free = len(off) - 1
    found = [mahalanobis(row, covariance) for row in off]
    statistic, known = sum(value for value, _ in found), found[0][1] * free
    if static_gain.stated:
        statistic, known = statistic + free * static_gain.ratio**2, known + free
    return float(stats.chi2.sf(statistic, known))
