"""The blocks and the motion of a bag, read with progress."""

from __future__ import annotations

from collections.abc import Sequence

from omsm_ros.core.kinematics.scan_path import ScanPath, ScanPathReader
from omsm_ros.core.streams.blocks import Block
from omsm_ros.errors import BagError
from omsm_ros.io import bags
from omsm_ros.io.topics import AnyBag
from omsm_ros.pipelines.progress import Progress, no_progress

MOST_JUDGED = 2**20
"""Samples of a path that are judged: a quarter of an hour at 1 kHz, of a spiral the fastest."""


def read_blocks(
    path: AnyBag, topics: Sequence[str], progress: Progress = no_progress
) -> dict[str, list[Block]]:
    """Return all blocks on ``topics``, by topic; BagError if one of the topics is not there."""
    found: dict[str, list[Block]] = {topic: [] for topic in topics}
    with bags.BagReader(path) as bag:
        total = bag.count(topics)
        for done, (topic, record) in enumerate(bag.records(*topics), start=1):
            found[topic].append(record)
            progress(done, total)
    return found


def sample_period_in(path: AnyBag) -> float:
    """Return the sample period of the probe in a bag [s]; BagError without samples of it."""
    with bags.BagReader(path) as bag:
        for _, block in bag.records(bags.DISTANCE_TOPIC):
            return float(block.sample_period)
    raise BagError(f"{str(path)!r} has no samples on {bags.DISTANCE_TOPIC!r}; record a scan")


def path_in(path: AnyBag, progress: Progress = no_progress) -> ScanPath:
    """Return the start of the path that a bag holds, with its readings where it has some."""
    start = ScanPathReader(MOST_JUDGED)
    with bags.BagReader(path) as bag:
        wanted = (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)
        present = [t.role for t in bag.topics() if t.messages and t.role in wanted]
        total = bag.count(present)
        for done, _, block in bag.blocks(*present):
            start.add(block)
            progress(done, total)
        name = bag.name_of(bags.AXES_TOPIC)
    found = start.path()
    if found is None:
        raise BagError(f"{str(path)!r} has no position of Z on {name!r}; record a motion")
    return found
