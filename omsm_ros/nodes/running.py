"""How every node of this package starts, reports on itself, and ends."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.exceptions import InvalidParameterTypeException
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from omsm_ros.errors import ConfigurationError, OmsmError

NAMESPACE = "omsm"

SAMPLES_QOS = QoSProfile(
    # Reliable, and deep enough for seconds of blocks: a loss must be a fault, not a policy.
    reliability=ReliabilityPolicy.RELIABLE,
    history=HistoryPolicy.KEEP_LAST,
    depth=2000,
)
LATCHED_QOS = QoSProfile(
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
)

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


def run(make_node: Callable[[], Node]) -> None:
    """Build a node and spin it until SIGINT or SIGTERM; exit 2 with one line if it cannot start."""
    rclpy.init()
    try:
        node = make_node()
    except OmsmError as err:
        rclpy.try_shutdown()
        print(f"{type(err).__name__}: {err}", file=sys.stderr)
        sys.exit(2)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass  # asked to end
    finally:
        close = getattr(node, "close", None)
        if close is not None:
            close()
        node.destroy_node()
        rclpy.try_shutdown()


def parameter(node: Node, name: str, default: Any, description: str) -> Any:
    """Declare a parameter and return its value; ConfigurationError if its type is wrong."""
    from rcl_interfaces.msg import ParameterDescriptor

    try:
        descriptor = ParameterDescriptor(description=description)
        return node.declare_parameter(name, default, descriptor).value
    except InvalidParameterTypeException as err:
        raise ConfigurationError(
            f"{node.get_name()}: parameter {name!r} ({description}) has the wrong type: {err}"
        ) from err


def settings_of(text: str) -> dict[str, object]:
    """Settings from a parameter that holds a JSON object; ConfigurationError if it does not."""
    try:
        settings = json.loads(text)
    except ValueError as err:
        raise ConfigurationError(f"settings {text!r} is not JSON: {err}") from err
    if not isinstance(settings, dict):
        raise ConfigurationError(f"settings {text!r} is not a JSON object")
    return settings


class Diagnostics:
    """Publishes one status of a node on ``/diagnostics`` every ``period`` seconds.

    report: returns level, message and values; called from the node's executor.
    """

    def __init__(
        self,
        node: Node,
        report: Callable[[], tuple[bytes, str, Mapping[str, object]]],
        *,
        hardware_id: str = "",
        period: float = 0.5,
    ) -> None:
        self._node = node
        self._report = report
        self._hardware_id = hardware_id
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._timer = node.create_timer(period, self.publish)

    def publish(self) -> None:
        """Publish now."""
        level, message, values = self._report()
        status = DiagnosticStatus(
            level=level,
            name=self._node.get_fully_qualified_name(),
            message=message,
            hardware_id=self._hardware_id,
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array)
