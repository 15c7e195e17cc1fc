"""``confocal_driver``: reads the six-channel stream and publishes axes and distance."""

from __future__ import annotations

import threading
from dataclasses import asdict

from omsm_msgs.msg import AxisBlock, DistanceBlock
from rclpy.node import Node

from omsm_ros import conversions
from omsm_ros.devices.generic_stream import GenericStreamDevice, StreamSettings
from omsm_ros.devices.transport import transport_for
from omsm_ros.errors import DeviceError
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

_READ_TIMEOUT_S = 0.05
_RECONNECT_S = 0.5


class ConfocalDriverNode(Node):
    """A thread reads the device; whatever happens on the wire, the node stays."""

    def __init__(self) -> None:
        super().__init__("confocal_driver", namespace=NAMESPACE)
        address = parameter(
            self, "port", "/tmp/omsm_cell", "serial port, or tcp://host:port, of the stream"
        )
        baud_rate = parameter(self, "baud_rate", 921_600, "of a serial port [bit/s]")
        settings = StreamSettings(
            sample_period=parameter(self, "sample_period", 1e-3, "of the trigger [s]"),
            block_size=parameter(self, "block_size", 100, "samples in a message"),
        )
        self._messages = conversions.ros_messages()
        self._axes = self.create_publisher(AxisBlock, "axes", SAMPLES_QOS)
        self._distance = self.create_publisher(DistanceBlock, "confocal", SAMPLES_QOS)
        self._device = GenericStreamDevice(
            transport_for(address, baud_rate), settings, lambda: self.get_clock().now().nanoseconds
        )
        self._trouble = "not connected yet"
        self._connections = 0
        self._stop = threading.Event()
        self._diagnostics = Diagnostics(self, self._report, hardware_id=address)
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        while not self._stop.is_set():
            try:
                self._device.open()
                self._recovered()
                while not self._stop.is_set():
                    self._publish(self._device.poll(_READ_TIMEOUT_S))
            except DeviceError as err:
                self._lost(err)
            self._publish(self._device.close())
            self._stop.wait(_RECONNECT_S)

    def _recovered(self) -> None:
        self._trouble = ""
        self._connections += 1
        self.get_logger().info("connected")

    def _lost(self, err: DeviceError) -> None:
        if str(err) != self._trouble:
            self._trouble = str(err)
            self.get_logger().warning(f"{err}; trying again")

    def _publish(self, pairs: list) -> None:  # type: ignore[type-arg]
        if not self.context.ok():
            return
        for axes, distance in pairs:
            self._axes.publish(conversions.axis_message(self._messages, axes))
            self._distance.publish(conversions.distance_message(self._messages, distance))

    def _report(self) -> tuple[bytes, str, dict[str, object]]:
        statistics = asdict(self._device.statistics) | {"connections": self._connections}
        for name, publisher in (("axes", self._axes), ("confocal", self._distance)):
            statistics[f"{name}_subscribers"] = publisher.get_subscription_count()
        if self._trouble:
            return ERROR, self._trouble, statistics
        faults = [k for k, v in statistics.items() if k.startswith(("bad", "lost")) and v]
        return (WARN, f"seen: {', '.join(faults)}", statistics) if faults else (OK, "", statistics)

    def close(self) -> None:
        """End the reading thread."""
        self._stop.set()
        self._reader.join(timeout=5.0)


def main() -> None:
    """Entry point of ``ros2 run omsm_ros confocal_driver``."""
    run(ConfocalDriverNode)


if __name__ == "__main__":
    main()
