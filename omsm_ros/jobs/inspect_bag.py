"""What is in a bag: topics, rates, gaps, restarts, invalid readings."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from omsm_ros.core.samples.blocks import (
    Block,
    DistanceBlock,
)
from omsm_ros.jobs.read_bag import Progress, no_progress, read_blocks
from omsm_ros.storage import bags

# ---------------------------------------------------------------------------- inspection


@dataclass(frozen=True, slots=True)
class StreamInspection:
    """What a stream of blocks holds.

    gaps: places where the trigger counter skips; missing: samples skipped there
    restarts: places where it falls back
    """

    topic: str
    type: str
    messages: int
    samples: int = 0
    sample_period: float = 0.0
    duration: float = 0.0
    gaps: int = 0
    missing: int = 0
    restarts: int = 0
    invalid: int = 0


def inspect_bag(path: Path, progress: Progress = no_progress) -> list[StreamInspection]:
    """Look through a bag: topics, samples, rates, gaps, restarts, invalid readings."""
    with bags.BagReader(path) as bag:
        topics = bag.topics()
    streams = {bags.AXES_TOPIC, bags.DISTANCE_TOPIC, bags.REFERENCE_TOPIC, bags.ACCELERATION_TOPIC}
    present = [t.topic for t in topics if t.topic in streams]
    blocks = read_blocks(path, present, progress)
    return [
        _inspect(t, blocks[t.topic])
        if blocks.get(t.topic)
        else StreamInspection(t.topic, t.type, t.messages)
        for t in topics
    ]


def _inspect(topic: bags.TopicSummary, blocks: list[Block]) -> StreamInspection:
    first = np.array([b.first_sample for b in blocks])
    length = np.array([len(b) for b in blocks])
    skip = first[1:] - (first + length)[:-1]
    period = blocks[0].sample_period
    return StreamInspection(
        topic=topic.topic,
        type=topic.type,
        messages=topic.messages,
        samples=int(length.sum()),
        sample_period=period,
        duration=float(length.sum() * period),
        gaps=int(np.sum(skip > 0)),
        missing=int(skip[skip > 0].sum()),
        restarts=int(np.sum(skip < 0)),
        invalid=sum(int(np.sum(~b.ok)) for b in blocks if isinstance(b, DistanceBlock)),
    )


def as_json(inspections: list[StreamInspection]) -> list[dict[str, object]]:
    """JSON values of an inspection."""
    return [asdict(inspection) for inspection in inspections]
