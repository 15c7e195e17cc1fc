"""Runs of samples → blocks, stamped on the host's clock."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from omsm_ros.core.samples.blocks import (
    MAX_BLOCK_SAMPLES,
    AxisBlock,
    DistanceBlock,
    FloatArray,
    IntArray,
)
from omsm_ros.devices.clock import DeviceClock
from omsm_ros.devices.counting import SAMPLE, Run, Samples
from omsm_ros.devices.turns import Turns
from omsm_ros.errors import ConfigurationError
from omsm_ros.protocols.generic_stream import AXES, AxisScaling
from omsm_ros.units import NANOSECOND_S, NANOSECONDS_PER_S, PPM

# More than crystals differ by: beyond it the nominal period is wrong.
PERIOD_TOLERANCE = 100 * PPM
# A device that runs freely at another rate than this is set to another rate.
RATE_TOLERANCE = 1000 * PPM
# So is one that tells no time, if its samples arrive at another rate than this.
ARRIVAL_TOLERANCE = 5000 * PPM


class BlockPair(NamedTuple):
    """What one run of a device's samples becomes; None where it has no such channels."""

    axes: AxisBlock | None
    distance: DistanceBlock | None


@dataclass(frozen=True, slots=True, kw_only=True)
class BlockSettings:
    """sample_period: nominal [s];  block_size: samples;  pause: a partial block is handed over
    when nothing came for so long [s];  renew: a connection that is silent for so long is made
    anew, which costs a sample or two if it was well [s]; 0 = never;  free_running: the device
    keeps the period itself, so a block at another rate is withheld.
    """

    sample_period: float = 1e-3
    block_size: int = 100
    pause: float = 0.2
    renew: float = 0.0
    free_running: bool = False

    def __post_init__(self) -> None:
        for name in ("sample_period", "pause"):
            value = getattr(self, name)
            if not 0 < value < np.inf:
                raise ConfigurationError(f"{name} {value!r} s, expected a positive number")
        if not 0 < self.block_size <= MAX_BLOCK_SAMPLES:
            raise ConfigurationError(
                f"block_size {self.block_size!r}, expected 1 to {MAX_BLOCK_SAMPLES}"
            )


class Channels(NamedTuple):
    """What a device measures. distance: a probe;  axes: how its encoders count, in the order of
    AXES, or None;  timed: its samples carry its own time.
    """

    distance: bool = True
    axes: tuple[AxisScaling, ...] | None = None
    timed: bool = True


def wrapping(axes: tuple[AxisScaling, ...] | None, counts: int) -> tuple[AxisScaling, ...] | None:
    """Return the axes; their encoders wrap after ``counts`` where nothing else is said."""
    if axes is None:
        return None
    return tuple(replace(axis, wrap=axis.wrap or counts) for axis in axes)


class BlockCutter:
    """Runs → pairs of blocks of ``block_size`` samples; a gap or a restart closes one early.

    delivered, withheld: samples in blocks handed over, and kept back for their wrong rate
    period_deviation: from nominal, relative: of the last full block's device time, or of the
    arrivals of a device that reports no time
    period_warnings: full blocks beyond PERIOD_TOLERANCE
    """

    def __init__(self, settings: BlockSettings, channels: Channels) -> None:
        self._settings = settings
        self._channels = channels
        self._clock = DeviceClock()
        self._pending: Samples = np.empty(0, SAMPLE)
        self._first = self._stamp = 0
        self._turns = [Turns(axis.wrap) for axis in channels.axes or ()]
        self.delivered = self.withheld = self.blocks = self.period_warnings = 0
        self.period_deviation = 0.0

    @property
    def pending(self) -> int:
        """Samples that wait for their block to fill."""
        return len(self._pending)

    @property
    def wrong_rate(self) -> bool:
        """Whether the device runs freely, but not at the rate it was set to."""
        limit = RATE_TOLERANCE if self._channels.timed else ARRIVAL_TOLERANCE
        return self._settings.free_running and abs(self.period_deviation) > limit

    def add(
        self, runs: Sequence[Run], arrival_ns: int, *, after_silence: bool = False
    ) -> Iterator[BlockPair]:
        """Yield the blocks completed by ``runs``, which arrived together at ``arrival_ns``."""
        for i, run in enumerate(runs):
            if run.restarted or run.first_sample != self._first + self.pending:
                yield from self.flush()
                self._first = run.first_sample
            if i == 0 or run.restarted:
                self._set_clock(runs[i:], arrival_ns, after_silence and i == 0)
            yield from self._append(run)

    def _set_clock(self, runs: Sequence[Run], arrival_ns: int, after_silence: bool) -> None:
        """Tell the clock of the last sample that arrived before the device started anew."""
        continuous = self._channels.timed or self._settings.free_running
        if runs[0].restarted or (after_silence and not continuous):
            self._clock.restart()
        anew = (i for i, run in enumerate(runs) if i and run.restarted)
        last = runs[next(anew, len(runs)) - 1]
        self._clock.observe(int(self._times(last)[-1]), arrival_ns)

    def _append(self, run: Run) -> Iterator[BlockPair]:
        samples = run.samples.copy()
        samples["time"] = self._times(run)
        if not self.pending:
            self._stamp = self._clock.to_host(int(samples["time"][0]))
        self._pending = np.concatenate([self._pending, samples])
        while self.pending >= self._settings.block_size:
            yield from self._take(self._settings.block_size)

    def flush(self) -> Iterator[BlockPair]:
        """Yield the partial block, if any."""
        if self.pending:
            yield from self._take(self.pending)

    def _times(self, run: Run) -> IntArray:
        """Return the device time [ns] of each sample: its own, or its count times the period."""
        times: IntArray = run.samples["time"]
        if not self._channels.timed:
            counts = run.first_sample + np.arange(len(run.samples))
            period_ns = self._settings.sample_period * NANOSECONDS_PER_S
            times = np.rint(counts * period_ns).astype(np.int64)
        return times

    def _take(self, count: int) -> Iterator[BlockPair]:
        samples, self._pending = self._pending[:count], self._pending[count:]
        first, self._first = self._first, self._first + count
        stamp = self._stamp
        if self.pending:
            self._stamp = self._clock.to_host(int(self._pending["time"][0]))
        self._check_period(samples)
        if self.wrong_rate:
            self.withheld += count
            return
        self.delivered += count
        self.blocks += 1
        yield self._blocks(samples, first, stamp)

    def _check_period(self, samples: Samples) -> None:
        if not self._channels.timed:
            self.period_deviation = self._clock.drift or 0.0
            return
        periods = len(samples) - 1
        if periods < max(1, self._settings.block_size - 1):
            return  # too short to tell a wrong period from jitter
        nominal = periods * self._settings.sample_period
        elapsed = (int(samples["time"][-1]) - int(samples["time"][0])) * NANOSECOND_S
        self.period_deviation = elapsed / nominal - 1
        self.period_warnings += abs(self.period_deviation) > PERIOD_TOLERANCE

    def _blocks(self, samples: Samples, first: int, stamp: int) -> BlockPair:
        common = {
            "stamp_ns": stamp,
            "first_sample": first,
            "sample_period": self._settings.sample_period,
        }
        axes = distance = None
        if self._channels.axes is not None:
            axes = AxisBlock(**common, **self._positions(samples, self._channels.axes))  # type: ignore[arg-type]
        if self._channels.distance:
            reported = not np.isnan(samples["intensity"]).all()
            distance = DistanceBlock(
                **common,  # type: ignore[arg-type]
                distance=samples["distance"],
                status=samples["status"],
                intensity=samples["intensity"] if reported else np.empty(0, np.float32),
            )
        return BlockPair(axes, distance)

    def _positions(
        self, samples: Samples, scaling: tuple[AxisScaling, ...]
    ) -> dict[str, FloatArray]:
        turned = [
            turns.continued(counts)
            for turns, counts in zip(self._turns, samples["counts"].T[: len(scaling)], strict=True)
        ]
        return {
            name: axis.values(column)
            for name, axis, column in zip(AXES, scaling, turned, strict=True)
        }
