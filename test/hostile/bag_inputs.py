"""Hostile bags: right bytes with wrong numbers, and wrong bytes."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
from hostile.inputs import NUMBERS, damaged
from hypothesis import strategies as st
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from omsm_ros.io import bags, message_mapping

TOPICS = (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)
_COUNTERS = st.one_of(
    st.sampled_from([0, 1, 2**31, 2**32 - 50, 2**53, 2**62, 2**63, 2**64 - 1]),
    st.integers(0, 2**64 - 1),
    st.integers(0, 3000),
)
_SECONDS = st.one_of(
    st.sampled_from([-(2**31), -1, 0, 2**31 - 1]), st.integers(-(2**31), 2**31 - 1)
)
_NANOSECONDS = st.integers(0, 2**32 - 1)
_FLOATS = NUMBERS.map(lambda number: float(min(max(number, -(2**200)), 2**200)) if isinstance(
    number, int) else number)  # fmt: skip
_LENGTHS = st.sampled_from([0, 1, 99, 101])


def messages_of(blocks: list[tuple[Any, Any]]) -> list[tuple[str, Any]]:
    """Messages of pairs of blocks, by topic."""
    classes = message_mapping.bag_messages()
    return [
        item
        for axes, distance in blocks
        for item in (
            (bags.AXES_TOPIC, message_mapping.block_message(classes, axes)),
            (bags.DISTANCE_TOPIC, message_mapping.block_message(classes, distance)),
        )
    ]


@st.composite
def hostile_messages(draw: st.DrawFn, blocks: list[tuple[Any, Any]]) -> list[tuple[str, Any]]:
    """Messages of a scan with numbers, lengths or the order of some changed."""
    messages = messages_of(blocks)
    for _ in range(draw(st.integers(1, 4))):
        place = draw(st.integers(0, len(messages) - 1))
        _change(draw, messages[place][1])
    match draw(st.sampled_from(["as it was", "reversed", "repeated", "dropped", "shuffled"])):
        case "reversed":
            messages.reverse()
        case "repeated":
            messages += messages[: draw(st.integers(1, len(messages)))]
        case "dropped":
            del messages[: draw(st.integers(1, len(messages)))]
        case "shuffled":
            messages = draw(st.permutations(messages))
    if draw(st.integers(0, 4)) == 0:  # the same wrong thing in all of them
        period = draw(_FLOATS)
        for _, message in messages:
            message.sample_period = period
    return messages


def _change(draw: st.DrawFn, message: Any) -> None:
    arrays = [n for n in ("x", "y", "z", "b", "c", "distance", "intensity") if hasattr(message, n)]
    match draw(st.sampled_from(["period", "counter", "stamp", "value", "length", "status"])):
        case "period":
            message.sample_period = draw(_FLOATS)
        case "counter":
            message.first_sample = draw(_COUNTERS)
        case "stamp":
            message.header.stamp.sec = draw(_SECONDS)
            message.header.stamp.nanosec = draw(_NANOSECONDS)
        case "value":
            values = getattr(message, name := draw(st.sampled_from(arrays))).copy()
            if len(values):
                with np.errstate(over="ignore"):
                    values[draw(st.integers(0, len(values) - 1)) :][:3] = draw(_FLOATS)
            setattr(message, name, values)
        case "length":
            name, length = draw(st.sampled_from(arrays)), draw(_LENGTHS)
            setattr(message, name, np.resize(getattr(message, name), length))
        case "status" if hasattr(message, "status"):
            message.status = np.full(len(message.distance), draw(st.integers(0, 255)), np.uint8)


@st.composite
def hostile_bags(draw: st.DrawFn, blocks: list[tuple[Any, Any]]) -> tuple[Any, ...]:
    """How to write a hostile bag: messages, format, and damage to its bytes."""
    messages = draw(hostile_messages(blocks))
    plugin = draw(st.sampled_from([StoragePlugin.MCAP] * 4 + [StoragePlugin.SQLITE3]))
    mode = draw(st.sampled_from([None] * 3 + list(CompressionMode)[1:]))
    return messages, plugin, mode


def write_bag(folder: Path, how: tuple[Any, ...]) -> str:
    """Write the bag into ``folder``; the name to read it by."""
    messages, plugin, mode = how
    path = folder / "bag"
    shutil.rmtree(path, ignore_errors=True)
    writer = Writer(path, version=9, storage_plugin=plugin)
    if mode is not None and not (
        plugin is StoragePlugin.SQLITE3 and mode is CompressionMode.STORAGE
    ):
        writer.set_compression(mode, CompressionFormat.ZSTD)
    store = message_mapping.typestore()
    with writer:
        connections = {
            topic: writer.add_connection(topic, bags.TOPIC_TYPES[topic], typestore=store)
            for topic in TOPICS
        }
        for index, (topic, message) in enumerate(messages):
            raw = store.serialize_cdr(message, bags.TOPIC_TYPES[topic])
            writer.write(connections[topic], index, raw)
    return "bag" if mode is not None or plugin is not StoragePlugin.MCAP else "bag/bag.mcap"


def damaged_files(good: bytes) -> st.SearchStrategy[bytes]:
    """An MCAP file with bytes changed anywhere, or bytes that never were one."""
    return st.one_of(damaged(good), damaged(good), st.binary(max_size=100))
