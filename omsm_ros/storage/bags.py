"""Bags: recordings of the contract's topics, read without ROS.

Reads rosbag2 folders (sqlite3 and MCAP) and bare ``.mcap`` files.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from types import TracebackType
from typing import Any, TypeAlias

import numpy as np
from rosbags.interfaces import Connection

from omsm_ros.core.samples.blocks import AccelerationBlock, AxisBlock, DistanceBlock, FloatArray
from omsm_ros.errors import BagError, CalibrationError, DataError
from omsm_ros.quantities import shown
from omsm_ros.storage import conversions
from omsm_ros.storage.bag_checks import (
    DAMAGED,
    check_checksums,
    check_definition,
    check_files,
    check_index,
    check_kind,
    translated,
    unpacked_message,
)
from omsm_ros.storage.block_table import long_blocks
from omsm_ros.storage.message_types import typestore
from omsm_ros.storage.recording.chunk_reader import MessageReader
from omsm_ros.storage.recording.topics import (
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
from omsm_ros.storage.vibration_levels import vibration_levels

_TO_RECORD: dict[str, Callable[[Any], Any]] = {
    AXES_TOPIC: conversions.axis_block,
    DISTANCE_TOPIC: conversions.distance_block,
    REFERENCE_TOPIC: conversions.distance_block,
    ACCELERATION_TOPIC: conversions.acceleration_block,
    CALIBRATION_TOPIC: conversions.calibration,
    POINTS_TOPIC: conversions.cloud_array,
    PROBE_TOPIC: conversions.probe_settings,
    VIBRATION_TOPIC: vibration_levels,
    TEMPERATURE_TOPIC: conversions.temperature,
}

# Messages of other types are also those of other programs, who put into them what they like.
_OURS = "omsm_msgs/"

_BLOCKS: dict[str, type] = {
    AXES_TOPIC: AxisBlock,
    DISTANCE_TOPIC: DistanceBlock,
    REFERENCE_TOPIC: DistanceBlock,
}

BLOCK_TOPICS = frozenset(_BLOCKS)
"""Topics that :meth:`BagReader.blocks` joins."""

# Of messages that are joined: a block costs some 300 µs besides its samples, a fifth of the whole
# at 1 MB; beyond 8 MB only memory grows (processor time of 5 million points: 3.3 s at 1 MB, 2.7 s
# at 8 MB, 2.7 s at 16 MB).
_JOINED_BYTES = 8_000_000
# Made once: for each of a million messages it would take longer than the test itself.
_BYTES = bytes | memoryview
# The year 2000, before any ROS: earlier stamps count from the start of a computer or of the twin.
_CLOCK_SET_NS = 946_684_800 * 10**9

Item: TypeAlias = "tuple[str, AxisBlock | DistanceBlock | AccelerationBlock | Any]"


@dataclass(frozen=True, slots=True)
class TopicSummary:
    """What a bag holds on one topic.

    topic: its name there;  role: the topic of the contract that it is, empty if none
    """

    topic: str
    type: str
    messages: int
    role: str = ""


def check_message(topic: str, kind: str, raw: bytes) -> None:
    """Raise an exception for a message of a cell that no reader would take."""
    for role, expected in TOPIC_TYPES.items():
        ours = kind.startswith(_OURS) or relative(topic) == relative(role)
        if kind == expected and ours:
            _TO_RECORD[role](typestore().deserialize_cdr(raw, kind))
            return


class BagReader:
    """A bag opened for reading; use it as a context manager.

    Topics are asked for by their names of the contract, whatever the bag calls them.
    Raises BagError if the path is missing, no bag, or cut short.
    """

    def __init__(self, bag: AnyBag) -> None:
        self._cell = bag if isinstance(bag, CellBag) else CellBag(Path(bag))
        self.path = self._cell.path

    def __enter__(self) -> BagReader:
        whole = (
            "expected a rosbag2 folder or an .mcap file; if its recording was cut short, save what "
            "is whole with 'omsm inspect --repair'"
        )
        with translated(self.path, whole), ExitStack() as opening:
            if not self.path.exists():
                raise BagError(f"no bag at {str(self.path)!r}; check the path")
            check_files(self.path)
            if self.path.is_file():
                check_kind(self.path)
            self._reader = opening.enter_context(MessageReader(self.path))
            check_index(self.path, self._reader)
            check_checksums(self.path)
            held = {c.topic: c.msgtype for c in self._reader.connections}
            self._names = self._cell.names(held)
            self._stack = opening.pop_all()
        self._compressed = self._reader.compression_mode == "message"
        if self._compressed:
            # Unpacked here, to a bound; rosbags would unpack whatever comes.
            metadata = self._reader.storage.metadata
            self._reader.storage.metadata = metadata._replace(compression_mode=None)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stack.close()

    def topics(self) -> list[TopicSummary]:
        """Return what is in the bag, by topic name; the channels of a topic count as one."""
        counts: Counter[tuple[str, str]] = Counter()
        for connection in self._reader.connections:
            counts[connection.topic, connection.msgtype] += connection.msgcount
        roles = {name: topic for topic, name in self._names.items()}
        return [
            TopicSummary(name, kind, count, roles.get(name, ""))
            for (name, kind), count in sorted(counts.items())
        ]

    def name_of(self, topic: str) -> str:
        """Return what ``topic`` of the contract is called in this bag, or would be."""
        return self._names[topic]

    @property
    def indexed(self) -> bool:
        """Whether the recording was completed; an MCAP file that was not has no index."""
        parts = getattr(self._reader.storage, "storages", [self._reader.storage])
        scanned = [p for p in parts if hasattr(p, "chunks") and not p.chunks]
        return not any(part.metadata.message_count for part in scanned)

    @property
    def start_ns(self) -> int:
        """When the first message was recorded [ns, ROS time]."""
        return int(self._reader.start_time)

    @property
    def recorded_ns(self) -> int | None:
        """When the recording began [ns, ROS time], None where its clock was never set."""
        return self.start_ns if self.start_ns >= _CLOCK_SET_NS else None

    def count(self, topics: Sequence[str]) -> int:
        """Return the number of messages on ``topics``."""
        return sum(t.messages for t in self.topics() if t.role in topics)

    def messages(
        self, topics: Sequence[str], start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[tuple[str, int, bytes]]:
        """Yield ``(topic, when it was recorded, serialised message)`` in that order [ns].

        start_ns, stop_ns: the first instant, and the first that is left out
        """
        connections = [c for topic in topics for c in self._connections(topic)]
        roles = self._roles(topics)
        for connection, stamp, raw in self._raw(connections, start_ns, stop_ns):
            yield roles[connection.topic], stamp, raw

    def records(self, *topics: str) -> Iterator[Item]:
        """Yield ``(topic, record)`` in the order of recording.

        Raises BagError if one of ``topics`` is absent, of another type, or malformed.
        """
        connections = [c for topic in topics for c in self._connections(topic)]
        roles = self._roles(topics)
        for connection, _, raw in self._raw(connections):
            topic = roles[connection.topic]
            yield topic, self._record(topic, raw)

    def probe_settings(self) -> list[dict[str, object]]:
        """Return each state that the probe's driver reported; none where nobody recorded it."""
        if not self.count([PROBE_TOPIC]):
            return []
        found: list[dict[str, object]] = []
        for _, reported in self.records(PROBE_TOPIC):
            if reported not in found:
                found.append(reported)
        return found

    def vibration(self) -> list[dict[str, Any]]:
        """Return each state of the levels that the vibration monitor reported, in their order."""
        if not self.count([VIBRATION_TOPIC]):
            return []
        return [told for _, told in self.records(VIBRATION_TOPIC)]

    def temperatures(self) -> FloatArray:
        """Return the readings of the temperature (n,) [°C], in their order; NaN: cannot be."""
        if not self.count([TEMPERATURE_TOPIC]):
            return np.empty(0)
        return np.array([value for _, value in self.records(TEMPERATURE_TOPIC)])

    def blocks(self, *topics: str) -> Iterator[tuple[int, str, Any]]:
        """Yield ``(messages read, topic, block)`` of block topics, short blocks joined.

        The blocks of a topic keep their order. Raises BagError as :meth:`records` does.
        """
        connections = [c for topic in topics for c in self._connections(topic)]
        waiting: defaultdict[str, list[bytes]] = defaultdict(list)
        size = read = 0
        roles = self._roles(topics)
        for connection, _, raw in self._raw(connections):
            waiting[roles[connection.topic]].append(raw)
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
        with translated(self.path, DAMAGED):
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

    def _raw(
        self,
        connections: Sequence[Connection],
        start_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield the serialised messages; all of them must be as many as the bag promises."""
        promised = sum(connection.msgcount for connection in connections)
        with translated(self.path, DAMAGED):
            if connections:
                for connection, stamp, raw in self._reader.messages(connections, start_ns, stop_ns):
                    promised -= 1
                    if not isinstance(raw, _BYTES):  # SQLite keeps any in any column
                        raise BagError(
                            f"bag {str(self.path)!r}: a message is {shown(raw)}, no bytes: "
                            f"{DAMAGED}"
                        )
                    yield connection, stamp, unpacked_message(raw) if self._compressed else raw
        if promised and start_ns is None and stop_ns is None:
            more_or_less = "fewer" if promised > 0 else "more"
            raise BagError(
                f"bag {str(self.path)!r} holds {abs(promised)} messages {more_or_less} than its "
                f"index says: {DAMAGED}"
            )

    def _roles(self, topics: Sequence[str]) -> dict[str, str]:
        return {self._names[topic]: topic for topic in topics}

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
            with translated(self.path, DAMAGED):
                check_definition(self.path, connection, typestore())
        return found
