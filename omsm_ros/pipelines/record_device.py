"""Record a device to a bag without ROS."""

import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from omsm_ros.errors import ConfigurationError, DeviceError
from omsm_ros.instruments.blocks import BlockPair
from omsm_ros.instruments.factory import make_device
from omsm_ros.instruments.parameters import PARAMETERS, defaults
from omsm_ros.instruments.reader import DeviceReader
from omsm_ros.io.bag_writer import BagWriter
from omsm_ros.io.topics import AXES_TOPIC, DISTANCE_TOPIC
from omsm_ros.pipelines.progress import Progress, no_progress

# How often the end of the recording is looked for [s].
_LOOK_S = 0.05
# Interval of writing to the disk; a killed recording loses no more than this [s].
_FLUSH_S = 0.5


def record_device(
    given: dict[str, Any],
    out: Path,
    ended: Callable[[int, float], bool],
    progress: Progress = no_progress,
) -> dict[str, Any]:
    """Write the samples of the device that parameters ``given`` describe into the bag ``out``.

    ended: returns True at the end, by the number of samples and the seconds since the last one

    Returns all counts. Raises ConfigurationError for a parameter, DeviceError if no sample came.
    """
    if unknown := set(given) - set(defaults()):
        raise ConfigurationError(f"no parameters {sorted(unknown)!r}; see docs/nodes.md")
    values = defaults() | {p.name: p.checked(given[p.name]) for p in PARAMETERS if p.name in given}
    device = make_device(values)
    axes, distance = device.channels.axes is not None, device.channels.distance
    topics = [AXES_TOPIC] * axes + [DISTANCE_TOPIC] * distance
    stop, samples = threading.Event(), 0
    last = flushed = time.monotonic()
    with BagWriter(out, topics) as bag:

        def deliver(pairs: Sequence[BlockPair]) -> None:
            nonlocal samples, last, flushed
            for pair in pairs:
                blocks = [block for block in pair if block is not None]
                for block in blocks:
                    bag.write_block(block)
                samples += max(map(len, blocks))
            last = time.monotonic()
            if last - flushed > _FLUSH_S:
                bag.flush()
                flushed = last

        reader = DeviceReader(device, deliver)
        thread = threading.Thread(target=reader.run, args=(stop,), daemon=True)
        thread.start()
        with suppress(KeyboardInterrupt):  # the usual end of a recording
            while not ended(samples, time.monotonic() - last):
                progress(samples, 0)
                time.sleep(_LOOK_S)
        stop.set()
        thread.join()
    if not samples:
        raise DeviceError(f"no sample came from {values['port']!r}: {reader.trouble or 'silence'}")
    return {"bag": str(out), "samples": samples, "connections": reader.connections} | {
        name: count for name, count in device.counts().items() if count
    }
