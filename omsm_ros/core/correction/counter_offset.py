"""Offset between the trigger counts of two devices from a motion before a fixed target.

Before a fixed target the distance at count n is ``d = a + b n - g z``, if z is taken at the right
count. The whole number of samples with the least residual is searched first; then the remaining
fraction δ of a sample is fitted: ``d = a + b n - g (z + δ ż T)``. A lag of probe or structure looks
like a fraction of a sample, so it must be known, or much shorter than one.

Stamps show a slip only beyond half a sample and the delay of the links, and a constant delay of a
link looks like a slip. The motion distinguishes both, see :class:`LiveOffset`.
"""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.streams.blocks import AxisBlock, DistanceBlock, FloatArray, on_counts
from omsm_ros.errors import DataError
from omsm_ros.linear_algebra import unit_columns

# Range of g before a fixed target; it has any value while the probe follows a surface.
_GAIN = (0.8, 1.25)
# Least ratio of the residual elsewhere to that at the offset; a periodic or small motion fits at
# several offsets.
_CONTRAST = 1.5
# Width of the minimum, within which the fit decides [samples].
_FLANK = 3
# Samples from which the correlation of the residuals can be estimated.
_LEAST_SAMPLES = 200
# The whole number is certain if fraction and three standard uncertainties stay below one half.
_ROOM, _COVERAGE = 0.5, 3.0
# Span of the newest motion that is judged [s], and its most samples.
_SPAN_S, _MOST_SAMPLES = 4.0, 16_384
# Range of the search: the longest delay of a link, or error of a clock that still adjusts [s].
_SEARCH_S = 0.25
# Relative tolerance of the static gain. A surface that moves with Z some samples later would look
# like an offset, but with another gain than a fixed target.
_SAME_GAIN = 0.01
# Time between two results that must agree, so that they rest on different motion [s].
_APART_S = 1.0


@dataclass(frozen=True, slots=True)
class CounterOffset:
    """Offset of two counters.

    samples: added to the distance's count, it gives the axes' count
    fraction: of a sample, left by the fit after the known lag;  uncertainty: of it, k = 1
    gain: decrease of the distance per rise of Z [1]
    """

    samples: int
    fraction: float
    uncertainty: float
    gain: float


def counter_offset(
    z: FloatArray,
    distance: FloatArray,
    ok: NDArray[np.bool_],
    *,
    most: int,
    lag: float = 0.0,
    lag_uncertainty: float = 0.1,
) -> CounterOffset:
    """Return the offset of two counters from a motion before a fixed target.

    z, distance: at equal counts [m], (n,);  ok: True where the distance is valid, (n,)
    most: the largest offset that is searched [samples]
    lag, lag_uncertainty: known lag of the distance behind Z [samples]

    Raises DataError, with the reason, if the motion does not determine the offset.
    """
    valid, least = int(np.count_nonzero(ok)), max(_LEAST_SAMPLES, 4 * most)
    if valid < least:
        raise DataError("correction.few_samples", samples=valid, most=most, least=least)
    # Wider than a minimum, so that there are other offsets to compare with.
    reach = max(most, _FLANK + 1)
    level = np.where(ok, distance - float(np.mean(distance[ok])), 0.0)
    residual = _residuals(z - float(np.mean(z)), level, ok, reach)
    best = reach - most + int(np.argmin(residual[reach - most : reach + most + 1]))
    elsewhere = np.delete(_between(residual), np.s_[max(0, best - _FLANK) : best + _FLANK + 1])
    contrast = float(elsewhere.min() / max(residual[best], np.finfo(float).tiny))
    if contrast < _CONTRAST:
        raise DataError(
            "correction.several_offsets", ratio=contrast, samples=best - reach, least=_CONTRAST
        )
    return _refined(z, distance, ok, best - reach, lag, lag_uncertainty)


def _residuals(z: FloatArray, d: FloatArray, ok: NDArray[np.bool_], most: int) -> FloatArray:
    """Return the share of the distance's variance not explained by Z, for offsets -most … most."""
    weight = ok.astype(np.float64)
    size = 1 << (len(z) + most).bit_length()
    wanted = np.arange(-most, most + 1)

    # Like scipy.signal.correlate, but without loading scipy.signal in a live node.
    def lagged(a: FloatArray, b: FloatArray) -> FloatArray:
        product = np.fft.rfft(a, size) * np.conj(np.fft.rfft(b, size))
        return np.asarray(np.fft.irfft(product, size)[wanted])

    inside = np.ones(len(z))
    n, sz, szz = lagged(inside, weight), lagged(z, weight), lagged(z * z, weight)
    sd, sdd, szd = lagged(inside, d), lagged(inside, d * d), lagged(z, d)
    vz, vd = szz - sz**2 / n, sdd - sd**2 / n
    shared = (szd - sz * sd / n) ** 2
    return np.asarray(np.clip(1.0 - shared / np.maximum(vz * vd, np.finfo(float).tiny), 0.0, 1.0))


def _between(residual: FloatArray) -> FloatArray:
    """Return the least residual near each offset (n,), from a parabola through three offsets."""
    before, here, after = residual[:-2], residual[1:-1], residual[2:]
    bend, tilt = before - 2 * here + after, (after - before) / 2
    inside = (bend > 0) & (abs(tilt) <= bend)
    vertex = here - np.where(inside, tilt**2 / (2 * np.where(inside, bend, 1.0)), 0.0)
    return np.concatenate([residual[:1], np.maximum(vertex, 0.0), residual[-1:]])


def _refined(
    z: FloatArray,
    distance: FloatArray,
    ok: NDArray[np.bool_],
    samples: int,
    lag: float,
    lag_uncertainty: float,
) -> CounterOffset:
    """Fit the remaining fraction of a sample at ``samples``; raise DataError if not certain."""
    index = np.flatnonzero(ok)
    index = index[(index + samples >= 1) & (index + samples < len(z) - 1)]
    here = index + samples
    speed = (z[here + 1] - z[here - 1]) / 2
    columns, scale = unit_columns(
        np.stack([np.ones(len(here)), index - index.mean(), z[here], speed], axis=1)
    )
    solved, *_ = np.linalg.lstsq(columns, distance[index], rcond=None)
    residual = distance[index] - columns @ solved
    gain, moved = -solved[2] / scale[2], -solved[3] / scale[3]
    if not _GAIN[0] < abs(gain) < _GAIN[1]:
        raise DataError("correction.gain", gain=float(gain), least=_GAIN[0], most=_GAIN[1])
    inverse = np.linalg.pinv(columns.T @ columns)
    total = float(residual @ residual)
    # Residuals are correlated, which reduces the number of independent samples: by (1 + ρ)/(1 - ρ)
    # for a first-order process.
    near = float(residual[1:] @ residual[:-1]) / total if total > 0 else 0.0
    near = min(max(near, 0.0), 0.999)
    alike = (1 + near) / (1 - near)
    spread = math.sqrt(total / max(len(here) - 4, 1) * alike * inverse[3, 3])
    uncertainty = math.hypot(spread / scale[3] / gain, lag_uncertainty)
    # The distance lags Z, which reduces the offset that is found.
    found = samples + moved / gain + lag
    whole = round(found)
    if abs(found - whole) + _COVERAGE * uncertainty > _ROOM:
        raise DataError("correction.no_whole_offset", samples=float(found), uncertainty=uncertainty)
    return CounterOffset(whole, found - whole, uncertainty, float(gain))


def offset_of_motion(
    z: FloatArray, distance: FloatArray, calibration: Calibration, period: float
) -> CounterOffset:
    """Return the offset within a quarter of a second, with the lag that ``calibration`` states.

    z, distance: at equal counts every ``period`` [s], NaN where lost [m], (n,)

    Raises DataError as :func:`counter_offset` does.
    """
    index, known = np.arange(len(z)), np.flatnonzero(np.isfinite(z))
    return counter_offset(
        np.interp(index, known, z[known]),
        distance,
        np.isfinite(distance),
        most=min(round(_SEARCH_S / period), len(z) // 8),
        lag=calibration.dynamics.low_frequency_delay / period,
        lag_uncertainty=calibration.low_frequency_delay_uncertainty / period,
    )


class LiveOffset:
    """Determines the offset of two running counters from the newest motion.

    calibration: gives the known lag of the distance
    in_use: offset that is added to the distance's count already [samples]
    established: further offset; None until a motion has determined it, and after a restart
    """

    def __init__(self, calibration: Calibration, in_use: int) -> None:
        self.in_use = in_use
        self.established: CounterOffset | None = None
        self._calibration = calibration
        self._axes: deque[tuple[int, FloatArray]] = deque()
        self._distance: deque[tuple[int, FloatArray]] = deque()
        self._found: tuple[int, int] | None = None
        self._period = 0.0

    def add(self, block: AxisBlock | DistanceBlock) -> None:
        """Take the next block of either stream."""
        first, parts = block.first_sample, self._axes
        if isinstance(block, DistanceBlock):
            first, parts = first + self.in_use, self._distance
            values = np.where(block.ok, block.distance, np.nan)
        else:
            values = block.z
        if parts and first < _end(parts):
            parts.clear()
            self.established = self._found = None
        parts.append((first, values))
        self._period = block.sample_period
        while _end(parts) - parts[0][0] - len(parts[0][1]) >= self._most:
            parts.popleft()

    @property
    def _most(self) -> int:
        """Number of samples that are kept and judged."""
        return min(max(round(_SPAN_S / self._period), 1), _MOST_SAMPLES)

    def judge(self) -> None:
        """Establish the offset if two successive motions give the same whole number."""
        if not self._axes or not self._distance:
            return
        period, streams = self._period, (self._axes, self._distance)
        end = min(map(_end, streams))
        first = max(*(parts[0][0] for parts in streams), end - self._most)
        if end <= first or (self._found is not None and end < self._found[0] + _APART_S / period):
            return
        z, distance = (on_counts(parts, first, end) for parts in streams)
        if not np.any(np.isfinite(z)):
            return
        try:
            found = offset_of_motion(z, distance, self._calibration, period)
        except DataError:
            return  # this motion does not determine the offset
        gain = abs(self._calibration.static_gain)
        if abs(abs(found.gain) - gain) > _SAME_GAIN * gain:
            return  # the probe follows a surface
        before, self._found = self._found, (end, found.samples)
        if before is not None and before[1] == found.samples:
            self.established = found


def _end(parts: deque[tuple[int, FloatArray]]) -> int:
    """Return the count after the last of ``parts``, which are (first count, values)."""
    return parts[-1][0] + len(parts[-1][1])
