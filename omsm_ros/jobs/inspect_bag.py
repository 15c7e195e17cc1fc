"""What is in a bag, and what is wrong with it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field

from omsm_ros.core.samples.stream_faults import StreamWatch, counter_skew, skew_fault
from omsm_ros.jobs.read_bag import Progress, no_progress
from omsm_ros.storage import bags
from omsm_ros.storage.recording.topics import relative


@dataclass(frozen=True, slots=True)
class StreamInspection:
    """What a stream of blocks holds.

    gaps: places where the trigger counter skips; missing: samples skipped there
    restarts: places where it falls back;  invalid: readings that are none
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
    """streams: by topic;  faults: what is wrong, in words for people."""

    streams: list[StreamInspection]
    faults: list[str] = field(default_factory=list)

    def entry(self) -> dict[str, object]:
        """Return the JSON values of this record."""
        return {"topics": [asdict(stream) for stream in self.streams], "faults": self.faults}


def inspect_bag(path: bags.AnyBag, progress: Progress = no_progress) -> Inspection:
    """Look through a bag: topics, samples, rates, gaps, restarts, invalid readings, faults."""
    with bags.BagReader(path) as bag:
        topics = bag.topics()
        present = [t.role for t in topics if t.role in bags.BLOCK_TOPICS and t.messages]
        watches = {topic: StreamWatch() for topic in present}
        total = bag.count(present)
        for done, topic, block in bag.blocks(*present):
            watches[topic].add(block)
            progress(done, total)
        if any(t.role == bags.ACCELERATION_TOPIC and t.messages for t in topics):
            watches[bags.ACCELERATION_TOPIC] = StreamWatch()
            for topic, block in bag.records(bags.ACCELERATION_TOPIC):
                watches[topic].add(block)
        faults = [] if bag.indexed else [_NO_INDEX]
        faults += [
            f"no {what}: there is nothing on {bag.name_of(topic)!r} to identify or correct with"
            for topic, what in ((bags.AXES_TOPIC, "axes"), (bags.DISTANCE_TOPIC, "distance"))
            if topic not in watches
        ]
    streams = [_inspect(t, watches.get(t.role)) for t in topics]
    return Inspection(streams, [*faults, *_faults(watches)])


_NO_INDEX = (
    "it has no index: its recording was ended hard, or the disk was full, so the last moments may "
    "be missing; 'omsm inspect --repair' makes a copy with one"
)


def _faults(watches: dict[str, StreamWatch]) -> Iterator[str]:
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
