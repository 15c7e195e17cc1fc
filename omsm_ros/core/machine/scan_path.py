"""Which path does a scan take, what is the highest content of its motion, how steep is it?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from omsm_ros.core.samples.blocks import SAME_PERIOD, AxisBlock, Block, DistanceBlock, FloatArray

# What the samples hold above it is the encoder's noise rather than the path.
_CONTENT_SHARE = 0.999
# Derivatives are those of quintics over a quarter period of the fastest content, but of at least
# so many samples, so that the encoder's noise stays below the path.
_LEAST_HALF_WIDTH, _MOST_HALF_WIDTH = 4, 250


@dataclass(frozen=True, eq=False, kw_only=True)
class ScanPath:
    """A path over time: z [m] (n,), and what else is known of it, each (n,) or None.

    x: [m];  c: [rad];  distance: of a recorded scan [m], NaN where the probe lost the surface
    """

    z: FloatArray
    sample_period: float
    x: FloatArray | None = None
    c: FloatArray | None = None
    distance: FloatArray | None = None


class PathStart:
    """The first samples of a path, gathered from the blocks of a stream while they pass.

    Across a gap in the counter, or to another sample period, no motion is known: the path is the
    longest run without either.
    """

    def __init__(self, most: int) -> None:
        """``most`` samples of either stream are kept."""
        self._most = most
        self._runs: list[list[AxisBlock]] = []
        self._kept = self._readings_kept = 0
        self._readings: list[tuple[int, FloatArray]] = []

    def add(self, block: Block) -> None:
        """Take what is still wanted of ``block``."""
        if isinstance(block, AxisBlock) and self._kept < self._most:
            if not self._runs or not _continues(self._runs[-1][-1], block):
                self._runs.append([])
            self._runs[-1].append(block)
            self._kept += len(block)
        elif isinstance(block, DistanceBlock) and self._readings_kept < self._most:
            readings = np.where(block.ok, block.distance, np.nan)
            self._readings.append((block.first_sample, readings))
            self._readings_kept += len(block)

    def path(self) -> ScanPath | None:
        """Return the path gathered so far; None if there were no axes."""
        if not self._runs:
            return None
        run = max(self._runs, key=lambda run: sum(map(len, run)))
        z, x, c = (np.concatenate([getattr(b, name) for b in run])[: self._most] for name in "zxc")
        first, end = run[0].first_sample, run[-1].end
        within = [readings for at, readings in self._readings if first <= at < end]
        distance = np.concatenate(within)[: self._most] if within else None
        return ScanPath(z=z, sample_period=run[0].sample_period, x=x, c=c, distance=distance)


def _continues(last: AxisBlock, block: AxisBlock) -> bool:
    same_period = abs(block.sample_period / last.sample_period - 1) < SAME_PERIOD
    return same_period and block.first_sample == last.end


def content_frequency(z: FloatArray, sample_period: float) -> float:
    """Return the frequency [Hz] below which 99.9 % of the mean square velocity lies; 0 at rest.

    The encoder's white noise, as large as it is in the upper half of the band, is taken off.
    """
    velocity = np.diff(z)
    power = np.abs(np.fft.rfft(velocity - np.mean(velocity))) ** 2
    # White noise of z, differenced.
    shape = 4 * np.sin(0.5 * np.pi * np.arange(len(power)) / (len(power) - 1)) ** 2
    upper = slice(len(power) // 2, None)
    # The power of a line of noise is exponentially distributed: its median is ln 2 of its mean.
    noise = float(np.median(power[upper] / shape[upper])) / np.log(2) * shape
    moved = power - noise
    # Beyond five standard deviations of the noise's sum, something moves.
    if np.sum(moved) <= 5 * float(np.linalg.norm(noise)):
        return 0.0
    gathered = np.cumsum(moved)
    place = int(np.argmax(gathered >= _CONTENT_SHARE * gathered[-1]))
    return float(place / (len(velocity) * sample_period))


def steepest(z: FloatArray, sample_period: float, content: float) -> tuple[float, float, float]:
    """Return the largest |velocity| [m/s], |acceleration| [m/s²] and |jerk| [m/s³] of ``z`` (n,).

    By local quintics (Savitzky and Golay) as wide as ``content`` [Hz] allows.
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
