"""How every node of this package starts, takes what comes from outside, reports, and ends.

No message, request or parameter ends a node: what is wrong is refused with its reason, and a
defect of ours is logged, counted in the diagnostics, and survived.
"""

from __future__ import annotations

import os
import sys
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.exceptions import InvalidParameterTypeException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from omsm_ros.errors import DEBUG, ConfigurationError, OmsmError, defect
from omsm_ros.quantities import Quantity
from omsm_ros.storage import strict_json

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

_COMPLAINT_PERIOD_S = 5.0
_BAD_INPUT, _DEFECT = 2, 70  # as of the commands
_defects: Counter[str] = Counter()


def run(make_node: Callable[[], Node]) -> None:
    """Build a node and spin it until SIGINT or SIGTERM.

    Exits with one line on stderr if it cannot start: 2 for bad input, 70 for a defect of ours.
    """
    rclpy.init()
    try:
        node = make_node()
    except OmsmError as err:
        rclpy.try_shutdown()
        print(f"{type(err).__name__}: {' '.join(str(err).split())}", file=sys.stderr)
        sys.exit(_BAD_INPUT)
    except Exception as err:
        rclpy.try_shutdown()
        if os.environ.get(DEBUG):
            raise
        print(defect(err), file=sys.stderr)
        sys.exit(_DEFECT)
    try:
        _spin(node)
    finally:
        close = getattr(node, "close", None)
        if close is not None:
            close()
        node.destroy_node()
        rclpy.try_shutdown()


def _spin(node: Node) -> None:
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while rclpy.ok():
        try:
            executor.spin_once()
        except (KeyboardInterrupt, ExternalShutdownException):
            return  # asked to end
        except Exception as err:
            _survive(node, err)


def _survive(node: Node, err: Exception) -> str:
    """Count and log a defect of ours; return the line that says what to report."""
    if os.environ.get(DEBUG):
        raise err
    _defects[node.get_fully_qualified_name()] += 1
    line = defect(err)
    node.get_logger().error(line, throttle_duration_sec=_COMPLAINT_PERIOD_S)
    return line


# ------------------------------------------------------------------------------- doors


def parameter(
    node: Node, name: str, default: Any, description: str, quantity: Quantity | None = None
) -> Any:
    """Declare a parameter, read once at the start, and return its value.

    ConfigurationError if its type is wrong, or its value not plausible for ``quantity``.
    """
    from rcl_interfaces.msg import ParameterDescriptor

    told = description if quantity is None else f"{description}; {quantity.range_text}"
    # Read-only: to set it later would change nothing, and so must not succeed.
    descriptor = ParameterDescriptor(description=told, read_only=True)
    called = f"{node.get_name()}: parameter {name!r} ({description})"
    try:
        value = node.declare_parameter(name, default, descriptor).value
    except InvalidParameterTypeException as err:
        raise ConfigurationError(f"{called} has the wrong type: {err}") from err
    return value if quantity is None else quantity.checked(value, ConfigurationError, called)


def settings_of(text: str) -> dict[str, object]:
    """Settings from a parameter that holds a JSON object; ConfigurationError if it does not."""
    return strict_json.object_of(text, ConfigurationError, "parameter 'settings'")


def serve(node: Node, kind: Any, name: str, answer: Callable[[Any, Any], None]) -> None:
    """Offer the service ``name``; ``answer`` fills in the response from the request.

    Whatever it raises is answered as not successful (or not safe), with the reason.
    """

    def callback(request: Any, response: Any) -> Any:
        try:
            answer(request, response)
        except OmsmError as err:
            _refuse(response, str(err))
        except Exception as err:
            _refuse(response, _survive(node, err))
        return response

    node.create_service(kind, name, callback)


def _refuse(response: Any, reason: str) -> None:
    for name in ("success", "safe"):
        if hasattr(response, name):
            setattr(response, name, False)
    response.message = reason


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
        """Publish now; a node with a defect says so until it is started again."""
        level, message, values = self._report()
        if defects := _defects[self._node.get_fully_qualified_name()]:
            level, message = ERROR, f"{defects} defects of ours, see the log; {message}"
            values = {**values, "defects": defects}
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
