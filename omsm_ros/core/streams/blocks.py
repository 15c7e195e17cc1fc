"""Blocks of samples, which mirror the messages, and the account of every sample.

A *block* is a run of consecutive samples of one trigger counter. All quantities are SI; arrays
are float64 of shape (n,) unless stated otherwise.

For each stream ``received == corrected + pending + sum(counted.values())`` at any time. Samples
that never came are ``missing`` and not part of this sum.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from enum import IntEnum
from types import MappingProxyType
from typing import TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from omsm_ros.errors import DataError
from omsm_ros.quantities import (
    ACCELERATION,
    ANGLE,
    COUNTER,
    DISTANCE,
    POSITION,
    SAMPLE_PERIOD,
    STAMP,
    Quantity,
)
from omsm_ros.units import NANOSECONDS_PER_S

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]
BoolArray: TypeAlias = NDArray[np.bool_]

# No device delivers more samples in one message; a longer block is damaged or forged.
MAX_BLOCK_SAMPLES = 4_000_000

# The median of fewer steps may be the jump of a wrapped angle.
_LEAST_STEPS = 5

SAME_PERIOD = 1e-6
"""Relative difference of two stated sample periods that are equal, from six written digits."""

# Channels with their plausible ranges; a value outside counts as lost.
_AXES = {"x": POSITION, "y": POSITION, "z": POSITION, "b": ANGLE, "c": ANGLE}
_DISTANCE = {"distance": DISTANCE}
_ACCELERATION = dict.fromkeys("xyz", ACCELERATION)


class Status(IntEnum):
    """Verdict of the probe on one sample (values of ``DistanceBlock.status``)."""

    OK = 0
    NO_TARGET = 1
    SATURATED = 2
    OUT_OF_RANGE = 3
    LOST = 4


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Block:
    """Base of all blocks: time and trigger counts of its samples.

    stamp_ns: time of the first sample [ns, ROS time]
    first_sample: trigger count of the first sample
    sample_period: [s]
    parts: first sample and stamp [ns] of each joined message, (k, 2); (0, 2) for one message
    """

    stamp_ns: int
    first_sample: int
    sample_period: float
    parts: IntArray = field(default_factory=lambda: np.empty((0, 2), np.int64))

    def __len__(self) -> int:
        raise NotImplementedError

    @property
    def end(self) -> int:
        """Trigger count after the last sample."""
        return self.first_sample + len(self)

    @property
    def stamps(self) -> IntArray:
        """First sample and stamp [ns] of each message, (k, 2)."""
        return self.parts if len(self.parts) else np.array([(self.first_sample, self.stamp_ns)])

    @property
    def newest(self) -> tuple[int, int]:
        """First sample and stamp [ns] of the last message."""
        if not len(self.parts):
            return self.first_sample, self.stamp_ns
        return int(self.parts[-1, 0]), int(self.parts[-1, 1])

    def _check(
        self, name: str, lengths: set[int], channels: Mapping[str, Quantity] = MappingProxyType({})
    ) -> None:
        if len(lengths) != 1:
            raise DataError("streams.block_lengths", block=name, lengths=sorted(lengths))
        (length,) = lengths
        if not 0 < length <= MAX_BLOCK_SAMPLES:
            raise DataError(
                "streams.block_samples", block=name, samples=length, most=MAX_BLOCK_SAMPLES
            )
        SAMPLE_PERIOD.checked(self.sample_period, DataError, f"{name}: sample_period")
        COUNTER.checked(self.first_sample, DataError, f"{name}: first_sample")
        STAMP.checked(self.stamp_ns, DataError, f"{name}: stamp")
        for channel, quantity in channels.items():
            object.__setattr__(self, channel, quantity.nan_if_implausible(getattr(self, channel)))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class AxisBlock(Block):
    """Axis positions x, y, z [m] and b, c [rad], each (n,), NaN where lost."""

    x: FloatArray
    y: FloatArray
    z: FloatArray
    b: FloatArray
    c: FloatArray

    def __post_init__(self) -> None:
        lengths = {len(a) for a in (self.x, self.y, self.z, self.b, self.c)}
        self._check("AxisBlock", lengths, _AXES)

    def __len__(self) -> int:
        return len(self.z)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class DistanceBlock(Block):
    """Probe readings: distance [m] (n,), intensity 0-1 (n,) or (0,), status (n,) or (0,).

    The distance is NaN where the status is not OK. An empty status means that every sample is OK,
    an empty intensity that the device does not report it.
    """

    distance: FloatArray
    intensity: NDArray[np.float32] = field(default_factory=lambda: np.empty(0, np.float32))
    status: NDArray[np.uint8] = field(default_factory=lambda: np.empty(0, np.uint8))

    def __post_init__(self) -> None:
        optional = {len(a) for a in (self.intensity, self.status) if len(a)}
        self._check("DistanceBlock", {len(self.distance)} | optional, _DISTANCE)
        if len(self.status) and np.any(self.status != Status.OK):
            # The sender may have left a number in a reading that is not OK.
            readings = np.where(self.status == Status.OK, self.distance, np.nan)
            object.__setattr__(self, "distance", readings)

    def __len__(self) -> int:
        return len(self.distance)

    @property
    def ok(self) -> BoolArray:
        """True where the probe gave a valid, finite reading, shape (n,)."""
        finite = np.isfinite(self.distance)
        return finite & (self.status == Status.OK) if len(self.status) else finite


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class AccelerationBlock(Block):
    """Acceleration x, y, z [m/s²], each (n,), NaN where lost."""

    x: FloatArray
    y: FloatArray
    z: FloatArray

    def __post_init__(self) -> None:
        self._check("AccelerationBlock", {len(a) for a in (self.x, self.y, self.z)}, _ACCELERATION)

    def __len__(self) -> int:
        return len(self.z)


class AngleUnwrapper:
    """Unwraps an angle [rad] block by block, so that it can be delayed and interpolated.

    A jump is a step that differs by a whole turn from the median of the steps around it. A
    spindle may turn by more than half a turn from sample to sample.
    """

    def __init__(self) -> None:
        self._last = np.empty(0)
        self._steps = np.empty(0)

    def of(self, angle: FloatArray) -> FloatArray:
        """Return the next angles (n,), finite, unwrapped; the same array if none jumps."""
        before = np.concatenate([self._last, angle])
        steps = np.diff(before)
        known = np.concatenate([self._steps, steps])
        if len(known) >= _LEAST_STEPS:
            turns = np.round((steps - np.median(known)) / (2 * np.pi))
            if np.any(turns):
                steps = steps - 2 * np.pi * turns
                before[1:] -= 2 * np.pi * np.cumsum(turns)
                angle = before[len(self._last) :]
        self._last = before[-1:]
        self._steps = np.concatenate([self._steps, steps])[-_LEAST_STEPS:]
        return angle


class RejectionReason(IntEnum):
    """Reason why a sample gave no surface point; 0 means that it did.

    INVALID: either sample of the pair is not finite or not a valid reading
    UNMATCHED: the other stream has no sample of this trigger count
    DUPLICATE: a sample of this trigger count came before
    LATE: came after later samples
    SETTLING: within the settling time of the filter
    OVERDUE: one sample of the pair waited for the other longer than allowed
    BEYOND: outside the range of the calibration set
    SLIPPED: the counters of the two streams count different triggers
    JUMPED: its count was far ahead of its time, and no block after it confirmed that
    """

    NONE = 0
    INVALID = 1
    UNMATCHED = 2
    DUPLICATE = 3
    LATE = 4
    SETTLING = 5
    OVERDUE = 6
    BEYOND = 7
    SLIPPED = 8
    JUMPED = 9


@dataclass(frozen=True)
class StreamAccount:
    """Number of samples of one stream: received, corrected, waiting, and counted by reason.

    missing: trigger counts that never came, between the first and the last of each session
    """

    received: int = 0
    corrected: int = 0
    pending: int = 0
    counted: Mapping[str, int] = field(default_factory=dict)
    missing: int = 0

    def __add__(self, other: "StreamAccount") -> "StreamAccount":
        names = ("received", "corrected", "pending", "missing")
        sums = {name: getattr(self, name) + getattr(other, name) for name in names}
        counted = Counter(self.counted) + Counter(other.counted)
        return StreamAccount(**sums, counted=dict(counted))


@dataclass(frozen=True)
class Account:
    """Accounts of both streams of a corrector."""

    axes: StreamAccount = StreamAccount()
    distance: StreamAccount = StreamAccount()

    def as_dict(self) -> dict[str, dict[str, object]]:
        """Return JSON values: stream -> received, corrected, pending, counted {reason: samples}."""
        return asdict(self)

    def __add__(self, other: "Account") -> "Account":
        return Account(self.axes + other.axes, self.distance + other.distance)


class Tally:
    """Running account of one stream."""

    def __init__(self) -> None:
        self.received = 0
        self.missing = 0
        self.corrected = 0
        self._counted: Counter[RejectionReason] = Counter()

    def count(self, reason: RejectionReason, samples: int) -> None:
        """Count ``samples`` under ``reason``; NONE means corrected."""
        if reason is RejectionReason.NONE:
            self.corrected += samples
        else:
            self._counted[reason] += samples

    def count_each(self, reasons: NDArray[np.uint8]) -> None:
        """Count one sample under each of ``reasons`` (n,)."""
        for value, samples in enumerate(np.bincount(reasons)):
            self.count(RejectionReason(value), int(samples))

    def snapshot(self, pending: int) -> StreamAccount:
        """Return the present account, with ``pending`` samples waiting."""
        counted = {reason.name.lower(): n for reason, n in sorted(self._counted.items()) if n}
        return StreamAccount(self.received, self.corrected, pending, counted, self.missing)


B = TypeVar("B", AxisBlock, DistanceBlock)
AnyBlock = TypeVar("AnyBlock", bound=Block)

MOST_TOGETHER = 1000
"""Most samples of a joined block; DDS keeps room for the longest message in each queue."""

# Joining moves the stamps of a block onto the line from the first one; this is the most [s].
_STAMP_TOLERANCE_S = 1e-3
_NOT_CHANNELS = ("stamp_ns", "first_sample", "sample_period", "parts")


def uninterrupted(blocks: Sequence[AnyBlock]) -> list[list[AnyBlock]]:
    """Return the blocks in runs without a gap in the count."""
    runs: list[list[AnyBlock]] = []
    for block in blocks:
        if runs and block.first_sample == runs[-1][-1].end:
            runs[-1].append(block)
        else:
            runs.append([block])
    return runs


def on_counts(parts: Iterable[tuple[int, FloatArray]], first: int, end: int) -> FloatArray:
    """Return the values at the counts ``first`` to ``end`` (n,), NaN where there is none.

    parts: first count and values of each; a later one replaces what came before
    """
    made = np.full(end - first, np.nan)
    for start, values in parts:
        low, high = max(start, first), min(start + len(values), end)
        if low < high:
            made[low - first : high - first] = values[low - start : high - start]
    return made


def consecutive(blocks: Sequence[B]) -> list[list[B]]:
    """Return the blocks in their order, grouped so that :func:`joined` can join each group.

    Blocks of a group have consecutive counts, one period, the same channels, and stamps that
    follow from the first one, and at most MOST_TOGETHER samples if they are several.
    """
    runs: list[list[B]] = []
    length = 0
    for block in blocks:
        fits = length + len(block) <= MOST_TOGETHER
        if runs and fits and _continues(runs[-1][0], length, block):
            runs[-1].append(block)
            length += len(block)
        else:
            runs.append([block])
            length = len(block)
    return runs


def _continues(first: B, length: int, block: B) -> bool:
    period = first.sample_period
    if block.first_sample != first.first_sample + length or block.sample_period != period:
        return False
    off_ns = block.stamp_ns - first.stamp_ns - length * period * NANOSECONDS_PER_S
    close = abs(off_ns) <= _STAMP_TOLERANCE_S * NANOSECONDS_PER_S
    return close and _channels(first) == _channels(block)


def _channels(block: Block) -> list[str]:
    """Return the channels that the block has: the device may not report an intensity."""
    names = (f.name for f in fields(block) if f.name not in _NOT_CHANNELS)
    return [name for name in names if len(getattr(block, name))]


def part_of(block: AnyBlock, begin: int, end: int) -> AnyBlock:
    """Return samples ``begin`` to ``end`` of a block, stamped as they follow from its first."""
    return replace(
        block,
        first_sample=block.first_sample + begin,
        stamp_ns=block.stamp_ns + round(begin * block.sample_period * NANOSECONDS_PER_S),
        **{name: getattr(block, name)[begin:end] for name in _channels(block)},
    )


def known_parts(block: AnyBlock, known: BoolArray) -> Iterator[AnyBlock]:
    """Yield the parts of ``block`` between samples that are not ``known``, (n,)."""
    edges = np.flatnonzero(np.diff(known, prepend=False, append=False))
    for begin, end in edges.reshape(-1, 2).tolist():
        yield part_of(block, begin, end)


def joined(run: Sequence[B]) -> B:
    """Return one block of the samples of consecutive blocks, with the stamp of the first."""
    if len(run) == 1:
        return run[0]
    names = _channels(run[0])
    return replace(run[0], **{n: np.concatenate([getattr(b, n) for b in run]) for n in names})


def without_first_message(block: B, messages: int) -> B:
    """Return a joined block without its first ``messages`` messages."""
    if not messages:
        return block
    first, stamp_ns = block.parts[messages].tolist()
    rest = part_of(block, first - block.first_sample, len(block))
    return replace(rest, stamp_ns=stamp_ns, parts=block.parts[messages:])
