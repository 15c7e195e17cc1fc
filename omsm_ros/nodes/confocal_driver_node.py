"""``confocal_driver``: reads a probe, with its encoders, and publishes distance and axes."""

from __future__ import annotations

import threading
from collections.abc import Sequence

from omsm_msgs.msg import AxisBlock, DistanceBlock
from rclpy.node import Node

from omsm_ros.devices.blocks import BlockPair
from omsm_ros.devices.factory import PARAMETERS, make_device
from omsm_ros.devices.reader import DeviceReader
from omsm_ros.nodes.running import (
    ERROR,
    NAMESPACE,
    OK,
    SAMPLES_QOS,
    WARN,
    Diagnostics,
    parameter,
    run,
)
from omsm_ros.storage import conversions

_FAULTS = ("bad", "lost", "losses", "restarts", "spoilt", "period_warnings", "unknown_status")


class ConfocalDriverNode(Node):
    """A thread reads the device; whatever happens on the wire, the node stays."""

    def __init__(self) -> None:
        super().__init__("confocal_driver", namespace=NAMESPACE)
        values = {p.name: parameter(self, p.name, p.default, p.description) for p in PARAMETERS}
        self._messages = conversions.ros_messages()
        self._axes = self.create_publisher(AxisBlock, "axes", SAMPLES_QOS)
        self._distance = self.create_publisher(DistanceBlock, "confocal", SAMPLES_QOS)
        self._device = make_device(values, lambda: self.get_clock().now().nanoseconds)
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
            if axes is not None:
                self._axes.publish(conversions.axis_message(self._messages, axes))
            if distance is not None:
                self._distance.publish(conversions.distance_message(self._messages, distance))

    def _report(self) -> tuple[bytes, str, dict[str, object]]:
        statistics = self._device.identity | {"state": self._reader.state.value}
        statistics |= self._device.counts() | {"connections": self._reader.connections}
        for name, publisher in (("axes", self._axes), ("confocal", self._distance)):
            statistics[f"{name}_subscribers"] = publisher.get_subscription_count()
        if self._reader.trouble:
            return ERROR, self._reader.trouble, statistics
        seen = [key for key in statistics if key.startswith(_FAULTS) and statistics[key]]
        return (WARN, f"seen: {', '.join(seen)}", statistics) if seen else (OK, "", statistics)

    def close(self) -> None:
        """End the reading thread."""
        self._stop.set()
        self._thread.join(timeout=5.0)


def main() -> None:
    """Entry point of ``ros2 run omsm_ros confocal_driver``."""
    run(ConfocalDriverNode)


if __name__ == "__main__":
    main()
