"""A recorded bag: opened once, and each part of it read when a task needs it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from omsm_ros.core.adjustment.scan_data import ScanData
from omsm_ros.core.calibration.calibration import settings_with
from omsm_ros.core.correction.surface_points import SurfacePoints, join_points
from omsm_ros.core.kinematics.scan_path import ScanPath, ScanPathReader
from omsm_ros.core.streams.blocks import AxisBlock, Block, FloatArray, IntArray
from omsm_ros.core.streams.motion_record import MotionRecord, assemble
from omsm_ros.core.streams.stamps import check_period
from omsm_ros.core.streams.trigger_slips import EQUAL_COUNTS, CommonTrigger
from omsm_ros.errors import BagError, ConfigurationError
from omsm_ros.io import bags
from omsm_ros.io.descriptions import load_motion
from omsm_ros.io.topics import AnyBag
from omsm_ros.pipelines.progress import state_progress
from omsm_ros.quantities import TIME_LAPSE

MAX_PATH_SAMPLES = 2**20
"""Bound on the memory of a scan path: 17 minutes at 1 kHz, the fastest part of a spiral."""

SCAN_TOPICS = (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)


class Recording(bags.BagReader):
    """A bag opened for one task, whose progress it states; use it as a context manager."""

    def holds(self, topic: str) -> bool:
        """Return True if there are messages on ``topic``."""
        return self.count([topic]) > 0

    def stream(self, *topics: str) -> Iterator[tuple[str, Any]]:
        """Yield ``(topic, block)`` in the order of recording, short blocks joined."""
        total = self.count(topics)
        for done, topic, block in self.blocks(*topics):
            yield topic, block
            state_progress(done, total)

    def recorded(self, *topics: str) -> dict[str, list[Block]]:
        """Return all blocks by topic, as they were recorded; BagError if a topic is absent."""
        found: dict[str, list[Block]] = {topic: [] for topic in topics}
        total = self.count(topics)
        for done, (topic, block) in enumerate(self.records(*topics), start=1):
            found[topic].append(block)
            state_progress(done, total)
        return found

    def sample_period(self) -> float:
        """Return the sample period of the probe [s]; BagError without samples of it."""
        for _, block in self.records(bags.DISTANCE_TOPIC):
            return float(block.sample_period)
        raise BagError(
            f"{str(self.path)!r} has no samples on {bags.DISTANCE_TOPIC!r}; record a scan"
        )

    def scan_path(self) -> ScanPath:
        """Return the start of the path, with readings if any; BagError without a position of Z."""
        reader = ScanPathReader(MAX_PATH_SAMPLES)
        for _, block in self.stream(*filter(self.holds, SCAN_TOPICS)):
            reader.add(block)
        found = reader.path()
        if found is None:
            name = self.name_of(bags.AXES_TOPIC)
            raise BagError(f"{str(self.path)!r} has no position of Z on {name!r}; record a motion")
        return found

    def settings(self, stated: Mapping[str, object]) -> dict[str, object]:
        """Return the settings of a calibration from this bag: ``stated``, and the probe's own."""
        return settings_with(stated, self.probe_settings())

    def motion(
        self,
        *,
        duration: float = 0.0,
        time_lapse: object = 1.0,
        trigger: CommonTrigger = EQUAL_COUNTS,
        by_stamps: bool = False,
        further: Sequence[str] = (),
    ) -> MotionRecord:
        """Return the motion to identify from, its first ``duration`` seconds (0 = all).

        time_lapse: how much faster than real time the recording was played [1]
        trigger: what is stated of the counters of axes and distance
        by_stamps: join both by their stamps, not by their counters
        further: axes besides Z that may move the probe
        The reference sensor is used if it was recorded.

        Raises DataError if the stamps contradict the sample period, or the counters each other.
        """
        faster = TIME_LAPSE.checked(time_lapse, ConfigurationError, "time_lapse")
        topics = [*SCAN_TOPICS, *filter(self.holds, [bags.REFERENCE_TOPIC])]
        blocks = self.recorded(*topics)
        if not all(blocks[topic] for topic in SCAN_TOPICS):
            raise BagError(
                f"{str(self.path)!r} has its topics but no samples on them; record a step test"
            )
        if duration:
            for name, stream in blocks.items():
                end = stream[0].first_sample + duration / stream[0].sample_period if stream else 0
                blocks[name] = [block for block in stream if block.first_sample < end]
        axes, distance, *reference = (blocks[topic] for topic in topics)
        for name, stream in (("axis", axes), ("distance", distance)):
            check_period(name, stream, faster)
        return assemble(  # type: ignore[misc]
            axes,
            distance,
            *reference,
            trigger=trigger,
            by_stamps=by_stamps,  # type: ignore[arg-type]
            further=further,
        )


def scan_path_of(scan: AnyBag) -> ScanPath:
    """Return the motion in a bag, or in a plan in CSV with columns time_s and z_m.

    Raises FileError, BagError or ConfigurationError.
    """
    if isinstance(scan, Path) and scan.suffix.lower() == ".csv":
        z, period = load_motion(scan)
        return ScanPath(z=z, sample_period=period)
    with Recording(scan) as recording:
        return recording.scan_path()


def scan_data(
    axes: Sequence[AxisBlock],
    parts: Sequence[SurfacePoints],
    period: float,
    clocking: float = 0.0,
    clamping: int = 0,
) -> tuple[ScanData, SurfacePoints]:
    """Return points with the motion of the axes, time from zero, and the points that have one.

    clocking: angle by which the part is turned on the chuck [rad];  clamping: its number
    Raises DataError for points that do not make a scan.
    """
    made = join_points(parts)
    z, c = _axes_at(axes, made.sample)
    known = np.isfinite(z) & np.isfinite(c) & np.isfinite(made.height)
    made, z, c = made.part(known), z[known], np.unwrap(c[known])
    data = ScanData(
        time=(made.sample - made.sample[0]) * period if len(made) else np.empty(0), x=made.x,
        y=made.y, height=made.height, distance=made.height - z + made.dynamic_error, motion=z,
        removed=made.dynamic_error, c=c, clocking=clocking, clamping=clamping,
    )  # fmt: skip
    return data, made


def _axes_at(blocks: Sequence[AxisBlock], samples: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return z [m] and c [rad] at the trigger counts ``samples``, NaN where there is none."""
    counts = np.concatenate([b.first_sample + np.arange(len(b), dtype=np.int64) for b in blocks])
    z, c = (np.concatenate([getattr(b, name) for b in blocks]) for name in "zc")
    order = np.argsort(counts, kind="stable")
    counts, z, c = counts[order], z[order], c[order]
    place = np.minimum(np.searchsorted(counts, samples), len(counts) - 1)
    there = counts[place] == samples
    return np.where(there, z[place], np.nan), np.where(there, c[place], np.nan)
