"""``recorder``: writes the cell's topics to an ``.mcap`` file until it is ended."""

from __future__ import annotations

from functools import partial

from omsm_msgs.msg import AxisBlock, Calibration, DistanceBlock
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from omsm_ros.errors import ConfigurationError
from omsm_ros.nodes.running import (
    LATCHED_QOS,
    NAMESPACE,
    OK,
    SAMPLES_QOS,
    Diagnostics,
    parameter,
    run,
)
from omsm_ros.storage import bags

_TOPICS = {
    bags.AXES_TOPIC: (AxisBlock, SAMPLES_QOS),
    bags.DISTANCE_TOPIC: (DistanceBlock, SAMPLES_QOS),
    bags.CALIBRATION_TOPIC: (Calibration, LATCHED_QOS),
    bags.POINTS_TOPIC: (PointCloud2, SAMPLES_QOS),
}


class RecorderNode(Node):
    """Takes messages as they are on the wire; the file appears, complete, when the node ends."""

    def __init__(self) -> None:
        super().__init__("recorder", namespace=NAMESPACE)
        path = parameter(self, "path", "", "the .mcap file to write")
        if not path.endswith(".mcap"):
            raise ConfigurationError(f"path {path!r} must name an .mcap file")
        self._counts = dict.fromkeys(_TOPICS, 0)
        self._bag = bags.BagWriter(path, tuple(_TOPICS))
        self._bag.__enter__()
        for topic, (kind, qos) in _TOPICS.items():
            self.create_subscription(kind, topic, partial(self._on_message, topic), qos, raw=True)
        self._diagnostics = Diagnostics(self, self._report, hardware_id=path)

    def _on_message(self, topic: str, cdr: bytes) -> None:
        self._bag.write_raw(topic, self.get_clock().now().nanoseconds, cdr)
        self._counts[topic] += 1

    def _report(self) -> tuple[bytes, str, dict[str, object]]:
        return OK, "recording", self._counts

    def close(self) -> None:
        """Complete the file."""
        self._bag.__exit__(None, None, None)


def main() -> None:
    """Entry point of ``ros2 run omsm_ros recorder``."""
    run(RecorderNode)


if __name__ == "__main__":
    main()
