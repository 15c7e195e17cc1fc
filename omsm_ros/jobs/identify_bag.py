"""The motion in a bag, ready to identify from."""

from __future__ import annotations

from collections.abc import Mapping

from omsm_ros.core.dynamics.calibration import settings_with
from omsm_ros.core.samples.blocks import Block
from omsm_ros.core.samples.motion_record import MotionRecord, assemble
from omsm_ros.core.samples.slips import EQUAL_COUNTS, CommonTrigger
from omsm_ros.core.samples.stamped_period import check_period
from omsm_ros.errors import BagError, ConfigurationError
from omsm_ros.jobs.progress import Progress, no_progress
from omsm_ros.jobs.read_bag import read_blocks
from omsm_ros.quantities import TIME_LAPSE
from omsm_ros.storage import bags
from omsm_ros.storage.recording.topics import AnyBag


def motion_of_bag(
    path: AnyBag,
    *,
    duration: float = 0.0,
    time_lapse: object = 1.0,
    trigger: CommonTrigger = EQUAL_COUNTS,
    by_stamps: bool = False,
    progress: Progress = no_progress,
) -> MotionRecord:
    """Return the motion in a bag, its first ``duration`` seconds (0 = all), ready to identify from.

    time_lapse: how much faster than real time the recording was played [1]
    trigger: what is stated of the counters of axes and distance
    by_stamps: join both by their stamps, not by their counters
    The reference sensor is used where it was recorded.

    Raises DataError where the stamps contradict the sample period, or the counters each other.
    """
    faster = TIME_LAPSE.checked(time_lapse, ConfigurationError, "time_lapse")
    topics = [bags.AXES_TOPIC, bags.DISTANCE_TOPIC]
    with bags.BagReader(path) as bag:
        if any(t.role == bags.REFERENCE_TOPIC and t.messages for t in bag.topics()):
            topics.append(bags.REFERENCE_TOPIC)
    blocks = read_blocks(path, topics, progress)
    if not blocks[bags.AXES_TOPIC] or not blocks[bags.DISTANCE_TOPIC]:
        raise BagError(f"{str(path)!r} has its topics but no samples on them; record a step test")
    axes, distance, *reference = (_beginning(blocks[topic], duration) for topic in topics)
    for name, stream in (("axis", axes), ("distance", distance)):
        check_period(name, stream, faster)
    return assemble(  # type: ignore[misc]
        axes,
        distance,
        *reference,
        trigger=trigger,
        by_stamps=by_stamps,  # type: ignore[arg-type]
    )


def settings_of_bag(path: AnyBag, stated: Mapping[str, object]) -> dict[str, object]:
    """Return what a calibration from this bag belongs to: ``stated``, and the probe's report."""
    with bags.BagReader(path) as bag:
        return settings_with(stated, bag.probe_settings())


def recorded_ns_of_bag(path: AnyBag) -> int | None:
    """Return when the recording began [ns, ROS time], None where its clock was never set."""
    with bags.BagReader(path) as bag:
        return bag.recorded_ns


def _beginning(blocks: list[Block], duration: float) -> list[Block]:
    if duration == 0 or not blocks:
        return blocks
    end = blocks[0].first_sample + duration / blocks[0].sample_period
    return [block for block in blocks if block.first_sample < end]
