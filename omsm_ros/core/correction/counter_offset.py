"""By how much do the trigger counts of two devices differ? What the motion itself says.

Before a fixed target the distance is ``d = a + b n - g z``, and only at the right offset does the
distance at one count answer to Z at the other. The offset of the least residual is searched among
whole samples; what is left of it, a fraction, is fitted there: ``d = a + b n - g (z + δ ż T)``. A
probe or a structure that is late looks like a part of a sample, so the lag must be small against
one, or known.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.streams.blocks import AxisBlock, DistanceBlock, FloatArray
from omsm_ros.errors import DataError

# Before a fixed target g is 1 to some per cent; a followed surface gives anything.
_GAIN = (0.8, 1.25)
# The residual elsewhere must be so many times that at the offset: a motion that repeats itself,
# or hardly moves, fits at several.
_CONTRAST = 1.5
# Offsets nearer than this are the flank of one minimum; the fit judges them [samples].
_FLANK = 3
_LEAST_SAMPLES = 200
# The whole number is sure if the fraction and three of its uncertainties leave room to the next.
_ROOM, _SURE = 0.5, 3.0


@dataclass(frozen=True, slots=True)
class CounterOffset:
    """samples: added to the distance's count, it gives the axes' count

    fraction: of a sample that the fit leaves, after the known lag;  uncertainty: of it (k = 1)
    gain: by how much the distance falls as Z rises
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

    z, distance: at equal counts [m], (n,);  ok: where the distance is one, (n,)
    most: the largest offset that is searched [samples]
    lag, lag_uncertainty: of the distance behind Z, as far as it is known [samples]

    Raises DataError where the motion does not say which offset it is, with the reason.
    """
    if np.count_nonzero(ok) < max(_LEAST_SAMPLES, 4 * most):
        raise DataError(
            f"{np.count_nonzero(ok)} samples with a distance do not determine an offset of up to "
            f"{most} samples; record {max(_LEAST_SAMPLES, 4 * most)} or more before a fixed target"
        )
    # Beyond the flank of any minimum, so that there is an elsewhere.
    reach = max(most, _FLANK + 1)
    residual = _residuals(_level(z), np.where(ok, _level(distance, ok), 0.0), ok, reach)
    best = reach - most + int(np.argmin(residual[reach - most : reach + most + 1]))
    elsewhere = np.delete(_between(residual), np.s_[max(0, best - _FLANK) : best + _FLANK + 1])
    contrast = float(elsewhere.min() / max(residual[best], np.finfo(float).tiny))
    if contrast < _CONTRAST:
        raise DataError(
            f"the motion fits at several offsets (least residual elsewhere {contrast:.3g} times "
            f"that at {best - reach} samples, {_CONTRAST} asked for); move Z unevenly by many "
            "times the noise before a fixed target, or state counter_offset"
        )
    return _refined(z, distance, ok, best - reach, lag, lag_uncertainty)


def _level(values: FloatArray, ok: NDArray[np.bool_] | None = None) -> FloatArray:
    """Return the values (n,) without their mean."""
    return values - float(np.mean(values if ok is None else values[ok]))


def _residuals(z: FloatArray, d: FloatArray, ok: NDArray[np.bool_], most: int) -> FloatArray:
    """Return the share of the distance's variance that Z leaves, by offset -most … most."""
    weight = ok.astype(np.float64)
    size = 1 << (len(z) + most).bit_length()
    wanted = np.arange(-most, most + 1)

    # As scipy.signal.correlate does, for which a live node would have to load all of scipy.signal.
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
    """Return the least residual within a sample of each offset (n,), the vertex of a parabola."""
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
    """Fit the fraction of a sample that is left at ``samples``, and judge it."""
    index = np.flatnonzero(ok)
    index = index[(index + samples >= 1) & (index + samples < len(z) - 1)]
    here = index + samples
    speed = (z[here + 1] - z[here - 1]) / 2
    columns = np.stack([np.ones(len(here)), index - index.mean(), z[here], speed], axis=1)
    scale = np.linalg.norm(columns, axis=0)
    scale[scale == 0] = 1.0
    solved, *_ = np.linalg.lstsq(columns / scale, distance[index], rcond=None)
    residual = distance[index] - columns / scale @ solved
    gain, moved = -solved[2] / scale[2], -solved[3] / scale[3]
    if not _GAIN[0] < abs(gain) < _GAIN[1]:
        raise DataError(
            f"the distance answers to Z with {gain:.3g}, before a fixed target it is 1 "
            f"({_GAIN[0]} to {_GAIN[1]}); record a motion of Z before a fixed target, or state "
            "counter_offset"
        )
    inverse = np.linalg.pinv((columns / scale).T @ (columns / scale))
    # Neighbouring residuals are alike: so many samples count as one.
    alike = _correlation_length(residual)
    spread = math.sqrt(float(residual @ residual) / max(len(here) - 4, 1) * alike * inverse[3, 3])
    uncertainty = math.hypot(spread / scale[3] / gain, lag_uncertainty)
    # Late by ``lag``, the distance shows where Z was: the offset found is smaller by it.
    found = samples + moved / gain + lag
    whole = round(found)
    if abs(found - whole) + _SURE * uncertainty > _ROOM:
        raise DataError(
            f"the counters differ by {found:.2f} ± {uncertainty:.2f} samples, which is no whole "
            "number; move Z faster before a fixed target, state the lag, or state counter_offset"
        )
    return CounterOffset(whole, found - whole, uncertainty, float(gain))


def _correlation_length(residual: FloatArray) -> float:
    """Return samples (≥ 1) that count as one, of a first-order process with this correlation."""
    total = float(residual @ residual)
    near = float(residual[1:] @ residual[:-1]) / total if total > 0 else 0.0
    near = min(max(near, 0.0), 0.999)
    return (1 + near) / (1 - near)


# Do the counts of two devices mean one trigger? What the newest motion says of it.
#
# Stamps show a slip only beyond half a sample and what links deliver late, and a link that is late
# by a constant looks like one. A motion of Z before a fixed target tells both apart.

# What is judged: so much of the newest motion, but no more samples [s, samples].
_SPAN_S, _MOST_SAMPLES = 4.0, 16_384
# Offsets are searched as far as links may be late [s].
_SEARCH_S = 0.25
# A surface that moves with Z, but some samples later, looks like an offset of its share of them. So
# the distance must answer to Z as before a fixed target, to this part of the static gain.
_SAME_GAIN = 0.01
# Between two findings that must agree, so that one of them holds motion that the other has not [s].
_APART_S = 1.0


class LiveOffset:
    """Keeps the newest samples of both streams, and what a motion established of their counts.

    calibration: its lag is what the distance comes late by anyway
    in_use: added to the distance's count it should give the axes' count [samples]
    established: what has to be added besides; None until a motion told, and after a restart
    """

    def __init__(self, calibration: Calibration, in_use: int) -> None:
        self.in_use = in_use
        self.established: CounterOffset | None = None
        self._gain = abs(calibration.static_gain)
        self._lag = calibration.dynamics.low_frequency_delay
        self._lag_uncertainty = calibration.low_frequency_delay_uncertainty
        self._axes, self._distance = _Newest(), _Newest()
        self._found: tuple[int, int] | None = None

    def add(self, block: AxisBlock | DistanceBlock) -> None:
        """Take the next block of either stream."""
        if isinstance(block, AxisBlock):
            anew = self._axes.add(block.first_sample, block.z, block.sample_period)
        else:
            valid_distance = np.where(block.ok, block.distance, np.nan)
            anew = self._distance.add(
                block.first_sample + self.in_use, valid_distance, block.sample_period
            )
        if anew:
            self.established = self._found = None

    def judge(self) -> None:
        """Look whether the newest motion tells the offset: twice the same, then it is believed."""
        period = self._axes.period
        end = min(self._axes.end, self._distance.end)
        first = max(self._axes.first, self._distance.first, end - self._axes.most)
        if not period or end <= first:
            return
        if self._found is not None and end < self._found[0] + _APART_S / period:
            return
        z, distance = (stream.column(first, end) for stream in (self._axes, self._distance))
        known = np.flatnonzero(np.isfinite(z))
        if not len(known):
            return
        z = np.interp(np.arange(len(z)), known, z[known])
        try:
            found = counter_offset(
                z,
                distance,
                np.isfinite(distance),
                most=min(round(_SEARCH_S / period), len(z) // 8),
                lag=self._lag / period,
                lag_uncertainty=self._lag_uncertainty / period,
            )
        except DataError:
            return  # this motion does not tell
        if abs(abs(found.gain) - self._gain) > _SAME_GAIN * self._gain:
            return  # it follows a surface
        before, self._found = self._found, (end, found.samples)
        if before is not None and before[1] == found.samples:
            self.established = found


class _Newest:
    """The newest samples of one stream, by count.

    first, end: counts that are kept;  most: how many are [samples];  period: of them [s]
    """

    def __init__(self) -> None:
        self.first = self.end = self.most = 0
        self.period = 0.0
        self._parts: deque[tuple[int, FloatArray]] = deque()

    def add(self, first: int, values: FloatArray, period: float) -> bool:
        """Append a block; return whether its counter began anew."""
        anew = bool(self._parts) and first < self.end
        if anew:
            self._parts.clear()
        # Of samples further apart than the span the newest one is kept.
        self.period, self.most = period, min(max(round(_SPAN_S / period), 1), _MOST_SAMPLES)
        self._parts.append((first, values))
        self.end = first + len(values)
        while self._parts[0][0] + len(self._parts[0][1]) <= self.end - self.most:
            self._parts.popleft()
        self.first = self._parts[0][0]
        return anew

    def column(self, first: int, end: int) -> FloatArray:
        """Return the values of counts ``first`` to ``end`` (n,), NaN where there is none."""
        made = np.full(end - first, np.nan)
        for start, values in self._parts:
            low, high = max(start, first), min(start + len(values), end)
            if low < high:
                made[low - first : high - first] = values[low - start : high - start]
        return made
