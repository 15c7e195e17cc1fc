"""Which path does a scan take, what is the highest content of its motion, how steep is it?"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from omsm_ros.core.streams.blocks import SAME_PERIOD, AxisBlock, Block, DistanceBlock, FloatArray
from omsm_ros.readable import count

_MOST_NAMED = 3
# What the samples hold above it is the encoder's noise rather than the path.
_CONTENT_SHARE = 0.999
# The Fourier transform of a length with a large prime factor takes ten times as long. Of so many
# samples, the few at the end that make up such a factor are less than half a per cent.
_LONG = 65_536
_SMALL_FACTORS = (2, 3, 5, 7, 11, 13)
# Derivatives are those of quintics over a quarter period of the fastest content, but of at least
# so many samples, so that the encoder's noise stays below the path.
_LEAST_HALF_WIDTH, _MOST_HALF_WIDTH = 4, 250


@dataclass(frozen=True, eq=False, kw_only=True)
class ScanPath:
    """A path over time: z [m] (n,), and what else is known of it, each (n,) or None.

    x: [m];  c: [rad];  distance: of a recorded scan [m], NaN where the probe lost the surface
    left_out: which samples of the recording are none of the path, and why; empty if all are
    """

    z: FloatArray
    sample_period: float
    x: FloatArray | None = None
    c: FloatArray | None = None
    distance: FloatArray | None = None
    left_out: str = ""


class ScanPathReader:
    """The first samples of a path, gathered from the blocks of a stream while they pass.

    Across a gap in the counter, or where Z was lost, or to another sample period, no motion is
    known: the path is the longest run without any of them.
    """

    def __init__(self, most: int) -> None:
        """``most`` samples of either stream are kept."""
        self._most = most
        self._runs: list[list[AxisBlock]] = []
        self._kept = self._passed = self._readings_kept = 0
        self._readings: list[tuple[int, FloatArray]] = []

    def add(self, block: Block) -> None:
        """Take what is still wanted of ``block``."""
        if isinstance(block, AxisBlock):
            self._passed += len(block)
            if self._kept < self._most:
                for part in _known(block):
                    self._keep(part)
        elif isinstance(block, DistanceBlock) and self._readings_kept < self._most:
            readings = np.where(block.ok, block.distance, np.nan)
            self._readings.append((block.first_sample, readings))
            self._readings_kept += len(block)

    def _keep(self, block: AxisBlock) -> None:
        if not self._runs or _break(self._runs[-1][-1], block):
            self._runs.append([])
        self._runs[-1].append(block)
        self._kept += len(block)

    def path(self) -> ScanPath | None:
        """Return the path gathered so far; None if Z was never known."""
        if not self._runs:
            return None
        run = max(self._runs, key=lambda run: sum(map(len, run)))
        z, x, c = (np.concatenate([getattr(b, name) for b in run])[: self._most] for name in "zxc")
        first, end = run[0].first_sample, run[-1].first_sample + len(run[-1])
        within = [
            readings[max(first - at, 0) : max(end - at, 0)] for at, readings in self._readings
        ]
        distance = np.concatenate(within)[: self._most] if within else None
        return ScanPath(
            z=z,
            sample_period=run[0].sample_period,
            x=x,
            c=c,
            distance=distance,
            left_out=self._left_out(first, len(z)),
        )

    def _left_out(self, first: int, judged: int) -> str:
        breaks = [_break(before[-1], after[0]) for before, after in pairwise(self._runs)]
        if judged == self._passed and not breaks:
            return ""
        text = (
            f"judged are only {count(judged)} of {count(self._passed)} samples, triggers {first} "
            f"to {first + judged - 1}"
        )
        if breaks:
            text += f", the longest run without a gap: {_named(breaks)}"
        if self._passed > self._most:
            text += f"; no more than the first {count(self._most)} are looked at"
        return text


def _named(breaks: Sequence[str]) -> str:
    rest = len(breaks) - _MOST_NAMED
    return ", ".join(breaks[:_MOST_NAMED]) + (f" and {rest} more gaps" if rest > 0 else "")


def _known(block: AxisBlock) -> Iterator[AxisBlock]:
    """Yield the runs of a block in which Z is known."""
    known = np.isfinite(block.z)
    if np.all(known):
        yield block
        return
    edges = np.flatnonzero(np.diff(known, prepend=False, append=False))
    for begin, end in edges.reshape(-1, 2).tolist():
        channels = {name: getattr(block, name)[begin:end] for name in "xyzbc"}
        yield replace(block, first_sample=block.first_sample + begin, **channels)


def _break(last: AxisBlock, block: AxisBlock) -> str:
    """Return in words what parts two blocks; empty if one continues the other."""
    end = last.first_sample + len(last)
    missing = block.first_sample - end
    if missing > 0:
        return f"{count(missing)} are missing ({end} to {block.first_sample - 1})"
    if missing < 0:
        return f"after {end - 1} the counter goes on from {block.first_sample}"
    if abs(block.sample_period / last.sample_period - 1) >= SAME_PERIOD:
        return f"from {end} on the sample period is {block.sample_period:.6g} s"
    return ""


def content_frequency(z: FloatArray, sample_period: float) -> float:
    """Return the frequency [Hz] below which 99.9 % of the mean square velocity lies; 0 at rest.

    The encoder's white noise, as large as it is in the upper half of the band, is taken off. What
    changes the velocity slowly from end to end, as the feed over a round part does, is no more
    than that: a Fourier series would see a jump where the ends meet, and all frequencies in it. A
    few whole turns have no such jump, but get one where a cubic is taken off; so the lower counts.
    """
    velocity = np.diff(z)
    if len(velocity) > _LONG:
        velocity = velocity[: _with_small_factors(len(velocity))]
    steady = np.full(len(velocity), np.mean(velocity))
    return min(
        _content_frequency_around(slow, velocity, sample_period)
        for slow in (steady, _slow_part(velocity))
    )


def _content_frequency_around(
    slow: FloatArray, velocity: FloatArray, sample_period: float
) -> float:
    power = np.abs(np.fft.rfft(velocity - slow)) ** 2
    # White noise of z, differenced.
    shape = 4 * np.sin(0.5 * np.pi * np.arange(len(power)) / (len(power) - 1)) ** 2
    upper = slice(len(power) // 2, None)
    # The power of a line of noise is exponentially distributed: its median is ln 2 of its mean.
    noise = float(np.median(power[upper] / shape[upper])) / np.log(2) * shape
    moved = power - noise
    # Beyond five standard deviations of the noise's sum, something moves.
    if np.sum(moved) <= 5 * float(np.linalg.norm(noise)):
        return 0.0
    # Of Parseval's sum, `moved` holds the half of positive frequencies.
    slowly = float(np.sum((slow - np.mean(slow)) ** 2)) * len(velocity) / 2
    gathered = slowly + np.cumsum(moved)
    place = int(np.argmax(gathered >= _CONTENT_SHARE * gathered[-1]))
    return float(place / (len(velocity) * sample_period))


def _with_small_factors(number: int) -> int:
    """Return the largest number up to ``number`` with ``_SMALL_FACTORS`` alone."""
    for found in range(number, 1, -1):
        rest = found
        for factor in _SMALL_FACTORS:
            while rest % factor == 0:
                rest //= factor
        if rest == 1:
            return found
    return 1


def _slow_part(velocity: FloatArray) -> FloatArray:
    """Return the cubic that is nearest to ``velocity`` (n,), of any unit."""
    along = np.linspace(-1.0, 1.0, len(velocity))
    part = np.zeros(len(velocity))
    for degree in range(min(4, len(velocity))):
        basis = np.asarray(np.polynomial.legendre.Legendre.basis(degree)(along), np.float64)
        # Nearly orthogonal already; from what is left each time, so that it is so to the last bit.
        part += basis * (basis @ (velocity - part) / (basis @ basis))
    return part


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
