"""``accelerometer_driver``: samples a three-axis accelerometer and publishes its blocks."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from typing import Any

from omsm_msgs.msg import AccelerationBlock
from rclpy.publisher import Publisher

from omsm_ros.instruments.factory import ACCELEROMETER_PARAMETERS, make_accelerometer
from omsm_ros.io import message_mapping
from omsm_ros.nodes.driver import DriverNode
from omsm_ros.nodes.running import run
from omsm_ros.quantities import Parameter

TOPIC = "acceleration"


class AccelerometerDriverNode(DriverNode):
    """One of the accelerometers in ``docs/devices.md``."""

    def __init__(self) -> None:
        frame = Parameter("accelerometer_frame", "probe", "frame of the acceleration")
        super().__init__(
            "accelerometer_driver", (*ACCELEROMETER_PARAMETERS, frame), make_accelerometer
        )
        self._acceleration: Publisher | None = None

    def configure(self, undo: ExitStack) -> None:
        """Make the device, which nobody touches yet, and the topic."""
        super().configure(undo)
        self._acceleration = self.publish_on(undo, AccelerationBlock, TOPIC)

    def _publish(self, blocks: Sequence[Any]) -> None:
        if self._acceleration is None:
            return
        frame = self.values["accelerometer_frame"]
        for block in blocks:
            message = message_mapping.acceleration_message(self._messages, block, frame)
            self._acceleration.publish(message)

    def _both(self) -> list[tuple[str, Publisher]]:
        return [(TOPIC, self._acceleration)] if self._acceleration is not None else []


def main() -> None:
    """Run ``ros2 run omsm_ros accelerometer_driver``."""
    run(AccelerometerDriverNode)


if __name__ == "__main__":
    main()
