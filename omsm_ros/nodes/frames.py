"""Where the frames stand to each other with every axis at zero, on ``/tf_static``.

The machine's frame has its origin where the probe finds a surface at distance zero. The probe
stands there and looks along its beam; the workpiece's origin lies on the spindle's axis.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from typing import Any

from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3
from rclpy.node import Node
from std_msgs.msg import Header

from omsm_ros.core.machine.kinematics import Geometry, beam_quaternion
from omsm_ros.nodes import topics


def tell_frames(node: Node, undo: ExitStack, geometry: Geometry, names: Mapping[str, Any]) -> None:
    """Publish machine → probe and machine → workpiece, latched.

    names: of the frames, machine_frame, probe_frame, workpiece_frame
    """
    try:
        from tf2_msgs.msg import TFMessage
    except ImportError:  # it is in every distribution, not in the wheels
        node.get_logger().info("tf2_msgs is not installed: no transforms are published")
        return
    header = Header(stamp=node.get_clock().now().to_msg(), frame_id=names["machine_frame"])
    x, y, z, w = beam_quaternion(geometry)
    probe = Transform(rotation=Quaternion(x=x, y=y, z=z, w=w))
    centre = Vector3(x=geometry.centre_x, y=geometry.centre_y)
    placed = {"probe_frame": probe, "workpiece_frame": Transform(translation=centre)}
    publisher = topics.publish_on(node, undo, TFMessage, "/tf_static", topics.LATCHED_QOS)
    publisher.publish(
        TFMessage(
            transforms=[
                TransformStamped(header=header, child_frame_id=names[name], transform=transform)
                for name, transform in placed.items()
            ]
        )
    )
