"""An action answers all requests that came while its node was busy."""

import time
from contextlib import ExitStack

import pytest

pytest.importorskip("omsm_msgs", reason="the messages are not built")

import rclpy
from action_msgs.srv import CancelGoal
from omsm_msgs.action import Identify
from own_domain import own_domain
from rclpy.executors import SingleThreadedExecutor

from omsm_ros.nodes.background_worker import serve_action
from omsm_ros.nodes.topics import REQUESTS_QOS


def test_none_of_many_cancellations_is_lost(monkeypatch):
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    with ExitStack() as undo:
        context = rclpy.Context()
        context.init(domain_id=undo.enter_context(own_domain()))
        undo.callback(context.shutdown)
        node = rclpy.create_node("calibrator", context=context)
        undo.callback(node.destroy_node)
        serve_action(node, undo, Identify, "identify", None)
        client = node.create_client(
            CancelGoal, "identify/_action/cancel_goal", qos_profile=REQUESTS_QOS
        )
        assert client.wait_for_service(5.0)
        answers = [client.call_async(CancelGoal.Request()) for _ in range(40)]
        time.sleep(0.2)
        executor = SingleThreadedExecutor(context=context)
        undo.callback(executor.shutdown)
        executor.add_node(node)
        end = time.monotonic() + 10.0
        while not all(each.done() for each in answers) and time.monotonic() < end:
            executor.spin_once(0.1)
        assert sum(answer.done() for answer in answers) == 40
