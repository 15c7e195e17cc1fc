"""``confocal_driver``: reads the six-channel stream and publishes axes and distance."""

from __future__ import annotations

import threading
from dataclasses import asdict

from omsm_msgs.msg import AxisBlock, DistanceBlock
from rclpy.node import Node

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
from omsm_ros.protocols.generic_stream import AXES, AxisScaling, ProbeScaling, StreamScaling
from omsm_ros.storage import conversions

_READ_TIMEOUT_S = 0.05
_RECONNECT_S = 0.5
_FAULTS = ("bad", "lost", "restarts", "period_warnings", "unknown_status")


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
            scaling=self._scaling(),
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

    def _scaling(self) -> StreamScaling:
        usual = StreamScaling()
        axes = {
            name: AxisScaling(
                parameter(self, f"{name}.counts_per_unit", axis.counts_per_unit, "per m or rad"),
                sign=parameter(self, f"{name}.sign", axis.sign, "+1 or -1"),
                offset=parameter(self, f"{name}.offset", axis.offset, "at zero counts [m, rad]"),
                wrap=parameter(
                    self, f"{name}.wrap", axis.wrap, "counts at which it wraps; 0 = never"
                ),
            )
            for name in AXES
            for axis in [getattr(usual, name)]
        }
        probe = ProbeScaling(
            full_scale=parameter(
                self, "probe.full_scale", usual.probe.full_scale, "measuring range [m]"
            ),
            polarity=parameter(
                self, "probe.polarity", usual.probe.polarity, "+1: falls as z rises; -1: reversed"
            ),
        )
        return StreamScaling(**axes, probe=probe)

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
        seen = [key for key in statistics if key.startswith(_FAULTS) and statistics[key]]
        return (WARN, f"seen: {', '.join(seen)}", statistics) if seen else (OK, "", statistics)

    def close(self) -> None:
        """End the reading thread."""
        self._stop.set()
        self._reader.join(timeout=5.0)


def main() -> None:
    """Entry point of ``ros2 run omsm_ros confocal_driver``."""
    run(ConfocalDriverNode)


if __name__ == "__main__":
    main()
