"""The topics of a cell: their names, types, and whether they are latched.

Several cells may be on one network, and in one bag: each has a namespace of its own.
"""

from __future__ import annotations

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
"""Who comes later gets the last message too."""

SAMPLES_DEPTH, LATCHED_DEPTH = 2000, 1
"""Messages that a publisher keeps: seconds of blocks; the last one."""


@dataclass(frozen=True)
class CellBag:
    """A bag, and which topics of it are the cell's.

    namespace: of the cell, as "/cell2"; empty finds it where there is only one
    topics: what a topic of the contract is called there, for those that are called otherwise
    """

    path: Path
    namespace: str = ""
    topics: Mapping[str, str] = field(default_factory=dict)

    def __str__(self) -> str:
        return str(self.path)

    @property
    def name(self) -> str:
        """Of the file or folder."""
        return self.path.name

    def names(self, held: Mapping[str, str]) -> dict[str, str]:
        """Return topic of the contract → its name in a bag that holds names → types ``held``.

        Where nothing is stated, the contract's name goes first, and then the only topic of that
        type which ends alike.
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
