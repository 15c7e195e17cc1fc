"""Publishes and receives the calibration in force on the topic ``calibration``.

Its stamp is the time since which it is in force. Each node that uses calibrations subscribes, and
publishes a newer one again. So every latched message holds the newest calibration, and a node can
be restarted without losing it.
"""

from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

from omsm_msgs.msg import Calibration as CalibrationMessage
from omsm_msgs.msg import CertificateSummary
from rclpy.node import Node

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.errors import OmsmError, one_line
from omsm_ros.io import message_mapping
from omsm_ros.io.figure_messages import certificate_message
from omsm_ros.nodes import topics

TOPIC = "calibration"
_COMPLAINT_PERIOD_S = 5.0
# Bounds the messages of two nodes that refuse each other's calibration.
_REPEAT_NS = 5 * 10**9
# The clocks of a cell's computers agree to much less.
_AHEAD_NS = 10 * 10**9


class CalibrationTopic:
    """Publishes the calibrations of its node, and passes those of other nodes to it.

    calibration, since_ns: in force, and since when [ns]; None before the first one
    refused: why the last one received was refused; empty if it was accepted
    """

    def __init__(
        self, node: Node, undo: ExitStack, take: Callable[[Calibration, int], None], listens: bool
    ) -> None:
        """take: called with each newer calibration received; raises OmsmError to refuse it."""
        self.calibration: Calibration | None = None
        self.since_ns = 0
        self.refused = ""
        self._node, self._take = node, take
        self._repeated_ns = 0
        self._published: tuple[str, int] | None = None  # id and stamp of the last message
        self._messages = message_mapping.ros_messages()
        # Several nodes may publish here, so no check of the number of publishers is made.
        self._publisher = topics.publish_on(
            node, undo, CalibrationMessage, TOPIC, topics.LATCHED_QOS
        )
        self._summary = topics.publish_on(
            node, undo, CertificateSummary, "certificate", topics.LATCHED_QOS
        )
        if listens:
            topics.listen(
                node, undo, CalibrationMessage, TOPIC, self._on_message, topics.LATCHED_BY_MANY_QOS
            )

    @property
    def id(self) -> str:
        """Return the id of the calibration in force; empty before the first one."""
        return self.calibration.id if self.calibration else ""

    def decided(self) -> int:
        """Return the stamp of a calibration put in force now: later than all before [ns]."""
        return max(self._now_ns(), self.since_ns + 1)

    def announce(self, calibration: Calibration, since_ns: int) -> None:
        """Publish that ``calibration`` is in force since ``since_ns`` [ns].

        A stamp ahead of this node's clock, as of a file dated tomorrow or under simulated time,
        is replaced by now, as other nodes do; else all would answer each other without end.
        """
        since_ns = self._plausible(since_ns)
        self.calibration, self.since_ns, self.refused = calibration, since_ns, ""
        self._published = calibration.id, since_ns
        message = message_mapping.calibration_message(self._messages, calibration, since_ns)
        self._publisher.publish(message)
        self._summary.publish(certificate_message(self._messages, calibration))

    def _on_message(self, message: Any, _: topics.MessageInfo) -> None:
        stamp_ns = message_mapping.stamp_of(message)
        if (message.id, stamp_ns) == self._published:  # its own message
            return
        since_ns = self._plausible(stamp_ns)
        known = self.calibration
        if known is not None and since_ns <= self.since_ns:
            return
        if known is not None and message.id == known.id:
            self.announce(known, since_ns)
            return
        try:
            heard = message_mapping.calibration(message)
            self._take(heard, since_ns)
        except OmsmError as err:
            self.refused = one_line(err)
            self._node.get_logger().error(
                f"calibration refused: {self.refused}", throttle_duration_sec=_COMPLAINT_PERIOD_S
            )
            now = self.decided()
            if self.calibration is not None and now - self._repeated_ns > _REPEAT_NS:
                self._repeated_ns, refused = now, self.refused
                self.announce(self.calibration, now)
                self.refused = refused
            return
        self.announce(heard, since_ns)

    def _plausible(self, stamp_ns: int) -> int:
        """Return the stamp; now for a message without one, or with one ahead of this clock."""
        now = self._now_ns()
        return stamp_ns if 0 < stamp_ns < now + _AHEAD_NS else max(now, self.since_ns + 1)

    def _now_ns(self) -> int:
        return int(self._node.get_clock().now().nanoseconds)
