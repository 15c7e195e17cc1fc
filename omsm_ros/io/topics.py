"""Names and types of the topics of a cell.

Several cells may be on one network and in one bag; each has its own namespace.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

AXES_TOPIC = "/omsm/axes"
DISTANCE_TOPIC = "/omsm/confocal"
REFERENCE_TOPIC = "/omsm/reference"
ACCELERATION_TOPIC = "/omsm/acceleration"
CALIBRATION_TOPIC = "/omsm/calibration"
POINTS_TOPIC = "/omsm/points"
PROBE_TOPIC = "/omsm/probe_settings"
VIBRATION_TOPIC = "/omsm/vibration"
TEMPERATURE_TOPIC = "/omsm/temperature"

TOPIC_TYPES = {
    AXES_TOPIC: "omsm_msgs/msg/AxisBlock",
    DISTANCE_TOPIC: "omsm_msgs/msg/DistanceBlock",
    REFERENCE_TOPIC: "omsm_msgs/msg/DistanceBlock",
    ACCELERATION_TOPIC: "omsm_msgs/msg/AccelerationBlock",
    CALIBRATION_TOPIC: "omsm_msgs/msg/Calibration",
    POINTS_TOPIC: "sensor_msgs/msg/PointCloud2",
    PROBE_TOPIC: "std_msgs/msg/String",
    VIBRATION_TOPIC: "std_msgs/msg/String",
    TEMPERATURE_TOPIC: "sensor_msgs/msg/Temperature",
}

LATCHED_TOPICS = frozenset({CALIBRATION_TOPIC, PROBE_TOPIC})
"""Topics whose last message is also sent to later subscribers."""

SAMPLES_DEPTH, LATCHED_DEPTH = 2000, 1
"""Messages that a publisher keeps: blocks of several seconds; the last one."""


@dataclass(frozen=True)
class CellBag:
    """A bag, and the names of a cell's topics in it.

    namespace: of the cell, such as "/cell2"; empty = the only one
    topics: contract's name → name in the bag, where they differ
    """

    path: Path
    namespace: str = ""
    topics: Mapping[str, str] = field(default_factory=dict)

    def __str__(self) -> str:
        return str(self.path)

    @property
    def name(self) -> str:
        """Return the name of the file or folder."""
        return self.path.name

    def names(self, held: Mapping[str, str]) -> dict[str, str]:
        """Return contract's name → name in a bag with topics ``held`` (name → type).

        Without a statement, the contract's name is preferred, then the only topic of that type
        with the same last part.
        """
        return {topic: self._name(topic, held) for topic in TOPIC_TYPES}

    def _name(self, topic: str, held: Mapping[str, str]) -> str:
        last = relative(topic)
        if stated := self.topics.get(topic):
            return stated
        if self.namespace:
            return f"/{self.namespace.strip('/')}/{last}"
        alike = [
            n for n, kind in held.items() if relative(n) == last and kind == TOPIC_TYPES[topic]
        ]
        return alike[0] if topic not in held and len(alike) == 1 else topic


AnyBag: TypeAlias = "Path | str | CellBag"


def relative(topic: str) -> str:
    """Return the name of a topic within its namespace."""
    return topic.rpartition("/")[2]
