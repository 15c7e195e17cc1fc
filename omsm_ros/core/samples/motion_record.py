"""One recording of an axis and of what the probe saw, on one regular grid.

Blocks of one trigger are paired by its counter. Streams of different rates, or with a
known offset between their clocks, are paired by their stamps on a grid that has every
sample of the probe on it and is at least as fine as the axis's own sampling.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import interpolate

from omsm_ros.core.samples.blocks import AxisBlock, BoolArray, DistanceBlock, FloatArray, IntArray
from omsm_ros.errors import DataError
from omsm_ros.units import NANOSECONDS_PER_S

# Five hours at 1 kHz; a larger span of the counter is two recordings or a forged block.
MAX_RECORD_SAMPLES = 20_000_000
_SAME_PERIOD = 1e-9


@dataclass(frozen=True, eq=False, kw_only=True)
class MotionRecord:
    """Samples of one regular grid, each array of shape (n,).

    sample_period: of the grid [s]
    z: encoder [m], finite everywhere; interpolated where it was lost, and not ``ok`` there
    distance: probe [m], NaN where it has no reading
    ok: True where both are measured and to be trusted
    reference: second sensor along the same motion [m], NaN where it has no reading, or None
    z_lost: True where z is interpolated, or None where it never is
    counts: what became of every sample received

    Raises DataError when the arrays do not fit each other.
    """

    sample_period: float
    z: FloatArray
    distance: FloatArray
    ok: BoolArray
    reference: FloatArray | None = None
    z_lost: BoolArray | None = None
    counts: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        arrays = [self.z, self.distance, self.ok]
        if self.reference is not None:
            arrays.append(self.reference)
        lengths = sorted({len(a) for a in arrays})
        if len(lengths) != 1:
            raise DataError(f"record: channels of different lengths {lengths!r}")
        if not (np.isfinite(self.sample_period) and self.sample_period > 0):
            raise DataError(
                f"record: sample_period {self.sample_period!r} s, expected a positive number"
            )

    def __len__(self) -> int:
        return len(self.z)

    @classmethod
    def from_arrays(
        cls,
        sample_period: float,
        z: FloatArray,
        distance: FloatArray,
        ok: BoolArray | None = None,
        reference: FloatArray | None = None,
    ) -> MotionRecord:
        """A record of plain arrays (n,); NaN in any channel marks a lost sample."""
        z = np.asarray(z, np.float64)
        distance = np.asarray(distance, np.float64)
        known = np.isfinite(z)
        usable = known & np.isfinite(distance)
        if ok is not None:
            usable &= ok
        return cls(
            sample_period=sample_period,
            z=_filled(z, known),
            distance=distance,
            ok=usable,
            reference=None if reference is None else np.asarray(reference, np.float64),
            z_lost=None if np.all(known) else ~known,
            counts={
                "received": len(z),
                "missing_axis": int(np.sum(~known)),
                "not_ok": int(np.sum(known & ~usable)),
                "paired": int(np.sum(usable)),
            },
        )


def assemble(
    axes: Sequence[AxisBlock],
    distance: Sequence[DistanceBlock],
    reference: Sequence[DistanceBlock] = (),
    *,
    clock_offset: float = 0.0,
) -> MotionRecord:
    """Pair the blocks of one recording, in any order, with gaps, repeats and dropouts.

    clock_offset: [s] to add to the probe's stamps to have the axis's clock; an unknown
        offset cannot be told from a delay of the probe and is identified as one.

    Raises DataError when nothing can be paired.
    """
    if not axes or not distance:
        raise DataError(
            f"{len(axes)} axis blocks and {len(distance)} distance blocks: "
            "both are needed; check that both topics were recorded"
        )
    period = _one_period("axis", axes)
    probe_period = _one_period("distance", distance)
    if clock_offset == 0.0 and abs(probe_period / period - 1) < _SAME_PERIOD:
        return _by_counter(axes, distance, reference, period)
    return _by_stamp(axes, distance, reference, clock_offset)


def _one_period(name: str, blocks: Sequence[AxisBlock] | Sequence[DistanceBlock]) -> float:
    periods = sorted({float(block.sample_period) for block in blocks})
    if periods[-1] > periods[0] * (1 + _SAME_PERIOD):
        raise DataError(
            f"{name} blocks of different sample periods {periods!r} s; identify them apart"
        )
    return periods[0]


@dataclass(frozen=True, eq=False)
class _Stream:
    """A channel by trigger counter: sorted, unique."""

    counter: IntArray
    value: FloatArray
    ok: BoolArray
    duplicates: int


def _stream(parts: Iterable[tuple[int, FloatArray, BoolArray]]) -> _Stream:
    counters, values, oks = [], [], []
    for first, value, ok in parts:
        counters.append(first + np.arange(len(value), dtype=np.int64))
        values.append(np.asarray(value, np.float64))
        oks.append(ok)
    every = np.concatenate(counters)
    unique, index = np.unique(every, return_index=True)
    return _Stream(
        unique,
        np.concatenate(values)[index],
        np.concatenate(oks)[index],
        len(every) - len(unique),
    )


def _axis_stream(blocks: Sequence[AxisBlock]) -> _Stream:
    return _stream((b.first_sample, b.z, np.isfinite(b.z)) for b in blocks)


def _distance_stream(blocks: Sequence[DistanceBlock]) -> _Stream:
    return _stream((b.first_sample, b.distance, b.ok) for b in blocks)


def _check_span(samples: int) -> None:
    if samples > MAX_RECORD_SAMPLES:
        raise DataError(
            f"the recording spans {samples!r} samples, more than {MAX_RECORD_SAMPLES}: "
            "two recordings in one, or a counter that was reset"
        )


def _by_counter(
    axes: Sequence[AxisBlock],
    distance: Sequence[DistanceBlock],
    reference: Sequence[DistanceBlock],
    period: float,
) -> MotionRecord:
    axis, probe = _axis_stream(axes), _distance_stream(distance)
    first = int(axis.counter[0])
    samples = int(axis.counter[-1]) - first + 1
    _check_span(samples)
    z, z_known = _on_grid(axis, first, samples)
    seen, seen_ok = _on_grid(probe, first, samples)
    present = np.isin(probe.counter, axis.counter, assume_unique=True)
    if not np.any(present):
        raise DataError(
            f"axis samples {first}…{axis.counter[-1]} and distance samples "
            f"{probe.counter[0]}…{probe.counter[-1]} share no trigger count: "
            "they are not of one recording"
        )
    return MotionRecord(
        sample_period=period,
        z=_filled(z, z_known),
        distance=seen,
        ok=z_known & seen_ok,
        reference=_on_grid(_distance_stream(reference), first, samples)[0] if reference else None,
        z_lost=None if np.all(z_known) else ~z_known,
        counts=_counts(axis, probe, int(np.sum(present)), int(np.sum(z_known & seen_ok)))
        | {"missing_axis": samples - len(axis.counter)},
    )


def _counts(axis: _Stream, probe: _Stream, paired: int, used: int) -> dict[str, int]:
    return {
        "received": len(probe.counter) + probe.duplicates,
        "duplicates": probe.duplicates,
        "axis_duplicates": axis.duplicates,
        "missing_axis": 0,
        "unmatched": len(probe.counter) - paired,
        "not_ok": paired - used,
        "paired": used,
    }


def _on_grid(stream: _Stream, first: int, samples: int) -> tuple[FloatArray, BoolArray]:
    value, ok = np.full(samples, np.nan), np.zeros(samples, np.bool_)
    place = stream.counter - first
    inside = (place >= 0) & (place < samples)
    value[place[inside]] = np.where(stream.ok, stream.value, np.nan)[inside]
    ok[place[inside]] = stream.ok[inside]
    return value, ok


def _filled(z: FloatArray, known: BoolArray) -> FloatArray:
    if np.all(known) or not np.any(known):
        return np.where(known, z, 0.0)
    index = np.arange(len(z))
    return np.asarray(np.interp(index, index[known], z[known]))


def _times(blocks: Sequence[AxisBlock] | Sequence[DistanceBlock], stream: _Stream) -> FloatArray:
    """Seconds of each sample on the clock of the stamps: one line through all the blocks.

    A stamp jitters with the computer that took it; the counter does not.
    """
    first = min(block.first_sample for block in blocks)
    period = blocks[0].sample_period
    offsets = [
        block.stamp_ns / NANOSECONDS_PER_S - (block.first_sample - first) * period
        for block in blocks
    ]
    return np.asarray(np.median(offsets) + (stream.counter - first) * period)


def _by_stamp(
    axes: Sequence[AxisBlock],
    distance: Sequence[DistanceBlock],
    reference: Sequence[DistanceBlock],
    clock_offset: float,
) -> MotionRecord:
    axis, probe = _axis_stream(axes), _distance_stream(distance)
    axis_period, probe_period = axes[0].sample_period, distance[0].sample_period
    axis_time = _times(axes, axis)[axis.ok]
    probe_time = _times(distance, probe) + clock_offset
    finer = max(int(np.ceil(probe_period / axis_period - _SAME_PERIOD)), 1)
    period = probe_period / finer
    inside = (probe_time >= axis_time[0]) & (probe_time <= axis_time[-1]) if len(axis_time) else []
    if not np.any(inside) or len(axis_time) < 4:
        raise DataError(
            f"{len(axis_time)} axis samples share no time with the distance stamps, clock offset "
            f"{clock_offset!r} s: they are not of one recording"
        )
    place = (probe.counter - probe.counter[inside][0]) * finer
    samples = int(place[inside][-1]) + 1
    _check_span(samples)
    grid = probe_time[inside][0] + np.arange(samples) * period
    nearest = np.minimum(np.searchsorted(axis_time, grid), len(axis_time) - 1)
    covered = axis_time[nearest] - axis_time[np.maximum(nearest - 1, 0)] < 1.5 * axis_period
    seen, seen_ok = np.full(samples, np.nan), np.zeros(samples, np.bool_)
    seen[place[inside]] = np.where(probe.ok, probe.value, np.nan)[inside]
    seen_ok[place[inside]] = probe.ok[inside]
    second = None
    if reference:
        other = _distance_stream(reference)
        second = np.interp(
            grid, (_times(reference, other) + clock_offset)[other.ok], other.value[other.ok]
        )
    return MotionRecord(
        sample_period=period,
        z=np.asarray(interpolate.CubicSpline(axis_time, axis.value[axis.ok])(grid)),
        distance=seen,
        ok=seen_ok & covered,
        z_lost=None if np.all(covered) else ~covered,
        reference=second,
        counts=_counts(axis, probe, int(np.sum(inside)), int(np.sum(seen_ok & covered))),
    )
