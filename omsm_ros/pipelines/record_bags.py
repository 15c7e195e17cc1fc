"""Write bags: of a device, without ROS, and of the digital twin, a step test and a scan."""

import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import yaml

from omsm_ros.core.surface.nominal import (
    PAPER_MIRROR,
    PAPER_MIRROR_HALF_LENGTH_M,
    PAPER_MIRROR_RADIUS_M,
)
from omsm_ros.errors import ConfigurationError, DeviceError
from omsm_ros.instruments.blocks import BlockPair
from omsm_ros.instruments.factory import make_device
from omsm_ros.instruments.parameters import PARAMETERS, defaults
from omsm_ros.instruments.reader import DeviceReader
from omsm_ros.io import bags
from omsm_ros.io.bag_writer import BagWriter
from omsm_ros.io.descriptions import load_disturbances
from omsm_ros.io.files import save_text
from omsm_ros.io.topics import AXES_TOPIC, DISTANCE_TOPIC
from omsm_ros.pipelines.progress import state_progress
from omsm_ros.readable import count, quantity
from omsm_ros.twin.cell import Recording, blocks_of, pieces
from omsm_ros.twin.scenario import (
    MIRROR_APERTURE,
    Scenario,
    planned_test_of,
    scan_of,
    source_recording,
    spiral_of,
)

# How often the end of the recording is looked for [s].
_LOOK_S = 0.05
# Interval of writing to the disk; a killed recording loses no more than this [s].
_FLUSH_S = 0.5
# Before it is said that no sample has come yet [s].
_PATIENCE_S = 3.0


def record_device(
    given: dict[str, Any],
    out: Path,
    ended: Callable[[int, float], bool],
    waits: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Write the samples of the device that parameters ``given`` describe into the bag ``out``.

    ended: returns True at the end, by the number of samples and the seconds since the last one
    waits: called once with the reason if no sample comes for some seconds; it waits for the first

    Returns all counts. Raises ConfigurationError for a parameter, DeviceError if no sample came.
    """
    if unknown := set(given) - set(defaults()):
        raise ConfigurationError(f"no parameters {sorted(unknown)!r}; see docs/nodes.md")
    values = defaults() | {p.name: p.checked(given[p.name]) for p in PARAMETERS if p.name in given}
    device = make_device(values)
    axes, distance = device.channels.axes is not None, device.channels.distance
    topics = [AXES_TOPIC] * axes + [DISTANCE_TOPIC] * distance
    stop, samples, patient = threading.Event(), 0, True
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
                state_progress(samples, 0)
                if not samples and patient and time.monotonic() - last > _PATIENCE_S:
                    patient = False
                    waits(f"no sample yet from {values['port']!r}: {reader.trouble or 'silence'}")
                time.sleep(_LOOK_S)
        stop.set()
        thread.join()
    if not samples:
        raise DeviceError(f"no sample came from {values['port']!r}: {reader.trouble or 'silence'}")
    return {"bag": str(out), "samples": samples, "connections": reader.connections} | {
        name: count for name, count in device.counts().items() if count
    }


_BLOCK_SAMPLES = 1000
# Bounds memory to half a gigabyte with all disturbances.
_MOST_SAMPLES = 1_000_000
STEPS, SCAN, NOMINAL = "steps.mcap", "scan.mcap", "mirror.yaml"
_FILES = {"steps": STEPS, "scan": SCAN, "nominal": NOMINAL}


def write_recording(path: Path, recording: Recording) -> Path:
    """Write ``recording`` to the bag ``path``; return the path."""
    topics = [bags.AXES_TOPIC, bags.DISTANCE_TOPIC]
    topics += [bags.REFERENCE_TOPIC] if recording.reference is not None else []
    topics += [bags.ACCELERATION_TOPIC] if recording.acceleration is not None else []
    with BagWriter(path, topics) as bag:
        for axes, distance in blocks_of(recording, _BLOCK_SAMPLES):
            bag.write_block(axes)
            bag.write_block(distance)
        for block in pieces(recording.reference, _BLOCK_SAMPLES):
            bag.write_block(block, bags.REFERENCE_TOPIC)
        for block in pieces(recording.acceleration, _BLOCK_SAMPLES):
            bag.write_block(block)
    return path


def record_twin(
    out: Path, scenario: Scenario, disturbance_file: Path | None = None
) -> dict[str, Any]:
    """Write ``steps.mcap``, ``scan.mcap`` and the nominal ``mirror.yaml`` into ``out``.

    Return their paths and numbers of samples. Raises BagError if a bag of that name exists,
    ConfigurationError for a scan beyond the mirror or too long for memory.
    """
    check_scenario(scenario)
    wrong = load_disturbances(disturbance_file)
    steps = _write(out / STEPS, planned_test_of(scenario, wrong))
    scan = _write(out / SCAN, scan_of(scenario, wrong))
    write_nominal(out / NOMINAL, scenario.start_radius > PAPER_MIRROR_RADIUS_M)
    paths = {name: str(out / f) for name, f in _FILES.items()}
    return {**paths, "step_samples": steps, "scan_samples": scan}


def record_sources(
    out: Path, scenario: Scenario, kinds: Sequence[str], disturbance_file: Path | None = None
) -> dict[str, int]:
    """Write a bag for each of ``kinds``; return its samples. BagError if one exists."""
    wrong = load_disturbances(disturbance_file)
    bags_of = {kind: out / f"{kind}.mcap" for kind in kinds}
    return {
        str(path): _write(path, source_recording(kind, scenario, wrong))
        for kind, path in bags_of.items()
    }


def check_scenario(scenario: Scenario) -> None:
    """Raise ConfigurationError for a scan beyond the twin's mirror, or of too many samples."""
    if scenario.start_radius > PAPER_MIRROR_HALF_LENGTH_M:
        raise ConfigurationError(
            f"radius is {quantity(scenario.start_radius, 'm', 4)}, expected at most that of the "
            f"twin's mirror, {quantity(PAPER_MIRROR_HALF_LENGTH_M, 'm', 4)}; give it in metres"
        )
    samples = spiral_of(scenario).duration / scenario.sample_period
    if samples > _MOST_SAMPLES:
        raise ConfigurationError(
            f"the scan has {count(round(samples))} samples, expected at most "
            f"{count(_MOST_SAMPLES)}; give a wider feed, a smaller radius or a faster spindle"
        )


def write_nominal(path: Path, whole: bool = False) -> None:
    """Write the nominal surface of the twin's mirror, with its elliptic aperture if ``whole``."""
    sizes = ", ".join(f"{size:.6g}" for size in MIRROR_APERTURE.sizes)
    nominal: dict[str, object] = {
        "shape": "off_axis_paraboloid",
        "parent_focal_length": PAPER_MIRROR.parent_focal_length,
        "off_axis_distance": PAPER_MIRROR.off_axis_distance,
    }
    if whole:
        nominal["aperture"] = f"ellipse: {sizes}"
    save_text(path, yaml.safe_dump(nominal, sort_keys=False))


def _write(path: Path, recording: Recording) -> int:
    write_recording(path, recording)
    return len(recording.axes)
