"""``recorder``: writes the cell's topics to an ``.mcap`` file until it is ended."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from omsm_msgs.msg import AxisBlock, Calibration, DistanceBlock
from rclpy.event_handler import QoSMessageLostInfo, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.subscription import Subscription
from sensor_msgs.msg import PointCloud2

from omsm_ros.errors import BagError, ConfigurationError
from omsm_ros.nodes.running import (
    ERROR,
    LATCHED_QOS,
    NAMESPACE,
    OK,
    SAMPLES_QOS,
    WARN,
    Diagnostics,
    parameter,
    run,
)
from omsm_ros.storage.recording import topics
from omsm_ros.storage.recording.bag_writer import BagWriter

_TOPICS = {
    topics.AXES_TOPIC: AxisBlock,
    topics.DISTANCE_TOPIC: DistanceBlock,
    topics.REFERENCE_TOPIC: DistanceBlock,
    topics.CALIBRATION_TOPIC: Calibration,
    topics.POINTS_TOPIC: PointCloud2,
}

_FLUSH_PERIOD_S = 0.5
_ON_ITS_WAY_S = 0.2  # a hundred times what a message takes on one machine
_LONGEST_S = 2.0  # of publishers that are not ended; a launch waits for five


class RecorderNode(Node):
    """Takes messages as they are on the wire; what is older than a second is on the disk."""

    def __init__(self) -> None:
        super().__init__("recorder", namespace=NAMESPACE)
        path = parameter(self, "path", "", "the .mcap file to write; it must not exist yet")
        if not path.endswith(".mcap"):
            raise ConfigurationError(f"path {path!r} must name an .mcap file")
        names = {t: self.resolve_topic_name(t.rpartition("/")[2]) for t in _TOPICS}
        self._counts = dict.fromkeys(names.values(), 0)
        self._lost = self._last_stamp = 0
        self._failure: BagError | None = None
        self._bag = BagWriter(path, tuple(_TOPICS), names)
        self._bag.__enter__()
        self._subscribed = {t: self._subscribe(t, kind, names[t]) for t, kind in _TOPICS.items()}
        self.create_timer(_FLUSH_PERIOD_S, partial(self._attempt, self._bag.flush))
        self._diagnostics = Diagnostics(self, self._report, hardware_id=path)

    def _subscribe(self, topic: str, kind: Any, name: str) -> Subscription:
        def take(cdr: bytes, info: dict[str, int]) -> None:
            if self._write(topic, cdr, info["source_timestamp"]):
                self._counts[name] += 1

        latched = topic in topics.LATCHED_TOPICS
        events = SubscriptionEventCallbacks(message_lost=self._on_lost)
        return self.create_subscription(
            kind, name, take, LATCHED_QOS if latched else SAMPLES_QOS,
            event_callbacks=events, raw=True,
        )  # fmt: skip

    def _on_lost(self, event: QoSMessageLostInfo) -> None:
        self._lost = event.total_count

    # ------------------------------------------------------------------------- writing

    def _write(self, topic: str, cdr: bytes, published_ns: int) -> bool:
        # A bag without an index is read in its order, which must be that of its stamps; the
        # clock of the machine may be set back.
        self._last_stamp = max(self._last_stamp, self.get_clock().now().nanoseconds)
        return self._attempt(
            partial(self._bag.write_raw, topic, self._last_stamp, cdr, published_ns)
        )

    def _attempt(self, write: Callable[[], None]) -> bool:
        try:
            write()
        except BagError as err:
            self._failure = err
            self.get_logger().error(str(err))
            self._diagnostics.publish()
            self.context.try_shutdown()  # there is nothing left to do
        return self._failure is None

    def close(self) -> None:
        """Take what was published before, and complete the file; BagError if there is no room."""
        self._take_what_is_on_its_way()
        try:
            self._bag.__exit__(None, None, None)
        finally:
            if self._failure is not None:
                raise self._failure

    def _take_what_is_on_its_way(self) -> None:
        begin = quiet_since = time.monotonic()
        while time.monotonic() < min(quiet_since + _ON_ITS_WAY_S, begin + _LONGEST_S):
            if sum(self._take_waiting(each) for each in self._subscribed.values()):
                quiet_since = time.monotonic()
            time.sleep(_ON_ITS_WAY_S / 20)

    def _take_waiting(self, subscription: Subscription) -> int:
        handle, count = subscription.handle, 0
        with handle:
            while (taken := handle.take_message(subscription.msg_type, True)) is not None:
                subscription.callback(*taken)
                count += 1
        return count

    # --------------------------------------------------------------------- diagnostics

    def _report(self) -> tuple[bytes, str, dict[str, object]]:
        heard = {s.topic_name: s.get_publisher_count() for s in self._subscribed.values()}
        values = {**self._counts, "lost": self._lost}
        values |= {f"publishers_of_{name}": count for name, count in heard.items()}
        if self._failure is not None:
            return ERROR, str(self._failure), values
        if self._lost:
            return WARN, f"{self._lost} messages were lost on their way here", values
        if not any(heard.values()):
            return WARN, "recording, but nobody publishes what is recorded", values
        return OK, "recording", values


def _end_between_callbacks() -> None:
    """Have SIGINT, SIGTERM and SIGHUP end the spinning, and never interrupt what is being written.

    The handlers of rclpy end the spinning and then call these.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: None)
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # as below nohup
        signal.signal(signal.SIGHUP, lambda *_: signal.raise_signal(signal.SIGINT))


def main() -> None:
    """Entry point of ``ros2 run omsm_ros recorder``; exit code 2 if the disk took no more."""
    _end_between_callbacks()
    try:
        run(RecorderNode)
    except BagError as err:
        print(f"{type(err).__name__}: {err}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
