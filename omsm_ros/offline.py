"""What the commands and the nodes do with a recorded bag.

``bag → records → core → cloud.ply, summary.json, report.html``
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from omsm_ros import bags
from omsm_ros.core.calibration import Calibration
from omsm_ros.core.clocks import axes_at_probe
from omsm_ros.core.correct import CorrectionOptions, Corrector
from omsm_ros.core.predict import Prediction, predict_error
from omsm_ros.core.records import (
    AxisBlock,
    Block,
    DistanceBlock,
    FloatArray,
    SurfacePoints,
    follows,
    join_axes,
    join_distance,
)
from omsm_ros.core.surface import Surface
from omsm_ros.core.uncertainty import with_lateral
from omsm_ros.errors import BagError, CalibrationError
from omsm_ros.files import PlyWriter

_GATHERED_BLOCKS = 32

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


# ---------------------------------------------------------------------------- correction


@dataclass(frozen=True)
class ByStamps:
    """Probe and axes joined by their stamps, not by a common trigger counter.

    delay: from the probe's stamp to the middle of its exposure, on the axes' clock [s]
    exposure: over which the probe averages [s]
    """

    delay: float = 0.0
    exposure: float = 0.0


def sample_period_of(path: Path) -> float:
    """Sample period of the probe in a bag [s], from the first block."""
    with bags.BagReader(path) as bag:
        for _, block in bag.records(bags.DISTANCE_TOPIC):
            return float(block.sample_period)
    raise BagError(f"{str(path)!r} has no samples on {bags.DISTANCE_TOPIC!r}; record a scan")


@dataclass(frozen=True)
class Correction:
    """What became of a bag.

    account: of every sample, by stream;  budget: rms of each source of uncertainty [m]
    stamp_skew: of the two streams' stamps for the same trigger [s], None if none was paired
    """

    account: dict[str, Any]
    budget: dict[str, float]
    stamp_skew: float | None


def correct_bag(
    path: Path,
    calibration: Calibration,
    cloud: Path,
    *,
    options: CorrectionOptions | None = None,
    nominal: Surface | None = None,
    lateral: float = 0.0,
    by_stamps: ByStamps | None = None,
    comment: str = "",
    progress: Progress = no_progress,
) -> Correction:
    """Correct a bag into ``cloud`` (PLY).

    nominal, lateral: surface, and standard uncertainty of a point sideways [m], which costs
        height where the surface slopes
    by_stamps: join the streams by their stamps; None: by the trigger counter they share
    Memory does not grow with the bag, but for ``by_stamps``. Leaves no cloud behind when it fails.
    """
    corrector = Corrector(calibration, options or CorrectionOptions())
    topics = (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)
    with (
        bags.BagReader(path) as bag,
        PlyWriter(cloud, f"omsm_ros, metres, calibration {calibration.id} {comment}") as ply,
    ):
        total = bag.count(topics)

        def write(points: SurfacePoints | None) -> None:
            if points is not None:
                ply.write(with_lateral(points, nominal, lateral) if nominal and lateral else points)

        records = bag.records(*topics)
        if by_stamps is not None:
            records = _joined_by_stamps(records, by_stamps)
        for done, record in _gathered(records):
            if isinstance(record, AxisBlock):
                corrector.push_axes(record)
            elif isinstance(record, DistanceBlock):
                corrector.push_distance(record)
            write(corrector.take())
            progress(done, total)
        write(corrector.finish())
    account = dict(corrector.account.as_dict())
    return Correction(account, corrector.budget, corrector.stamp_skew)


def _joined_by_stamps(records: Iterable[bags.Item], how: ByStamps) -> Iterator[bags.Item]:
    """The axes at the probe's samples, and the probe's blocks, as if one trigger had both."""
    axes, distance = [], []
    for _, block in records:
        if isinstance(block, AxisBlock):
            axes.append(block)
        elif isinstance(block, DistanceBlock):
            distance.append(block)
    moved = axes_at_probe(axes, distance, delay=how.delay, exposure=how.exposure)
    for axis_block, reading in zip(moved, distance, strict=True):
        yield bags.AXES_TOPIC, axis_block
        yield bags.DISTANCE_TOPIC, reading


def _gathered(records: Iterable[bags.Item]) -> Iterator[tuple[int, Block]]:
    """Blocks of a bag joined into long ones, and how many messages have been read.

    The result of a correction does not depend on how its samples were cut; its speed does.
    """
    waiting: dict[type[Block], list[Any]] = {AxisBlock: [], DistanceBlock: []}
    done = 0
    for done, (_, record) in enumerate(records, start=1):
        blocks = waiting[type(record)]
        if blocks and not (len(blocks) < _GATHERED_BLOCKS and follows(record, blocks[-1])):
            yield done, _join(blocks)
            blocks.clear()
        blocks.append(record)
    yield from ((done, _join(blocks)) for blocks in waiting.values() if blocks)


def _join(blocks: list[Any]) -> Block:
    return join_axes(blocks) if isinstance(blocks[0], AxisBlock) else join_distance(blocks)


# ------------------------------------------------------------------------------- preview


def motion_in(
    path: Path, progress: Progress = no_progress, most: int | None = None
) -> tuple[FloatArray, float]:
    """Z of a bag [m], its first ``most`` samples (None = all), and its sample period [s]."""
    found: list[FloatArray] = []
    samples, period = 0, 0.0
    with bags.BagReader(path) as bag:
        total = bag.count([bags.AXES_TOPIC])
        for done, (_, block) in enumerate(bag.records(bags.AXES_TOPIC), start=1):
            found.append(block.z)
            samples, period = samples + len(block), block.sample_period
            progress(done, total)
            if most is not None and samples >= most:
                break
    if not found:
        raise BagError(f"{str(path)!r} has no samples on {bags.AXES_TOPIC!r}; record a motion")
    return np.concatenate(found)[:most], period


def predict_from(
    calibration: Calibration | None, bag: str, z: FloatArray, sample_period: float
) -> Prediction:
    """Predict the dynamic error of the motion in ``bag``, or of ``z`` [m] if that is empty."""
    if calibration is None:
        raise CalibrationError("no calibration in use; call identify or load one")
    if bag:
        z, sample_period = motion_in(Path(bag))
    return predict_error(calibration, np.asarray(z, np.float64), sample_period)


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
