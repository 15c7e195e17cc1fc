"""The blocks and the motion of a bag, read with progress."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from omsm_ros.core.samples.blocks import (
    Block,
    FloatArray,
)
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
