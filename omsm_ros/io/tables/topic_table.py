"""Reads the messages of a ROS topic as rows of a table, of any type with numbers.

A column is named by its topic and the path of the field, as ``/probe.range``,
``/joint_states.position[z_slide]`` by the joint's name, ``/gap.data`` or
``/pose.pose.position.z``. ``header.stamp`` without a topic is that of each topic, ``log_time`` is
the time of recording; both are dates.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from functools import lru_cache
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import BagError, FileError
from omsm_ros.io.bag_checks import (
    bag_errors,
    check_checksums,
    check_files,
    check_index,
    check_length_of_definitions,
)
from omsm_ros.io.tables.table import PIECE_ROWS, ForeignTable
from omsm_ros.units import NANOSECONDS_PER_S

LOG_TIME = "log_time"

_STAMP = "builtin_interfaces/msg/Time"
_RANGE = "sensor_msgs/msg/Range"
_REMEDY = "give a rosbag2 folder, an .mcap or a ROS 1 .bag file that was closed"
_LOOKED_AT, _MOST_ELEMENTS, _DEEPEST = 100, 64, 6
_PART = re.compile(r"([^.\[\]]+)(?:\[([^\[\]]*)\])?")

_Get = Callable[[Any], float]


class ForeignBag:
    """Opens a bag of any topics for reading."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with bag_errors(path, _REMEDY), ExitStack() as opening:
            check_files(path)
            self.reader = AnyReader([path], default_typestore=_standard())
            if self.reader.is2:
                check_length_of_definitions(path)
            opening.enter_context(self.reader)
            if self.reader.is2:
                for part in self.reader.readers:
                    assert isinstance(part, Reader)
                    check_index(path, part)
                check_checksums(path)
            self._stack = opening.pop_all()

    def close(self) -> None:
        """Close the files."""
        self._stack.close()

    def topics(self) -> list[TopicTable]:
        """Return a table for each topic."""
        names = sorted({c.topic for c in self.reader.connections if c.msgcount})
        return [TopicTable(self, topic) for topic in names]


@lru_cache(maxsize=1)
def _standard() -> Typestore:
    """Return the types for bags without definitions: sqlite3 before ROS 2 Iron."""
    return get_typestore(Stores.ROS2_JAZZY)


class TopicTable(ForeignTable):
    """The messages of one topic, a row for each."""

    units_in_names = False  # position[A] is a joint

    def __init__(self, bag: ForeignBag, topic: str) -> None:
        super().__init__(bag.path)
        self._bag, self._topic = bag, topic
        self._connections: list[Connection] = [
            c for c in bag.reader.connections if c.topic == topic
        ]
        kinds = sorted({c.msgtype for c in self._connections})
        if len(kinds) > 1:
            raise BagError(f"{self} has messages of {kinds}; record them on topics of their own")
        self._kind = kinds[0]
        # Several nodes may publish different joints on one topic.
        seen = [_leaves(message) for _, message in islice(self._messages(), _LOOKED_AT)]
        relative = [*dict.fromkeys(chain.from_iterable(seen)), LOG_TIME]
        self.names = [*relative, *(f"{topic}.{name}" for name in relative)]

    def __str__(self) -> str:
        return f"topic {self._topic!r} of bag {str(self.path)!r}"

    @property
    def label(self) -> str:
        """Return the bag's path and the topic."""
        return f"{self.path}:{self._topic}"

    def close(self) -> None:
        """Close the bag, also for its other topics."""
        self._bag.close()

    def _messages(self) -> Iterator[tuple[int, Any]]:
        reader = self._bag.reader
        with bag_errors(self.path, _REMEDY):
            for _, stamp_ns, raw in reader.messages(self._connections):
                yield stamp_ns, reader.deserialize(raw, self._kind)

    def _pieces(
        self, names: Sequence[str], dates: frozenset[str]
    ) -> Iterator[dict[str, FloatArray]]:
        fields = [name.removeprefix(f"{self._topic}.") for name in names]
        for name, field in dict(zip(names, fields, strict=True)).items():
            is_date = field == LOG_TIME or field.endswith("stamp")
            if is_date != (name in dates):
                expected = "unit: date" if is_date else "another unit than date"
                raise FileError(f"{self}: {name!r} needs {expected} in the map")
        take = [_getter(field, self._kind) for field in fields]
        timed = [field == LOG_TIME or field.endswith("stamp") for field in fields]
        rows: list[list[float]] = []
        for number, (logged_ns, message) in enumerate(self._messages()):
            found = [self._taken(get, message, logged_ns) for get in take]
            absent = [n for n, value in zip(names, found, strict=True) if value is None]
            if absent and all(v is None or t for v, t in zip(found, timed, strict=True)):
                self.passed_over += 1  # it has none of the columns
                continue
            if absent:
                raise FileError(
                    f"{self}, message {number}: it has no {absent[0]!r}, but others of the map's "
                    "columns; publish axes that are latched together in one message"
                )
            rows.append(found)  # type: ignore[arg-type]
            if len(rows) == PIECE_ROWS:
                yield _columns(names, rows)
                rows = []
        if rows:
            yield _columns(names, rows)

    @staticmethod
    def _taken(get: _Get | None, message: Any, logged_ns: int) -> float | None:
        if get is None:
            return logged_ns / NANOSECONDS_PER_S
        try:
            return get(message)
        except (LookupError, ValueError):
            return None


def _columns(names: Sequence[str], rows: list[list[float]]) -> dict[str, FloatArray]:
    table = np.array(rows)
    return {name: np.ascontiguousarray(table[:, i]) for i, name in enumerate(names)}


def _leaves(message: Any, way: str = "", deep: int = 0) -> Iterator[str]:
    if deep > _DEEPEST:
        return
    labels = getattr(message, "name", None)
    for field in message.__dataclass_fields__:
        value = getattr(message, field)
        here = f"{way}{field}"
        if isinstance(value, np.ndarray):
            named = isinstance(labels, list) and len(labels) == len(value)
            marks: Any = labels if named else range(len(value))
            yield from (f"{here}[{mark}]" for mark in list(marks)[:_MOST_ELEMENTS])
        elif getattr(value, "__msgtype__", "") == _STAMP:
            yield here
        elif hasattr(value, "__dataclass_fields__"):
            yield from _leaves(value, f"{here}.", deep + 1)
        elif isinstance(value, (int, float)) and not isinstance(value, bool):
            yield here


def _getter(field: str, kind: str) -> _Get | None:
    """Return the getter of ``field`` of a message of type ``kind``; None = time of recording."""
    if field == LOG_TIME:
        return None
    parts = [(name, mark) for name, mark in _PART.findall(field)]

    def get(message: Any) -> float:
        for name, mark in parts:
            holder, message = message, getattr(message, name)
            if mark:
                labels = getattr(holder, "name", ())
                message = message[labels.index(mark) if mark in labels else int(mark)]
        if hasattr(message, "nanosec"):
            return float(message.sec) + float(message.nanosec) / NANOSECONDS_PER_S
        return float(message)

    return _within_range if (kind, field) == (_RANGE, "range") else get


def _within_range(message: Any) -> float:
    """Return the distance of a Range.msg, NaN below range_min or above range_max."""
    value = float(message.range)
    stated = message.max_range > message.min_range
    outside = stated and not message.min_range <= value <= message.max_range
    return float("nan") if outside else value
