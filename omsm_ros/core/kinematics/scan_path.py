"""Path of a scan, with the bandwidth and the derivatives of its Z motion."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import scipy  # whose parts are loaded when they are used
from numpy.polynomial import Legendre

from omsm_ros.core.streams.blocks import (
    SAME_PERIOD,
    AxisBlock,
    Block,
    DistanceBlock,
    FloatArray,
    known_parts,
    on_counts,
)
from omsm_ros.errors import Notice

# Number of gaps that a message names.
_MOST_NAMED = 3
# Share of the mean square velocity that defines the bandwidth; the rest may be encoder noise.
_CONTENT_SHARE = 0.999
# Length from which the end of a record is cut to a length with small prime factors, whose Fourier
# transform is ten times as fast; less than 1 % is cut.
_LONG = 65_536
# Half width of the quintics that give derivatives: a quarter period of the bandwidth, within these
# limits [samples]. The lower one keeps the encoder's noise below the path.
_LEAST_HALF_WIDTH, _MOST_HALF_WIDTH = 4, 250


@dataclass(frozen=True, eq=False, kw_only=True)
class ScanPath:
    """A path over time: z [m] (n,), and other channels (n,) or None.

    x: [m];  c: [rad];  distance: of a recorded scan [m], NaN where the probe lost the surface
    left_out: samples of the recording that are not part of the path; None if all are
    """

    z: FloatArray
    sample_period: float
    x: FloatArray | None = None
    c: FloatArray | None = None
    distance: FloatArray | None = None
    left_out: Notice | None = None


class ScanPathReader:
    """Collects the first ``most`` samples of a path from the blocks of both streams.

    The path is the longest run without a gap in the counter, a lost Z or a change of the sample
    period.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._runs: list[list[AxisBlock]] = []
        self._kept = self._passed = self._readings_kept = 0
        self._readings: list[tuple[int, FloatArray]] = []

    def add(self, block: Block) -> None:
        """Take the samples of ``block`` that are still needed."""
        if isinstance(block, AxisBlock):
            self._passed += len(block)
            if self._kept < self._most:
                for part in known_parts(block, np.isfinite(block.z)):
                    if not self._runs or _break(self._runs[-1][-1], part):
                        self._runs.append([])
                    self._runs[-1].append(part)
                    self._kept += len(part)
        elif isinstance(block, DistanceBlock) and self._readings_kept < self._most:
            readings = np.where(block.ok, block.distance, np.nan)
            self._readings.append((block.first_sample, readings))
            self._readings_kept += len(block)

    def path(self) -> ScanPath | None:
        """Return the path collected so far; None without any Z."""
        if not self._runs:
            return None
        run = max(self._runs, key=lambda run: sum(map(len, run)))
        z, x, c = (np.concatenate([getattr(b, name) for b in run])[: self._most] for name in "zxc")
        # Controls that wrap C at a turn would seem to turn hardly at all.
        known = np.isfinite(c)
        c[known] = np.unwrap(c[known])
        first = run[0].first_sample
        distance = on_counts(self._readings, first, first + len(z)) if self._readings else None
        return ScanPath(
            z=z,
            sample_period=run[0].sample_period,
            x=x,
            c=c,
            distance=distance,
            left_out=self._left_out(first, len(z)),
        )

    def _left_out(self, first: int, judged: int) -> Notice | None:
        breaks = [_break(before[-1], after[0]) for before, after in pairwise(self._runs)]
        named = [gap for gap in breaks[:_MOST_NAMED] if gap is not None]
        if judged == self._passed and not breaks:
            return None
        if len(breaks) > _MOST_NAMED:
            named.append(Notice("kinematics.more_gaps", gaps=len(breaks) - _MOST_NAMED))
        return Notice(
            "kinematics.left_out",
            judged=judged,
            samples=self._passed,
            first=first,
            last=first + judged - 1,
            gaps=Notice("kinematics.longest_run", gaps=named) if named else "",
            most=Notice("kinematics.most", most=self._most) if self._passed > self._most else "",
        )


def _break(last: AxisBlock, block: AxisBlock) -> Notice | None:
    """Return what separates two blocks; None if one continues the other."""
    end, first = last.end, block.first_sample
    if first > end:
        return Notice("kinematics.gap", samples=first - end, first=end, last=first - 1)
    if first < end:
        return Notice("kinematics.reset", last=end - 1, first=first)
    if abs(block.sample_period / last.sample_period - 1) >= SAME_PERIOD:
        return Notice("kinematics.period", first=end, period=block.sample_period)
    return None


def content_frequency(z: FloatArray, sample_period: float) -> float:
    """Return the frequency [Hz] below which 99.9 % of the mean square velocity lies.

    It is 0 at standstill. The white noise of the encoder is estimated in the upper half of the
    band and subtracted; what does not exceed its scatter is not counted. A slow change of the
    velocity from end to end would be a jump of the periodic continuation with all frequencies in
    it, so a cubic is subtracted. For whole turns, which have no such jump, a cubic would make one.
    The lower frequency of both ways is returned.
    """
    velocity = np.diff(z)
    if len(velocity) > _LONG:
        velocity = velocity[: scipy.fft.prev_fast_len(len(velocity), real=True)]
    along = np.linspace(-1.0, 1.0, len(velocity))
    slow = (
        np.asarray(Legendre.fit(along, velocity, degree)(along), np.float64)
        for degree in (0, min(3, len(velocity) - 1))
    )
    return min(_content_without(part, velocity, sample_period) for part in slow)


def _content_without(slow: FloatArray, velocity: FloatArray, sample_period: float) -> float:
    power = np.abs(np.fft.rfft(velocity - slow)) ** 2
    # Spectrum of differenced white noise.
    shape = 4 * np.sin(0.5 * np.pi * np.arange(len(power)) / (len(power) - 1)) ** 2
    upper = slice(len(power) // 2, None)
    # The power of a noise line is exponentially distributed, with a median of ln 2 of the mean.
    noise = float(np.median(power[upper] / shape[upper])) / np.log(2) * shape
    # Sums over each line and all above; the last is over none.
    moved, mean, square = (
        np.cumsum(np.append(line, 0.0)[::-1])[::-1] for line in (power - noise, noise, noise**2)
    )
    # The noise adds its scatter, and the uncertainty of its level, which is a median.
    deviation = np.sqrt(square + (mean / np.log(2)) ** 2 / (len(power) / 2))
    # `moved` has the positive frequencies only, half of Parseval's sum.
    slowly = float(np.sum((slow - np.mean(slow)) ** 2)) * len(velocity) / 2
    # A motion exceeds five standard deviations.
    least = np.maximum((1 - _CONTENT_SHARE) * (slowly + moved[0]), 5 * deviation)
    place = max(int(np.argmax(moved <= least)) - 1, 0)
    return float(place / (len(velocity) * sample_period))


def steepest(z: FloatArray, sample_period: float, content: float) -> tuple[float, float, float]:
    """Return the largest |velocity| [m/s], |acceleration| [m/s²] and |jerk| [m/s³] of ``z`` (n,).

    From local quintics (Savitzky-Golay) as wide as the bandwidth ``content`` [Hz] allows.
    """
    width = 1 / (8 * content * sample_period) if content else _MOST_HALF_WIDTH
    half = int(np.clip(width, _LEAST_HALF_WIDTH, _MOST_HALF_WIDTH))
    half = min(half, (len(z) - 1) // 2)
    index = np.arange(-half, half + 1)
    kernels = np.linalg.pinv(np.vander(index / half, 6, increasing=True))
    found = []
    for power, factorial in ((1, 1), (2, 2), (3, 6)):
        derivative = np.convolve(z - z[0], kernels[power][::-1], "valid")
        scale = factorial / (half * sample_period) ** power
        found.append(float(np.max(np.abs(derivative))) * scale)
    return found[0], found[1], found[2]
