"""A signal to end is heard whenever it comes; the messages sent before it are taken."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from contextlib import nullcontext
from itertools import count
from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

from omsm_ros.nodes import managed, topics

# The signal comes as soon as somebody minds it: between two lines that set up who hears it.
EAGER = """
import os, signal, sys
from omsm_ros.nodes import running
number, set_handler = int(sys.argv[1]), signal.signal
set_handler(number, signal.SIG_DFL)  # below nohup a SIGHUP is ignored, and is to be

def signal_at_once(which, handler):
    set_handler(which, handler)
    if which == number:
        os.kill(os.getpid(), number)

signal.signal = signal_at_once
ending = running._SignalEnd()
sys.exit(0 if ending.asked.wait(5) else 3)
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_while_its_hearing_is_set_up_is_not_lost(number: signal.Signals) -> None:
    done = subprocess.run(
        [sys.executable, "-c", EAGER, str(int(number))], capture_output=True, text=True, timeout=200
    )
    assert done.returncode == 0, done.stderr


EARLIER, LATER = -(10**9), 10**12
LOOKS = 20


class Subscription:
    """Has messages at each look: numbers, and how long after now they were published [ns].

    publishers: how many are left at each look; the last entry stays
    """

    msg_type, raw = None, False

    def __init__(self, *looks, publishers=(1,)):
        self._looks, self._publishers = iter(looks), list(publishers)
        self._now_ns = time.time_ns()
        self.looked, self.taken = 0, []

    def get_publisher_count(self):
        self._messages = iter(next(self._looks, ()))
        self.looked += 1
        return self._publishers.pop(0) if self._publishers[1:] else self._publishers[0]

    @property
    def handle(self):
        made = nullcontext()
        made.take_message = self._take_message
        return made

    def _take_message(self, *_):
        number, after_ns = next(self._messages, (None, 0))
        return None if number is None else (number, {"source_timestamp": self._now_ns + after_ns})

    def take(self, number, _):
        self.taken.append(number)


def take_rest(*subscriptions, monkeypatch):
    monkeypatch.setattr(topics.time, "sleep", lambda _: None)
    return topics.take_rest([(each, each.take) for each in subscriptions], LOOKS)


def test_messages_published_after_the_end_are_not_waited_for(monkeypatch):
    endless = ((number, EARLIER if number < 700 else LATER) for number in count())
    flowing = Subscription(*[endless] * 1000)
    assert take_rest(flowing, monkeypatch=monkeypatch)
    assert flowing.looked == 2
    assert flowing.taken == list(range(len(flowing.taken)))
    assert len(flowing.taken) >= 700


def test_a_publisher_that_has_left_is_not_waited_for(monkeypatch):
    leaving = Subscription([(0, EARLIER)], (), [(1, EARLIER)], publishers=(1, 1, 0))
    assert take_rest(leaving, monkeypatch=monkeypatch)
    assert (leaving.taken, leaving.looked) == ([0, 1], 4)


def test_a_silent_publisher_has_some_looks_after_the_last_message_of_any(monkeypatch):
    late = Subscription(*[()] * (LOOKS - 1), [(0, EARLIER)])
    later = Subscription(*[()] * (2 * LOOKS - 2), [(0, EARLIER)])
    assert take_rest(late, later, monkeypatch=monkeypatch)
    assert late.taken == later.taken == [0]


def test_one_of_two_publishers_may_be_behind_the_other(monkeypatch):
    both = Subscription([(0, LATER)], [(1, EARLIER)], publishers=(2,))
    take_rest(both, monkeypatch=monkeypatch)
    assert both.taken == [0, 1]


def test_messages_that_still_wait_after_the_longest_time_are_named(monkeypatch):
    monkeypatch.setattr(topics.time, "monotonic", iter(range(100)).__next__)
    endless = ((number, EARLIER) for number in count())
    assert not take_rest(Subscription(*[endless] * 1000), monkeypatch=monkeypatch)


@pytest.mark.parametrize(("steps", "asked"), [(0, 1), (30, 31), (10**6, 100)])
def test_a_publisher_stays_until_its_messages_are_acknowledged(steps, asked):
    answers = (step >= steps for step in count())
    calls, warned = [], []

    def wait_for_all_acked(timeout):
        calls.append(timeout)
        return next(answers)

    publisher = SimpleNamespace(wait_for_all_acked=wait_for_all_acked)
    node = SimpleNamespace(
        _outputs=[publisher], get_logger=lambda: SimpleNamespace(warning=warned.append)
    )
    managed.ManagedNode._wait_for_last_messages(node)
    assert len(calls) == asked
    assert bool(warned) == (steps > asked)
