"""The blocks and the motion of a bag, read with progress."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from omsm_ros.core.machine.limits import ScanPath
from omsm_ros.core.samples.blocks import AxisBlock, Block, DistanceBlock, FloatArray
from omsm_ros.errors import BagError
from omsm_ros.storage import bags

Progress = Callable[[int, int], None]
"""Called with messages done and messages in all."""


def no_progress(done: int, total: int) -> None:
    """Report to nobody."""


def read_blocks(
    path: Path, topics: Sequence[str], progress: Progress = no_progress
) -> dict[str, list[Block]]:
    """All blocks on ``topics``, by topic; BagError if one of the topics is not there."""
    found: dict[str, list[Block]] = {topic: [] for topic in topics}
    with bags.BagReader(path) as bag:
        total = bag.count(topics)
        for done, (topic, record) in enumerate(bag.records(*topics), start=1):
            found[topic].append(record)
            progress(done, total)
    return found


# ------------------------------------------------------------------------------- preview


def motion_in(
    path: Path, progress: Progress = no_progress, most: int | None = None
) -> tuple[FloatArray, float]:
    """Z of a bag [m], its first ``most`` samples (None = all), and its sample period [s]."""
    found: list[FloatArray] = []
    samples, period = 0, 0.0
    with bags.BagReader(path) as bag:
        total = bag.count([bags.AXES_TOPIC])
        for done, _, block in bag.blocks(bags.AXES_TOPIC):
            found.append(block.z)
            samples, period = samples + len(block), block.sample_period
            progress(done, total)
            if most is not None and samples >= most:
                break
    if not found:
        raise BagError(f"{str(path)!r} has no samples on {bags.AXES_TOPIC!r}; record a motion")
    return np.concatenate(found)[:most], period


def path_in(path: Path, progress: Progress = no_progress) -> ScanPath:
    """Return the path that a bag holds, with its readings where it has some."""
    with bags.BagReader(path) as bag:
        probed = any(t.topic == bags.DISTANCE_TOPIC and t.messages for t in bag.topics())
    topics = [bags.AXES_TOPIC, *([bags.DISTANCE_TOPIC] if probed else [])]
    blocks = read_blocks(path, topics, progress)
    axes = [b for b in blocks[bags.AXES_TOPIC] if isinstance(b, AxisBlock)]
    if not axes:
        raise BagError(f"{str(path)!r} has no samples on {bags.AXES_TOPIC!r}; record a motion")
    readings = [
        np.where(b.ok, b.distance, np.nan)
        for b in blocks.get(bags.DISTANCE_TOPIC, [])
        if isinstance(b, DistanceBlock)
    ]
    return ScanPath(
        z=np.concatenate([b.z for b in axes]),
        sample_period=axes[0].sample_period,
        x=np.concatenate([b.x for b in axes]),
        c=np.concatenate([b.c for b in axes]),
        distance=np.concatenate(readings) if readings else None,
    )
