"""Outliers and linear trend of many measurements."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from omsm_ros.core.streams.blocks import BoolArray, FloatArray

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
    from scipy import stats  # loaded when it is needed: it takes a second

    found = stats.theilslopes(values[known], times[known], alpha=0.95)
    return LinearTrend(float(found.slope), float(found.low_slope), float(found.high_slope))
