"""The topics of a cell: their names, types, and whether they are latched."""

from __future__ import annotations

AXES_TOPIC = "/omsm/axes"
DISTANCE_TOPIC = "/omsm/confocal"
REFERENCE_TOPIC = "/omsm/reference"
ACCELERATION_TOPIC = "/omsm/acceleration"
CALIBRATION_TOPIC = "/omsm/calibration"
POINTS_TOPIC = "/omsm/points"

TOPIC_TYPES = {
    AXES_TOPIC: "omsm_msgs/msg/AxisBlock",
    DISTANCE_TOPIC: "omsm_msgs/msg/DistanceBlock",
    REFERENCE_TOPIC: "omsm_msgs/msg/DistanceBlock",
    ACCELERATION_TOPIC: "omsm_msgs/msg/AccelerationBlock",
    CALIBRATION_TOPIC: "omsm_msgs/msg/Calibration",
    POINTS_TOPIC: "sensor_msgs/msg/PointCloud2",
}

LATCHED_TOPICS = frozenset({CALIBRATION_TOPIC})
"""Who comes later is told the last message too."""

SAMPLES_DEPTH, LATCHED_DEPTH = 2000, 1
"""Messages that a publisher keeps: seconds of blocks; the last one."""
