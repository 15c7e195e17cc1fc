"""How nodes answer requests, take what waits, and tell what they have taken."""

import asyncio
import json
from contextlib import ExitStack, nullcontext
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("omsm_msgs", reason="the messages are not built")

from omsm_msgs.srv import Identify, LoadCalibration, PredictError
from rclpy.qos import QoSProfile
from std_srvs.srv import SetBool, Trigger

from omsm_ros.core.kinematics.kinematics import Geometry, beam_quaternion
from omsm_ros.errors import ConfigurationError, DataError
from omsm_ros.nodes import topics
from omsm_ros.nodes.running import PacedService, refuse, serve, settings_of
from omsm_ros.nodes.topics import publish_frames

from .fake_node import FakeNode


@pytest.mark.parametrize("kind", [Identify, LoadCalibration, PredictError, SetBool])
def test_a_refusal_says_no_in_the_words_of_the_service_and_why(kind):
    response = kind.Response()
    for name in ("success", "safe"):
        if hasattr(response, name):
            setattr(response, name, True)
    refuse(response, "no steps were found;\nrecord again")
    assert not any(getattr(response, name, False) for name in ("success", "safe"))
    assert response.message == "no steps were found; record again"


def served(answer):
    node = FakeNode("calibrator_of_requests")
    serve(node, ExitStack(), SetBool, "~/switch", answer)
    (service,) = node.services
    return node, asyncio.run(service.callback(SetBool.Request(data=True), SetBool.Response()))


def test_an_answer_is_what_it_was_filled_with():
    def answer(request, response):
        response.success, response.message = request.data, "on"

    _, response = served(answer)
    assert (response.success, response.message) == (True, "on")


def test_what_an_answer_raises_is_said_and_a_defect_counted():
    def refuses(request, response):
        response.success = True
        raise DataError("only 3 steps were found, expected 4 or more")

    node, response = served(refuses)
    assert (response.success, node.logged) == (False, [])
    assert response.message == "only 3 steps were found, expected 4 or more"

    def breaks(request, response):
        raise ZeroDivisionError("division by zero")

    node, response = served(breaks)
    assert not response.success
    assert "a defect of omsm_ros" in response.message
    assert node.logged == [("error", response.message)]


def test_requests_are_taken_one_after_the_other_a_moment_apart():
    node, calls = FakeNode(), []
    node.create_timer = lambda period, callback, **_: SimpleNamespace(
        cancel=lambda: calls.append("cancel"), reset=lambda: calls.append("reset"), over=callback
    )
    paced = PacedService(node, ExitStack())
    calls.clear()
    assert paced.can_execute(None)
    assert paced.beginning_execution(None)
    assert not paced.can_execute(None)
    assert not paced.beginning_execution(None)
    assert calls == ["reset"]
    paced._pause.over()
    assert calls == ["reset", "cancel"]
    assert paced.beginning_execution(None)


@pytest.mark.parametrize("text", ["", "{}"])
def test_nothing_stated_is_no_setting(text):
    assert settings_of(text) == {}


def test_settings_are_an_object_of_json():
    assert settings_of('{"machine": "mill", "n": 2}') == {"machine": "mill", "n": 2}
    for wrong in ("[1]", "mill", '{"a": NaN}', '{"a": 1, "a": 2}'):
        with pytest.raises(ConfigurationError, match="parameter 'settings'"):
            settings_of(wrong)


class Waiting:
    """A subscription with messages in its queue."""

    msg_type, raw = object, False

    def __init__(self, count):
        self.left = count
        self.handle = self

    def __enter__(self):
        return nullcontext()

    def __exit__(self, *_): ...

    def take_message(self, kind, raw):
        if not self.left:
            return None
        self.left -= 1
        return self.left, {"source_timestamp": 5}


@pytest.mark.parametrize(("count", "at_once"), [(0, 0), (3, 3), (100_000, None)])
def test_what_waits_is_taken_in_bulk_but_not_without_end(count, at_once):
    queue, taken = Waiting(count), []
    published_ns = topics.take_waiting(queue, lambda message, info: taken.append(message))
    assert published_ns == (5 if count else 0)
    assert len(taken) == count - queue.left
    assert len(taken) == at_once if at_once is not None else 100 < len(taken) < 10_000
    assert taken == list(range(count - 1, count - 1 - len(taken), -1))


def listening(waiting):
    """A node that listens to /omsm/axes, of which some wait; and the order of what is called."""
    node, order = FakeNode(), []
    made = Waiting(waiting)
    made.topic_name = "/omsm/axes"

    def subscribe(kind, topic, callback, qos, **more):
        made.callback, made.more = callback, more
        return made

    node.create_subscription = subscribe
    topics.listen(
        node, ExitStack(), object, "axes", lambda message, _: order.append(message),
        after=lambda: order.append("after"), lost=lambda count: order.append(f"lost {count}"),
    )  # fmt: skip
    return made, order


def test_all_that_wait_are_taken_in_one_round_and_counted(monkeypatch):
    monkeypatch.setattr(topics, "_processed", topics.Counter())
    made, order = listening(2)
    made.callback("first", {})
    assert order == ["first", 1, 0, "after"]
    answer = topics.answer_processed_counts(Trigger.Request(), Trigger.Response())
    assert answer.success
    assert json.loads(answer.message) == {"/omsm/axes": 3}
    made.more["event_callbacks"].message_lost(SimpleNamespace(total_count=4))
    assert order[-1] == "lost 4"


def test_a_quality_of_service_that_there_is_not_is_named_with_its_parameters():
    node = FakeNode()

    def fails(*_, **__):
        raise RuntimeError("reliability 'often' is none")

    node.create_publisher = node.create_subscription = fails
    with pytest.raises(ConfigurationError, match=r"'axes'.*'often'.*qos_overrides"):
        topics.publish_on(node, ExitStack(), object, "axes")
    with pytest.raises(ConfigurationError, match=r"'axes'.*'often'.*qos_overrides"):
        topics.listen(node, ExitStack(), object, "axes", print)


def test_a_queue_of_no_depth_is_refused():
    assert topics._possible(QoSProfile(depth=10)).successful
    with pytest.raises(ConfigurationError, match="depth of a queue"):
        topics._possible(SimpleNamespace(depth=0))


def test_no_publisher_shares_its_quality_of_service_with_another():
    node, given = FakeNode(), []
    node.create_publisher = lambda kind, topic, qos, **_: given.append(qos)
    for _ in range(2):
        topics.publish_on(node, ExitStack(), object, "axes")
    assert given[0] is not given[1]
    assert given[0] is not topics.SAMPLES_QOS
    assert given[0].depth == topics.SAMPLES_QOS.depth


@pytest.mark.parametrize(("beam_x", "beam_y"), [(0.0, 0.0), (0.1, 0.0), (0.0, -0.3), (0.7, 0.9)])
def test_the_probe_s_frame_looks_along_its_beam(beam_x, beam_y):
    """Its Z axis, turned by the rotation matrix of the quaternion as textbooks write it."""
    x, y, z, w = beam_quaternion(Geometry(beam_x=beam_x, beam_y=beam_y))
    assert x * x + y * y + z * z + w * w == pytest.approx(1.0, abs=1e-15)
    turned = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    beam = np.array([beam_x, beam_y, 1.0])
    np.testing.assert_allclose(turned, beam / np.linalg.norm(beam), atol=1e-15)
    assert z == 0.0  # the shortest turn has no part about Z itself


def test_frames_are_broadcast_from_the_machine_to_probe_and_workpiece(monkeypatch):
    messages = pytest.importorskip("geometry_msgs.msg")

    class TFMessage(SimpleNamespace):
        pass

    fake = SimpleNamespace(TFMessage=TFMessage)
    monkeypatch.setitem(__import__("sys").modules, "tf2_msgs", SimpleNamespace(msg=fake))
    monkeypatch.setitem(__import__("sys").modules, "tf2_msgs.msg", fake)
    node = FakeNode()
    names = {"machine_frame": "mill", "probe_frame": "needle", "workpiece_frame": "part"}
    publish_frames(node, ExitStack(), Geometry(centre_x=3e-3, centre_y=-2e-3, beam_x=0.1), names)
    (said,) = node.messages("/tf_static")
    placed = {each.child_frame_id: each for each in said.transforms}
    assert {each.header.frame_id for each in said.transforms} == {"mill"}
    assert isinstance(placed["part"].transform, messages.Transform)
    where = placed["part"].transform.translation
    assert (where.x, where.y, where.z) == (3e-3, -2e-3, 0.0)
    turned = placed["needle"].transform.rotation
    assert 2 * np.arcsin(turned.y) == pytest.approx(np.arctan(0.1))
    assert placed["needle"].transform.translation.x == 0.0


def test_without_the_messages_of_tf_that_is_said_and_nothing_else(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "tf2_msgs", None)
    node = FakeNode()
    publish_frames(node, ExitStack(), Geometry(), {})
    assert node.published == []
    assert node.logged == [("info", "tf2_msgs is not installed: no transforms are published")]
