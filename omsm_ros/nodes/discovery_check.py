"""Checks that two ROS contexts of this computer exchange a message; for ``omsm doctor``."""

import sys
import time

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_msgs.msg import UInt32

TIMEOUT_S = 10.0


def main() -> int:
    """Send a number from one participant to another; return 1 if it does not arrive."""
    contexts = [Context(), Context()]
    for context in contexts:
        rclpy.init(context=context)
    # A unique name, so that two simultaneous checks do not receive each other's message.
    topic = f"omsm_doctor_{time.monotonic_ns()}"
    received: list[int] = []
    sender = Node("omsm_doctor_sender", context=contexts[0])
    receiver = Node("omsm_doctor_receiver", context=contexts[1])
    publisher = sender.create_publisher(UInt32, topic, QoSProfile(depth=1))
    receiver.create_subscription(
        UInt32, topic, lambda message: received.append(message.data), QoSProfile(depth=1)
    )
    executor = SingleThreadedExecutor(context=contexts[1])
    executor.add_node(receiver)
    start = time.monotonic()
    while not received and time.monotonic() - start < TIMEOUT_S:
        publisher.publish(UInt32(data=1))
        executor.spin_once(timeout_sec=0.05)
    elapsed = time.monotonic() - start
    executor.shutdown()
    for node, context in ((sender, contexts[0]), (receiver, contexts[1])):
        node.destroy_node()
        context.try_shutdown()
    if not received:
        print(f"no message within {TIMEOUT_S:g} s", file=sys.stderr)
        return 1
    print(f"a message between two participants after {elapsed:.1f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
