"""Subscribers are waited for within limits: scripted ones, on a simulated clock."""

from __future__ import annotations

import json
from contextlib import ExitStack

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

from omsm_ros.nodes import player_node as module
from omsm_ros.nodes.player_node import Listeners

TOPIC = "/omsm/axes"


class Endpoint:
    node_namespace, node_name = "/omsm", "corrector"


class Answer:
    def __init__(self, taken):
        self.message = json.dumps({TOPIC: taken})


class Asked:
    """A request that is answered when the listener is next let answer."""

    def __init__(self):
        self._answer = None

    def done(self):
        return self._answer is not None

    def result(self):
        return self._answer


class Client:
    def __init__(self):
        self.asked = []

    def service_is_ready(self):
        return True

    def call_async(self, _):
        self.asked.append(Asked())
        return self.asked[-1]

    def remove_pending_request(self, future):
        self.asked.remove(future)


class Node:
    """As far as Listeners needs one; with a listener that takes what it is let take."""

    def __init__(self):
        self.client, self.said, self.reported = Client(), [], True
        self.taken = 0
        self.there = [Endpoint()]

    def get_subscriptions_info_by_topic(self, _):
        return self.there if self.reported else []

    def create_client(self, *_):
        return self.client

    def destroy_client(self, _): ...

    def get_logger(self):
        return self

    def error(self, text):
        self.said.append(text)

    warning = error

    def answer(self):
        for asked in self.client.asked:
            asked._answer = Answer(self.taken)
        self.client.asked.clear()


class Publisher:
    topic_name = TOPIC

    def get_subscription_count(self):
        return 1


@pytest.fixture
def cell(monkeypatch):
    """Node, listeners and a way to let time pass, in which the listener answers or does not."""
    now = [100.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    node = Node()
    with ExitStack() as undo:
        listeners = Listeners(node, [Publisher()], undo)

        def pass_by(seconds, answering=True):
            for _ in range(round(seconds / 0.1)):
                now[0] += 0.1
                listeners.look()
                if answering:
                    node.answer()

        yield node, listeners, pass_by


def published(listeners, count):
    for _ in range(count):
        listeners.published(TOPIC, 1000)


def test_it_is_waited_for_until_it_has_taken_everything(cell):
    node, listeners, pass_by = cell
    node.taken = 7  # of another player before
    listeners.look()
    assert not listeners.known
    pass_by(1.0)
    assert listeners.known
    published(listeners, 5)
    node.taken += 4
    pass_by(3.0)
    assert listeners.pending_listeners == ["/omsm/corrector"]
    node.taken += 1
    pass_by(1.0)
    assert listeners.pending_listeners == []
    assert not +listeners.lost


def test_it_is_known_for_how_long_nobody_has_come_or_gone(cell):
    node, listeners, pass_by = cell
    pass_by(3.0)
    assert listeners.seconds_since_change == pytest.approx(
        2.9, abs=0.21
    )  # it is looked around now and then
    node.there = [Endpoint(), Endpoint()]  # another of the same name
    pass_by(1.0)
    assert listeners.seconds_since_change == pytest.approx(0.9, abs=0.21)
    node.there = [Endpoint(), type("Other", (Endpoint,), {"node_name": "other"})()]
    pass_by(1.0)
    assert listeners.seconds_since_change == pytest.approx(0.9, abs=0.21)
    pass_by(1.0)
    assert listeners.seconds_since_change == pytest.approx(1.9, abs=0.21)


def test_one_of_whom_only_the_middleware_knows_is_not_forgotten(cell):
    """Nothing may begin before it is known who it is, and has told what it took."""
    node, listeners, pass_by = cell
    node.reported = False
    pass_by(1.0)
    assert not listeners.known
    node.reported = True
    pass_by(1.0)
    assert listeners.known


def test_one_that_comes_while_it_plays_is_asked_first(cell):
    node, listeners, pass_by = cell
    node.reported = False
    pass_by(1.0)
    assert listeners.room
    node.reported = True
    pass_by(1.0, answering=False)
    assert not listeners.room
    pass_by(1.0)
    assert listeners.room


@pytest.mark.parametrize("answering", [True, False])
def test_what_is_never_taken_is_lost_and_not_waited_for_for_ever(cell, answering):
    """Whether the listener still answers, or does not any more."""
    node, listeners, pass_by = cell
    pass_by(1.0)
    published(listeners, 5)
    node.taken = 3
    pass_by(1.0)
    pass_by(25.0, answering)
    assert listeners.pending_listeners == []
    assert listeners.lost == {"/omsm/corrector": 2}
    assert "has lost 2 messages" in node.said[0]


def test_what_came_late_after_all_was_not_lost(cell):
    node, listeners, pass_by = cell
    pass_by(1.0)
    published(listeners, 5)
    pass_by(25.0, answering=False)
    assert listeners.lost["/omsm/corrector"] == 5
    node.taken = 4
    pass_by(1.0)
    assert listeners.lost["/omsm/corrector"] == 1
    published(listeners, 2)
    assert listeners.pending_listeners == ["/omsm/corrector"]
    node.taken = 6
    pass_by(1.0)
    assert listeners.pending_listeners == []
    assert listeners.lost["/omsm/corrector"] == 1


def test_no_more_than_a_part_of_a_queue_is_on_its_way(cell):
    _, listeners, pass_by = cell
    pass_by(1.0)
    count = 0
    while listeners.room:
        published(listeners, 1)
        count += 1
    assert 100 < count <= 256  # a thousand bytes each
