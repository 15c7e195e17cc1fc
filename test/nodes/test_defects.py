"""Internal errors stay in the diagnostics as long as the node runs."""

from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.clock import Clock

from omsm_ros.nodes.diagnostics import Diagnostics, StateReport, log_internal_error


class FakeNode:
    """Keeps what is published and logged; its clock runs."""

    def __init__(self):
        self.published, self.logged = [], []

    def create_publisher(self, *_):
        return SimpleNamespace(publish=self.published.append)

    def destroy_timer(self, _): ...

    def create_timer(self, *_, **__):
        return None

    def get_clock(self):
        return SimpleNamespace(ros_time_is_active=False, now=Clock().now)

    def get_logger(self):
        return SimpleNamespace(error=lambda line, **_: self.logged.append(line))

    def get_fully_qualified_name(self):
        return f"/omsm/node_{id(self)}"


def test_the_last_internal_error_is_reported_with_their_number():
    node = FakeNode()
    reported = Diagnostics(node, lambda: StateReport("correcting", {"received": 5}))
    reported.publish()
    assert node.published[-1].status[0].message == "correcting"
    for err in (ValueError("first"), KeyError("second")):
        assert log_internal_error(node, err) == node.logged[-1]
    reported.publish()
    status = node.published[-1].status[0]
    assert status.level == DiagnosticStatus.ERROR
    assert status.message == f"{node.logged[-1]} (2 in all)"
    assert "KeyError: 'second'" in status.message
    assert {value.key: value.value for value in status.values} == {"received": "5", "defects": "2"}
