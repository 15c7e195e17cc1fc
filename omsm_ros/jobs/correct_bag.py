"""What the commands and the nodes do with a recorded bag.

``bag → records → core → cloud.ply, summary.json, report.html``
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
from omsm_ros.core.correction.surface_points import SurfacePoints
from omsm_ros.core.correction.uncertainty import with_lateral
from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.machine.surface_height import Surface
from omsm_ros.core.samples.blocks import (
    AxisBlock,
    Block,
    DistanceBlock,
    follows,
    join_axes,
    join_distance,
)
from omsm_ros.core.samples.joining_by_stamp import axes_at_probe
from omsm_ros.jobs.read_bag import Progress, no_progress
from omsm_ros.storage import bags
from omsm_ros.storage.cloud_file import PlyWriter

_GATHERED_BLOCKS = 32


# ---------------------------------------------------------------------------- correction


@dataclass(frozen=True)
class ByStamps:
    """Probe and axes joined by their stamps, not by a common trigger counter.

    delay: from the probe's stamp to the middle of its exposure, on the axes' clock [s]
    exposure: over which the probe averages [s]
    """

    delay: float = 0.0
    exposure: float = 0.0


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
