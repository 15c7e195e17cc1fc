"""Publishers and subscriptions of the nodes, their quality of service, and timers."""

import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from copy import copy
from importlib import import_module
from typing import Any, TypeAlias

from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.exceptions import InvalidParameterTypeException
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions, QoSPolicyKind
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from omsm_ros import quantities
from omsm_ros.core.kinematics.kinematics import Geometry, beam_quaternion
from omsm_ros.errors import ConfigurationError
from omsm_ros.io import json_and_yaml
from omsm_ros.io.topics import LATCHED_DEPTH, SAMPLES_DEPTH, TOPIC_TYPES
from omsm_ros.quantities import Parameter

MessageInfo: TypeAlias = "dict[str, int]"

# Reliable, and deep enough for several seconds of blocks, so that a loss is a fault.
SAMPLES_QOS = QoSProfile(reliability=ReliabilityPolicy.RELIABLE, depth=SAMPLES_DEPTH)
# By many: for subscribers of several latched publishers, the last to arrive may not be the newest.
LATCHED_QOS, LATCHED_BY_MANY_QOS = (
    QoSProfile(
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
        depth=depth,
    )
    for depth in (LATCHED_DEPTH, 20)
)
# Requests wait while a node computes; the usual depth of ten overflows soon.
REQUESTS_QOS = QoSProfile(depth=1000)

PROCESSED = "taken"
"""Service of each node, below its name: number of messages processed of each topic, as JSON."""

_processed: Counter[str] = Counter()

# Most messages taken in a row, so that timers and services are not delayed.
_BULK = 500


def recorded_type(topic: str) -> Any:
    """Return the type of a topic's messages, by its name in a bag."""
    package, _, name = TOPIC_TYPES[topic].split("/")
    return getattr(import_module(f"{package}.msg"), name)


def every(node: Node, undo: ExitStack, period_s: float, do: Callable[[], object]) -> Timer:
    """Call ``do`` at each period of a steady clock until ``undo``; simulated time may stand."""
    made = node.create_timer(period_s, do, clock=Clock(clock_type=ClockType.STEADY_TIME))
    undo.callback(node.destroy_timer, made)
    return made


def publish_on(
    node: Node, undo: ExitStack, kind: Any, topic: str, qos: QoSProfile = SAMPLES_QOS
) -> Publisher:
    """Return a publisher, which ends with ``undo``; qos_overrides.* parameters apply."""
    with _overrides_understood(topic):
        # A copy, since rclpy writes the overrides into its argument.
        made = node.create_publisher(kind, topic, copy(qos), qos_overriding_options=_overriding())
    undo.callback(node.destroy_publisher, made)
    return made


def listen(
    node: Node,
    undo: ExitStack,
    kind: Any,
    topic: str,
    callback: Callable[[Any, MessageInfo], None],
    qos: QoSProfile = SAMPLES_QOS,
    *,
    raw: bool = False,
    after: Callable[[], None] = lambda: None,
    lost: Callable[[int], None] | None = None,
) -> Subscription:
    """Call ``callback(message, info)`` for each message, until ``undo``.

    after: called when no more messages wait, or some hundreds have been taken
    lost: called with the total number of lost messages
    A round of the executor takes longer than a short message, so all waiting messages are taken in
    one round.
    """

    def take(message: Any, info: MessageInfo) -> None:
        callback(message, info)
        _processed[made.topic_name] += 1

    def take_all(message: Any, info: MessageInfo) -> None:
        take(message, info)
        take_waiting(made, take)
        after()

    events = SubscriptionEventCallbacks(
        message_lost=None if lost is None else lambda event: lost(event.total_count)
    )
    with _overrides_understood(topic):
        made = node.create_subscription(
            kind,
            topic,
            take_all,
            copy(qos),
            raw=raw,
            event_callbacks=events,
            qos_overriding_options=_overriding(),
        )
    undo.callback(node.destroy_subscription, made)
    return made


FRAME_PREFIX = Parameter("frame_prefix", "", "before each frame, as cell2/; for several cells")


def take_waiting(subscription: Subscription, callback: Callable[[Any, MessageInfo], None]) -> int:
    """Take some hundreds of waiting messages at most; return when the last was published [ns]."""
    published_ns = 0
    for _ in range(_BULK):
        with subscription.handle:
            taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
        if taken is None:
            break
        callback(*taken)
        published_ns = taken[1]["source_timestamp"]
    return published_ns


# Between two looks for messages on their way; the longest time, since a launch waits for five
# seconds [s]. All nodes of a launch get its signal within this time [ns].
_LOOK_S, _LONGEST_S, _TOGETHER_NS = 0.01, 3.0, 500_000_000


def take_rest(
    takers: Sequence[tuple[Subscription, Callable[[Any, MessageInfo], None]]], looks: int
) -> bool:
    """Take the messages still on their way, and those of publishers that end at the same time.

    The messages of a publisher arrive in order. So all of a topic have come once one has come that
    was published half a second later, or once its publisher has left, which waits for their
    acknowledgement. A publisher that does neither has sent no more if nothing has come on any topic
    in ``looks`` looks of 10 ms each, which are counted since a busy computer may give this process
    no time. Of several publishers of a topic, one may be behind the other. Return False if messages
    still came after three seconds.
    """
    until_ns, begin, in_vain = time.time_ns() + _TOGETHER_NS, time.monotonic(), 0
    open_topics = list(takers)
    while open_topics and in_vain < looks and time.monotonic() - begin < _LONGEST_S:
        in_vain += 1
        for taker in tuple(open_topics):
            # Before the look, since the last messages come before a publisher leaves.
            publishers = taker[0].get_publisher_count()
            published_ns = take_waiting(*taker)
            in_vain = 0 if published_ns else in_vain
            if (publishers == 1 and published_ns > until_ns) or not (publishers or published_ns):
                open_topics.remove(taker)
        time.sleep(_LOOK_S if open_topics else 0.0)
    return not open_topics or in_vain >= looks


def answer_processed_counts(
    request: Trigger.Request, response: Trigger.Response
) -> Trigger.Response:
    """Answer the number of messages of each topic that this process has processed."""
    response.success, response.message = True, json_and_yaml.text_of(dict(_processed))
    return response


@contextmanager
def _overrides_understood(topic: str) -> Iterator[None]:
    """Raise ConfigurationError for an invalid parameter qos_overrides.*"""
    try:
        yield
    except (RuntimeError, InvalidParameterTypeException) as err:
        raise ConfigurationError(
            f"quality of service of {topic!r}: {err}; see parameters qos_overrides.*"
        ) from err


def _overriding() -> QoSOverridingOptions:
    kinds = (QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY)
    return QoSOverridingOptions((*kinds, QoSPolicyKind.DURABILITY), callback=_possible)


def _possible(qos: QoSProfile) -> SetParametersResult:
    quantities.QUEUE_DEPTH.checked(qos.depth, ConfigurationError)
    return SetParametersResult(successful=True)


def publish_frames(
    node: Node, undo: ExitStack, geometry: Geometry, names: Mapping[str, Any]
) -> None:
    """Publish machine → probe and machine → workpiece with every axis at zero, latched.

    The machine's origin is where the probe finds a surface at distance zero. The probe stands
    there and looks along its beam; the workpiece's origin lies on the spindle's axis.

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
    publisher = publish_on(node, undo, TFMessage, "/tf_static", LATCHED_QOS)
    publisher.publish(
        TFMessage(
            transforms=[
                TransformStamped(header=header, child_frame_id=names[name], transform=transform)
                for name, transform in placed.items()
            ]
        )
    )
