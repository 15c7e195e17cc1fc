"""Reads bags of the contract's topics without ROS: rosbag2 folders and ``.mcap`` files.

Drivers send a hundred samples in a message, and decoding one message takes longer than correcting
its samples. Messages of one size have the same layout (plain CDR, little endian, OMG DDSI-RTPS
2.3, 10), and many of them are read as one table: a row for each message, a column for each field.
Consecutive rows make one block.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from struct import error as struct_error
from struct import unpack_from
from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader

from omsm_ros.core.streams.blocks import AxisBlock, DistanceBlock, FloatArray
from omsm_ros.errors import BagError, CalibrationError, DataError
from omsm_ros.io import message_mapping
from omsm_ros.io.bag_checks import (
    DAMAGED,
    bag_errors,
    check_checksums,
    check_definition,
    check_files,
    check_index,
    check_kind,
    unpacked_message,
)
from omsm_ros.io.message_mapping import CHANNELS, typestore, vibration_levels
from omsm_ros.io.topics import (
    ACCELERATION_TOPIC,
    AXES_TOPIC,
    CALIBRATION_TOPIC,
    DISTANCE_TOPIC,
    POINTS_TOPIC,
    PROBE_TOPIC,
    REFERENCE_TOPIC,
    TEMPERATURE_TOPIC,
    TOPIC_TYPES,
    VIBRATION_TOPIC,
    AnyBag,
    CellBag,
    relative,
)
from omsm_ros.quantities import shown
from omsm_ros.units import NANOSECONDS_PER_S

_LITTLE_ENDIAN = b"\x00\x01"
_ENCAPSULATION_BYTES = 4  # before the first field; alignment is relative to their end
_MOST_PADDING = 3  # a writer may fill the last word


class _Layout:
    """Notes name, type and place of the fields of one message."""

    def __init__(self, message: bytes) -> None:
        self._message = message
        self._place = _ENCAPSULATION_BYTES
        self.lengths: list[str] = ["encapsulation"]
        self.fields: dict[str, tuple[Any, int]] = {"encapsulation": ("S2", 0)}

    def add(self, name: str, kind: Any, shape: tuple[int, ...] = ()) -> None:
        dtype = np.dtype(kind).newbyteorder("<")
        self._place += -(self._place - _ENCAPSULATION_BYTES) % dtype.itemsize
        self.fields[name] = ((dtype, shape), self._place)
        self._place += dtype.itemsize * (shape[0] if shape else 1)

    def sequence(self, name: str, kind: Any) -> None:
        length = f"length of {name}"
        self.add(length, np.uint32)
        self.lengths.append(length)
        (count,) = unpack_from("<I", self._message, self._place - 4)
        if count:
            self.add(name, kind, (count,))

    def dtype(self) -> np.dtype[np.void]:
        size = len(self._message)
        if not 0 <= size - self._place <= _MOST_PADDING:
            raise struct_error(f"fields end at {self._place}, the message at {size}")
        formats, offsets = zip(*self.fields.values(), strict=True)
        names = list(self.fields)
        return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": size})


def long_blocks(kind: type, messages: Sequence[bytes]) -> Iterator[Any] | None:
    """Yield blocks of ``kind`` with all samples of serialised ``messages`` of one size.

    None if the messages have different layouts, so that each must be decoded by itself. Raises
    DataError as the block's class does.
    """
    layout = _Layout(messages[0])
    try:
        layout.add("sec", np.int32)
        layout.add("nanosec", np.uint32)
        layout.sequence("frame", np.uint8)
        layout.add("first_sample", np.uint64)
        layout.add("sample_period", np.float64)
        for name, channel in CHANNELS[kind].items():
            layout.sequence(name, channel)
        table = np.frombuffer(b"".join(messages), layout.dtype())
    except struct_error:
        return None
    alike = all((table[name] == table[name][0]).all() for name in layout.lengths)
    # Intensity and status may be empty; the sequences before them may not.
    needed = [name for name, channel in CHANNELS[kind].items() if channel is np.float64]
    alike &= messages[0][:2] == _LITTLE_ENDIAN and all(name in layout.fields for name in needed)
    return _runs(kind, table) if alike else None


def _runs(kind: type, table: NDArray[np.void]) -> Iterator[Any]:
    """Yield a block for each run of rows with consecutive counts and times and one period."""
    first, period = table["first_sample"], table["sample_period"]
    stamp = table["sec"].astype(np.int64) * NANOSECONDS_PER_S + table["nanosec"]
    present = [(name, c) for name, c in CHANNELS[kind].items() if name in (table.dtype.names or ())]
    samples = np.uint64(table[present[0][0]].shape[1])
    follows = (first[1:] == first[:-1] + samples) & (period[1:] == period[:-1])
    follows &= stamp[1:] >= stamp[:-1]
    edges = np.flatnonzero(~follows) + 1
    parts = np.stack([first.astype(np.int64), stamp], axis=1)
    for start, stop in zip([0, *edges], [*edges, len(table)], strict=True):
        rows = table[start:stop]
        yield kind(
            stamp_ns=int(stamp[start]),
            first_sample=int(first[start]),
            sample_period=float(period[start]),
            parts=parts[start:stop],
            **{name: np.array(rows[name], channel).ravel() for name, channel in present},
        )


_BLOCKS = {AXES_TOPIC: AxisBlock, DISTANCE_TOPIC: DistanceBlock, REFERENCE_TOPIC: DistanceBlock}
_TO_RECORD: dict[str, Callable[[Any], Any]] = {
    **dict.fromkeys((*_BLOCKS, ACCELERATION_TOPIC), message_mapping.block_of),
    CALIBRATION_TOPIC: message_mapping.calibration,
    POINTS_TOPIC: message_mapping.cloud_array,
    PROBE_TOPIC: message_mapping.probe_settings,
    VIBRATION_TOPIC: vibration_levels,
    TEMPERATURE_TOPIC: message_mapping.temperature,
}

# Other programs also use messages of other types, with any content.
_OURS = "omsm_msgs/"

BLOCK_TOPICS = frozenset(_BLOCKS)
"""Topics that :meth:`BagReader.blocks` joins."""

# Messages joined at once: a block costs some 300 µs besides its samples. Processor time of
# 5 million points: 3.3 s at 1 MB, 2.7 s at 8 MB, 2.7 s at 16 MB.
_JOINED_BYTES = 8_000_000
# Built once, since building it takes longer than the test, for each of a million messages.
_BYTES = bytes | memoryview
# The year 2000: earlier stamps count from the start of a computer or of the twin.
_CLOCK_SET_NS = 946_684_800 * 10**9

Item: TypeAlias = "tuple[str, Any]"
_Opened = TypeVar("_Opened", bound="BagReader")


@dataclass(frozen=True, slots=True)
class TopicSummary:
    """The messages of one topic in a bag.

    topic: its name there;  role: the name in the contract, empty if it is another topic
    """

    topic: str
    type: str
    messages: int
    role: str = ""


def check_message(topic: str, kind: str, raw: bytes) -> None:
    """Raise an exception for a message of a cell that no reader accepts."""
    for role, expected in TOPIC_TYPES.items():
        ours = kind.startswith(_OURS) or relative(topic) == relative(role)
        if kind == expected and ours:
            _TO_RECORD[role](typestore().deserialize_cdr(raw, kind))
            return


class BagReader:
    """Opens a bag for reading; a context manager.

    Topics are named as in the contract, whatever their names in the bag.
    Raises BagError if the path is missing, no bag, or cut short.
    """

    def __init__(self, bag: AnyBag) -> None:
        self._cell = bag if isinstance(bag, CellBag) else CellBag(Path(bag))
        self.path = self._cell.path

    def __enter__(self: _Opened) -> _Opened:
        whole = (
            "expected a rosbag2 folder or an .mcap file; if its recording was cut short, save what "
            "is whole with 'omsm inspect --repair'"
        )
        with bag_errors(self.path, whole), ExitStack() as opening:
            if not self.path.exists():
                raise BagError(f"no bag at {str(self.path)!r}; check the path")
            check_files(self.path)
            if self.path.is_file():
                check_kind(self.path)
            self._reader = opening.enter_context(Reader(self.path))
            check_index(self.path, self._reader)
            check_checksums(self.path)
            held = {c.topic: c.msgtype for c in self._reader.connections}
            self._names = self._cell.names(held)
            self._stack = opening.pop_all()
        self._compressed = self._reader.compression_mode == "message"
        if self._compressed:
            # Unpacked here up to a bound, which rosbags does not have.
            metadata = self._reader.storage.metadata
            self._reader.storage.metadata = metadata._replace(compression_mode=None)
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def topics(self) -> list[TopicSummary]:
        """Return the topics of the bag by name; the channels of a topic are joined."""
        counts: Counter[tuple[str, str]] = Counter()
        for connection in self._reader.connections:
            counts[connection.topic, connection.msgtype] += connection.msgcount
        roles = {name: topic for topic, name in self._names.items()}
        return [
            TopicSummary(name, kind, count, roles.get(name, ""))
            for (name, kind), count in sorted(counts.items())
        ]

    def name_of(self, topic: str) -> str:
        """Return the name in this bag of ``topic`` of the contract."""
        return self._names[topic]

    @property
    def indexed(self) -> bool:
        """Return whether the recording was completed; if not, an MCAP file has no index."""
        parts = getattr(self._reader.storage, "storages", [self._reader.storage])
        scanned = [p for p in parts if hasattr(p, "chunks") and not p.chunks]
        return not any(part.metadata.message_count for part in scanned)

    @property
    def start_ns(self) -> int:
        """Return the time of the first message [ns, ROS time]."""
        return int(self._reader.start_time)

    @property
    def recorded_ns(self) -> int | None:
        """Return the begin of the recording [ns, ROS time], None if its clock was never set."""
        return self.start_ns if self.start_ns >= _CLOCK_SET_NS else None

    def count(self, topics: Sequence[str]) -> int:
        """Return the number of messages on ``topics``."""
        return sum(t.messages for t in self.topics() if t.role in topics)

    def messages(
        self, topics: Sequence[str], start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[tuple[str, int, bytes]]:
        """Yield ``(topic, time of recording, serialised message)`` in the order of time [ns].

        start_ns, stop_ns: the first instant, and the end, which is excluded

        Raises BagError if one of ``topics`` is absent or of another type, or if the number of
        messages is not that of the index.
        """
        connections = [c for topic in topics for c in self._connections(topic)]
        roles = {self._names[topic]: topic for topic in topics}
        promised = sum(connection.msgcount for connection in connections)
        with bag_errors(self.path, DAMAGED):
            if connections:
                for connection, stamp, raw in self._reader.messages(connections, start_ns, stop_ns):
                    promised -= 1
                    if not isinstance(raw, _BYTES):  # SQLite keeps any type in any column
                        raise BagError(
                            f"bag {str(self.path)!r}: a message is {shown(raw)}, not bytes: "
                            f"{DAMAGED}"
                        )
                    unpacked: Any = unpacked_message(bytes(raw)) if self._compressed else raw
                    yield roles[connection.topic], stamp, unpacked
        if promised and start_ns is None and stop_ns is None:
            more_or_less = "fewer" if promised > 0 else "more"
            raise BagError(
                f"bag {str(self.path)!r} holds {abs(promised)} messages {more_or_less} than its "
                f"index says: {DAMAGED}"
            )

    def records(self, *topics: str) -> Iterator[Item]:
        """Yield ``(topic, record)`` in the order of recording.

        Raises BagError as :meth:`messages` does, or if a message is malformed.
        """
        for topic, _, raw in self.messages(topics):
            yield topic, self._record(topic, raw)

    def probe_settings(self) -> list[dict[str, object]]:
        """Return each state of the settings that the probe's driver reported."""
        found: list[dict[str, object]] = []
        for reported in self._values(PROBE_TOPIC):
            if reported not in found:
                found.append(reported)
        return found

    def vibration(self) -> list[dict[str, Any]]:
        """Return the levels that the vibration monitor reported, in their order."""
        return self._values(VIBRATION_TOPIC)

    def temperatures(self) -> FloatArray:
        """Return the readings of the temperature (n,) [°C], in their order; NaN = invalid."""
        return np.array(self._values(TEMPERATURE_TOPIC), np.float64)

    def _values(self, topic: str) -> list[Any]:
        """Return the records of a topic that need not be there."""
        return [record for _, record in self.records(topic)] if self.count([topic]) else []

    def blocks(self, *topics: str) -> Iterator[tuple[int, str, Any]]:
        """Yield ``(messages read, topic, block)`` of block topics, short blocks joined.

        The blocks of a topic keep their order. Raises BagError as :meth:`records` does.
        """
        waiting: defaultdict[str, list[bytes]] = defaultdict(list)
        size = read = 0
        for topic, _, raw in self.messages(topics):
            waiting[topic].append(raw)
            size += len(raw)
            read += 1
            if size >= _JOINED_BYTES:
                yield from ((read, *item) for item in self._joined(waiting))
                waiting.clear()
                size = 0
        yield from ((read, *item) for item in self._joined(waiting))

    def _joined(self, waiting: Mapping[str, list[bytes]]) -> Iterator[tuple[str, Any]]:
        for topic, messages in waiting.items():
            for _, alike in groupby(messages, len):
                batch = list(alike)
                with self._malformed_named():
                    blocks = long_blocks(_BLOCKS[topic], batch)
                    if blocks is not None:
                        yield from ((topic, block) for block in blocks)
                        continue
                yield from ((topic, self._record(topic, raw)) for raw in batch)

    def _record(self, topic: str, raw: bytes) -> Any:
        with bag_errors(self.path, DAMAGED):
            message = typestore().deserialize_cdr(raw, TOPIC_TYPES[topic])
        with self._malformed_named():
            return _TO_RECORD[topic](message)

    @contextmanager
    def _malformed_named(self) -> Iterator[None]:
        try:
            yield
        except (DataError, CalibrationError) as err:
            raise BagError(
                f"bag {str(self.path)!r} holds a malformed message: {err}; leave it out with "
                "'omsm inspect --repair'"
            ) from err

    def _connections(self, topic: str) -> list[Connection]:
        name = self._names[topic]
        found = [c for c in self._reader.connections if c.topic == name]
        if not found:
            held = ", ".join(t.topic for t in self.topics()) or "nothing"
            raise BagError(
                f"{str(self.path)!r} has no topic {name!r}; it holds {held:.500}. "
                "Record the raw topics of the cell, name them with --namespace or --topics, or "
                "make a bag of other messages with 'omsm import'"
            )
        for connection in found:
            if connection.msgtype != TOPIC_TYPES[topic]:
                raise BagError(
                    f"{name!r} in {str(self.path)!r} is of type {connection.msgtype!r}, expected "
                    f"{TOPIC_TYPES[topic]!r}; record the topics of the cell"
                )
            with bag_errors(self.path, DAMAGED):
                check_definition(self.path, connection, typestore())
        return found
