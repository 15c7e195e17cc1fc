"""What every driver node does: a thread reads the device, its blocks are published."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any

from omsm_msgs.msg import AxisBlock, DistanceBlock
from rclpy.node import Node

from omsm_ros.devices.blocks import BlockPair
from omsm_ros.devices.factory import Parameter
from omsm_ros.devices.reader import DeviceReader
from omsm_ros.devices.stream import StreamDevice
from omsm_ros.nodes.running import ERROR, NAMESPACE, OK, SAMPLES_QOS, WARN, Diagnostics, parameter
from omsm_ros.storage import conversions

_FAULTS = ("bad", "lost", "losses", "malformed", "restarts", "spoilt", "period_w", "unknown")


class DriverNode(Node):
    """Publishes a device's blocks; whatever happens on the wire, the node stays."""

    def __init__(
        self,
        name: str,
        parameters: Sequence[Parameter],
        make: Callable[[dict[str, Any], Callable[[], int]], StreamDevice],
        *,
        axes: str | None = None,
        distance: str | None = None,
    ) -> None:
        """axes, distance: topics of the blocks; None = it has none."""
        super().__init__(name, namespace=NAMESPACE)
        values = {p.name: parameter(self, p.name, p.default, p.description) for p in parameters}
        self._messages = conversions.ros_messages()
        self._axes = self.create_publisher(AxisBlock, axes, SAMPLES_QOS) if axes else None
        self._distance = (
            self.create_publisher(DistanceBlock, distance, SAMPLES_QOS) if distance else None
        )
        self._topics = {axes: self._axes, distance: self._distance}
        self._device = make(values, lambda: self.get_clock().now().nanoseconds)
        self._reader = DeviceReader(self._device, self._publish, self._note)
        self._stop = threading.Event()
        self._diagnostics = Diagnostics(self, self._report, hardware_id=values["port"])
        self._thread = threading.Thread(target=self._reader.run, args=(self._stop,), daemon=True)
        self._thread.start()

    def _note(self, text: str) -> None:
        self.get_logger().info(text)

    def _publish(self, blocks: Sequence[BlockPair]) -> None:
        if not self.context.ok():
            return
        for axes, distance in blocks:
            if axes is not None and self._axes is not None:
                self._axes.publish(conversions.axis_message(self._messages, axes))
            if distance is not None and self._distance is not None:
                self._distance.publish(conversions.distance_message(self._messages, distance))

    def _report(self) -> tuple[bytes, str, dict[str, object]]:
        statistics = self._device.identity | {"state": self._reader.state.value}
        statistics |= self._device.counts() | {"connections": self._reader.connections}
        for topic, publisher in self._topics.items():
            if publisher is not None:
                statistics[f"{topic}_subscribers"] = publisher.get_subscription_count()
        if self._reader.trouble:
            return ERROR, self._reader.trouble, statistics
        seen = [key for key in statistics if key.startswith(_FAULTS) and statistics[key]]
        return (WARN, f"seen: {', '.join(seen)}", statistics) if seen else (OK, "", statistics)

    def close(self) -> None:
        """End the reading thread."""
        self._stop.set()
        self._thread.join(timeout=5.0)
