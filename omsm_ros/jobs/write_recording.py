"""A recording of the twin as a bag, as if its devices had been recorded."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from omsm_ros.core.samples.blocks import AccelerationBlock
from omsm_ros.storage import bags
from omsm_ros.storage.recording.bag_writer import BagWriter
from omsm_ros.twin.cell import Recording, blocks_of
from omsm_ros.units import NANOSECONDS_PER_S

_BLOCK_SAMPLES = 1000


def write_recording(path: Path, recording: Recording) -> Path:
    """Write ``recording`` to the bag ``path``, and return it."""
    topics = [bags.AXES_TOPIC, bags.DISTANCE_TOPIC]
    topics += [bags.ACCELERATION_TOPIC] if recording.acceleration is not None else []
    with BagWriter(path, topics) as bag:
        for axes, distance in blocks_of(recording, _BLOCK_SAMPLES):
            bag.write_axes(axes)
            bag.write_distance(distance)
        if recording.acceleration is not None:
            for block in acceleration_blocks(recording.acceleration, _BLOCK_SAMPLES):
                bag.write_acceleration(block)
    return path


def acceleration_blocks(whole: AccelerationBlock, size: int) -> Iterator[AccelerationBlock]:
    """Cut ``whole`` into blocks of ``size`` samples, as a driver publishes them."""
    for start in range(0, len(whole), size):
        part = slice(start, start + size)
        yield AccelerationBlock(
            stamp_ns=whole.stamp_ns + round(start * whole.sample_period * NANOSECONDS_PER_S),
            first_sample=whole.first_sample + start,
            sample_period=whole.sample_period,
            x=whole.x[part],
            y=whole.y[part],
            z=whole.z[part],
        )
