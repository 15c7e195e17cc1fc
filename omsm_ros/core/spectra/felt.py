"""What an accelerometer feels: lines of acceleration, and the height that each may move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from omsm_ros.core.samples.blocks import SAME_PERIOD, AccelerationBlock, FloatArray
from omsm_ros.core.samples.merging import uninterrupted
from omsm_ros.core.spectra.lines import find_lines
from omsm_ros.core.spectra.scan_signal import ScanSignal
from omsm_ros.errors import DataError

AXES = ("x", "y", "z")
# As few frequencies as a floor of noise can be found among.
_LEAST_SAMPLES = 256


@dataclass(frozen=True, slots=True, kw_only=True)
class FeltLine:
    """A line of acceleration.

    axis: x, y or z;  frequency: [Hz], its standard uncertainty
    acceleration: amplitude [m/s²];  significance: [σ]
    """

    axis: str
    frequency: float
    frequency_uncertainty: float
    acceleration: float
    significance: float

    @property
    def displacement(self) -> float:
        """Amplitude of the motion that such an acceleration is [m]: ``a / ω²``."""
        return self.acceleration / (2 * np.pi * self.frequency) ** 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Felt:
    """All lines of an accelerometer, and how far it reaches.

    highest: half its rate [Hz]: a line from beyond would be felt at its folded image
    duration: of the record [s]
    """

    lines: tuple[FeltLine, ...]
    highest: float
    duration: float


def accelerations_of(blocks: Sequence[AccelerationBlock]) -> tuple[float, dict[str, FloatArray]]:
    """Return the period [s] and the longest gapless run (n,) of each axis [m/s²].

    Raises DataError for blocks of several periods, or too few samples.
    """
    periods = {block.sample_period for block in blocks}
    if not periods or max(periods) - min(periods) > SAME_PERIOD * max(periods):
        raise DataError(
            f"acceleration with sample periods {sorted(periods)!r} s, expected one; record again"
        )
    run = max(uninterrupted(blocks), key=lambda run: sum(map(len, run)))
    axes = {axis: np.concatenate([getattr(b, axis) for b in run]) for axis in AXES}
    if len(axes["z"]) < _LEAST_SAMPLES:
        raise DataError(
            f"acceleration of {len(axes['z'])} samples on end, expected {_LEAST_SAMPLES} or more; "
            "record longer"
        )
    return min(periods), axes


def felt(period: float, axes: dict[str, FloatArray]) -> Felt:
    """Return the lines of accelerations (n,) by axis, every ``period`` [s], NaN where lost.

    Of lines of one frequency on several axes the strongest is kept.
    """
    found: list[FeltLine] = []
    for axis, values in axes.items():
        found += _lines(period, axis, values)
    found.sort(key=lambda line: -line.acceleration)
    kept: list[FeltLine] = []
    duration = period * max(map(len, axes.values()))
    for line in found:
        if all(abs(line.frequency - other.frequency) > 1.0 / duration for other in kept):
            kept.append(line)
    return Felt(lines=tuple(kept), highest=0.5 / period, duration=duration)


def _lines(period: float, axis: str, values: FloatArray) -> list[FeltLine]:
    known = np.flatnonzero(np.isfinite(values))
    if len(known) < _LEAST_SAMPLES or not np.ptp(values[known]):
        return []
    still = np.zeros(len(known))
    signal = ScanSignal(
        name=axis, period=period, sample=known - known[0], height=values[known],
        path=still, radius=still, turn=still,
    )  # fmt: skip
    return [
        FeltLine(
            axis=axis,
            frequency=line.frequency,
            frequency_uncertainty=line.frequency_uncertainty,
            acceleration=line.amplitude,
            significance=line.significance,
        )
        for line in find_lines(signal, signal.height - np.mean(signal.height)).lines
    ]
