"""Inspect a bag: its streams, their faults, and the vibration levels in it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from omsm_ros.core.streams.stream_faults import StreamWatch, counter_skew, skew_fault
from omsm_ros.errors import Notice
from omsm_ros.io import bags
from omsm_ros.io.topics import relative
from omsm_ros.pipelines.progress import Progress, no_progress
from omsm_ros.pipelines.recording import Recording

_NO_INDEX = (
    "the file has no index: its recording was interrupted or the disk was full, so its end may be "
    "missing; 'omsm inspect --repair' makes a copy with an index"
)


@dataclass(frozen=True, slots=True)
class StreamInspection:
    """Contents of one topic.

    gaps: number of gaps in the trigger counter;  missing: samples missing in them
    restarts: how often the counter started again
    invalid: invalid readings of the probe or positions of the axes
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


@dataclass(frozen=True)
class Inspection:
    """Contents of a bag: its topics, its faults as text, and vibration levels.

    vibration: levels that the monitor reported, see :func:`_vibration`; None without any
    """

    streams: list[StreamInspection]
    faults: list[str] = field(default_factory=list)
    vibration: dict[str, object] | None = None

    def entry(self) -> dict[str, object]:
        """Return the JSON values of this record."""
        topics = [asdict(stream) for stream in self.streams]
        return {"topics": topics, "faults": self.faults, "vibration": self.vibration}


def inspect_bag(path: bags.AnyBag, progress: Progress = no_progress) -> Inspection:
    """Return topics, samples, rates, gaps, restarts, invalid readings and faults of a bag."""
    with Recording(path, progress) as recording:
        bag = recording.bag
        topics = bag.topics()
        present = [t.role for t in topics if t.role in bags.BLOCK_TOPICS and t.messages]
        watches = {topic: StreamWatch() for topic in present}
        for topic, block in recording.stream(*present):
            watches[topic].add(block)
        if recording.holds(bags.ACCELERATION_TOPIC):
            watches[bags.ACCELERATION_TOPIC] = StreamWatch()
            for topic, block in bag.records(bags.ACCELERATION_TOPIC):
                watches[topic].add(block)
        faults = [] if bag.indexed else [_NO_INDEX]
        faults += [
            f"no {what}: nothing on {bag.name_of(topic)!r}, which identify and correct need"
            for topic, what in ((bags.AXES_TOPIC, "axes"), (bags.DISTANCE_TOPIC, "distance"))
            if topic not in watches
        ]
        vibration = _vibration(bag.vibration())
    streams = [_inspect(t, watches.get(t.role)) for t in topics]
    return Inspection(streams, [*faults, *map(str, _faults(watches))], vibration)


def _vibration(levels: Sequence[Mapping[str, Any]]) -> dict[str, object] | None:
    """Return the largest levels of all spectra that the monitor reported; None without any.

    rms: of each axis by band [m/s²];  height, height_total: effect on a height, rms [m], None
    without a calibration;  alarms: number of spectra during which the alarm was raised
    """
    # The bands depend on the sampling rate; only spectra with those of the last one compare.
    alike = [one for one in levels if one["bands"] == levels[-1]["bands"]]
    if not alike:
        return None
    heights = [one for one in alike if one["height"] is not None]
    return {
        "spectra": len(levels),
        "alarms": sum(one["alarm"] for one in levels),
        "bands": alike[-1]["bands"],
        "rms": {axis: _largest(one["rms"][axis] for one in alike) for axis in alike[-1]["rms"]},
        "height": _largest(one["height"] for one in heights) if heights else None,
        "height_total": max((one["height_total"] for one in heights), default=None),
    }


def _largest(levels: Iterable[Sequence[float]]) -> list[float]:
    """Return the largest level of each band."""
    return [float(max(band)) for band in zip(*levels, strict=True)]


def _faults(watches: dict[str, StreamWatch]) -> Iterator[Notice]:
    for topic, watch in watches.items():
        yield from watch.faults(relative(topic))
    axes, distance = watches.get(bags.AXES_TOPIC), watches.get(bags.DISTANCE_TOPIC)
    if axes and distance and axes.samples and distance.samples:
        period = min(axes.periods)
        if period == min(distance.periods):
            yield from skew_fault(counter_skew(axes, distance), period)


def _inspect(topic: bags.TopicSummary, watch: StreamWatch | None) -> StreamInspection:
    if watch is None or not watch.samples:
        return StreamInspection(topic.topic, topic.type, topic.messages)
    period = min(watch.periods)
    return StreamInspection(
        topic=topic.topic,
        type=topic.type,
        messages=topic.messages,
        samples=watch.samples,
        sample_period=period,
        duration=float(watch.samples * period),
        gaps=watch.places,
        missing=watch.missing,
        restarts=watch.restarts,
        invalid=watch.invalid,
    )
