"""``recorder``: writes the cell's topics to an ``.mcap`` file until it is ended."""

from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

from rclpy.subscription import Subscription

from omsm_ros.errors import BagError, ConfigurationError
from omsm_ros.io import topics
from omsm_ros.io.bag_writer import BagWriter, next_free
from omsm_ros.nodes.diagnostics import ERROR, WARN, StateReport
from omsm_ros.nodes.managed import ManagedNode
from omsm_ros.nodes.running import run
from omsm_ros.nodes.topics import (
    LATCHED_QOS,
    SAMPLES_QOS,
    MessageInfo,
    every,
    listen,
    recorded_type,
    take_rest,
)
from omsm_ros.quantities import Parameter

PARAMETERS = (
    Parameter("path", "", "the .mcap file to write; it must not exist yet", required=True),
    Parameter("numbered", False, "if it exists, write scan.2.mcap, scan.3.mcap, … instead"),
)
_FLUSH_PERIOD_S = 0.5
# Longer than the corrector waits for its last samples, whose points come after that.
_LOOKS = 100


class RecorderNode(ManagedNode):
    """Records serialised messages; all that are older than a second are on the disk."""

    name, parameters = "recorder", PARAMETERS
    _bag: Any = None  # the writer of the bag, while active

    def hardware_id(self) -> str:
        """Return the bag's path."""
        return str(self._bag.path) if self._bag else ""

    def configure(self, undo: ExitStack) -> None:
        """Open the bag."""
        path = Path(self.values["path"])
        if path.suffix != ".mcap":
            raise ConfigurationError(f"path {str(path)!r} must name an .mcap file")
        if self.values["numbered"]:
            path = next_free(path)
        self._names = {t: self.resolve_topic_name(t.rpartition("/")[2]) for t in topics.TOPIC_TYPES}
        self._counts = dict.fromkeys(self._names.values(), 0)
        self._lost = dict.fromkeys(topics.TOPIC_TYPES, 0)
        self._last_stamp = 0
        self._heard: dict[str, Subscription] = {}
        self._bag = BagWriter(path, tuple(topics.TOPIC_TYPES), self._names)
        self._bag.__enter__()
        undo.callback(self._complete)

    def activate(self, undo: ExitStack) -> None:
        """Begin to record; at the end, take the messages published before it."""
        for topic in topics.TOPIC_TYPES:
            qos = LATCHED_QOS if topic in topics.LATCHED_TOPICS else SAMPLES_QOS
            self._heard[topic] = listen(
                self,
                undo,
                recorded_type(topic),
                self._names[topic],
                partial(self._take, topic),
                qos,
                raw=True,
                lost=partial(self._lost.__setitem__, topic),
            )
        every(self, undo, _FLUSH_PERIOD_S, partial(self._written, self._bag.flush))
        undo.callback(self._heard.clear)
        undo.callback(self._take_rest)

    def _take(self, topic: str, cdr: bytes, info: MessageInfo) -> None:
        # A bag without an index is read in the order of writing, which must be that of the
        # stamps; the clock of the computer may be set back.
        self._last_stamp = max(self._last_stamp, self.get_clock().now().nanoseconds)
        write = partial(self._bag.write_raw, topic, self._last_stamp, cdr, info["source_timestamp"])
        if self._written(write):
            self._counts[self._names[topic]] += 1

    def _written(self, write: Callable[[], object]) -> bool:
        if self.fatal is None:
            try:
                write()
            except BagError as err:
                self.fatal = err  # no further message can be recorded
                self.get_logger().error(f"{type(err).__name__}: {err}")
                self.diagnostics.publish()
        return self.fatal is None

    def _complete(self) -> None:
        try:
            self._bag.__exit__(None, None, None)
        except BagError as err:
            self.fatal = self.fatal or err
            self.get_logger().error(f"{type(err).__name__}: {err}")

    def _take_rest(self) -> None:
        if not take_rest([(s, partial(self._take, t)) for t, s in self._heard.items()], _LOOKS):
            self.get_logger().warning("the last messages were not recorded: too many waited")

    def report(self) -> StateReport:
        """Return the messages recorded and lost."""
        lost = sum(self._lost.values())
        publishers = {s.topic_name: s.get_publisher_count() for s in self._heard.values()}
        report = StateReport("recording", {**self._counts, "lost": lost})
        report.values |= {f"publishers_of_{name}": n for name, n in publishers.items()}
        if self.fatal is not None:
            report.add(ERROR, str(self.fatal))
        if lost:
            report.add(WARN, f"{lost} messages were lost before recording")
        if self.active and not any(publishers.values()):
            report.add(WARN, "recording, but no node publishes a recorded topic")
        return report


main = partial(run, RecorderNode)
"""``ros2 run omsm_ros recorder``; exit code 2 without space on the disk."""
