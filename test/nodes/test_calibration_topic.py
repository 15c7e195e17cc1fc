"""The calibration in force: the newest wins, in whatever order nodes say and hear it."""

import pytest

pytest.importorskip("omsm_msgs", reason="the messages are not built")

from contextlib import ExitStack
from dataclasses import replace

from omsm_ros.errors import CalibrationError
from omsm_ros.io import message_mapping
from omsm_ros.nodes.calibration_topic import TOPIC, CalibrationTopic

from .fake_node import STARTED_NS, FakeNode

SECOND = 10**9


class Cell:
    """A node and its topic; it refuses the calibrations in ``refuses``."""

    def __init__(self, listens=True):
        self.node, self.taken, self.refuses = FakeNode(), [], set()
        self.topic = CalibrationTopic(self.node, ExitStack(), self.take, listens)
        self.made = message_mapping.ros_messages()

    def take(self, calibration, since_ns):
        if calibration.id in self.refuses:
            raise CalibrationError(f"calibration {calibration.id[:8]} belongs elsewhere; override")
        self.taken.append((calibration.id, since_ns))

    def hear(self, calibration, since_ns):
        self.topic._on_message(
            message_mapping.calibration_message(self.made, calibration, since_ns), {}
        )

    @property
    def said(self):
        """Ids and stamps of what was published."""
        messages = self.node.messages(TOPIC)
        return [(message.id, message_mapping.stamp_of(message)) for message in messages]


@pytest.fixture
def cell():
    return Cell()


@pytest.fixture(scope="module")
def two(true_calibration):
    return true_calibration, replace(true_calibration, settings={"machine": "another"})


def test_what_is_announced_is_published_with_its_stamp_and_kept(cell, two):
    cell.topic.announce(two[0], STARTED_NS - SECOND)
    assert cell.said == [(two[0].id, STARTED_NS - SECOND)]
    assert (cell.topic.calibration, cell.topic.since_ns) == (two[0], STARTED_NS - SECOND)


def test_the_first_that_is_heard_is_taken_and_said_again(cell, two):
    cell.hear(two[0], STARTED_NS - 5 * SECOND)
    assert cell.taken == [(two[0].id, STARTED_NS - 5 * SECOND)]
    assert cell.said == cell.taken


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_the_newer_is_in_force_in_whatever_order_they_come(cell, two, order):
    since = (STARTED_NS - 9 * SECOND, STARTED_NS - 2 * SECOND)
    for place in order:
        cell.hear(two[place], since[place])
    assert cell.topic.calibration.id == two[1].id
    assert cell.topic.since_ns == since[1]
    assert cell.said[-1] == (two[1].id, since[1])


def test_one_as_old_as_the_one_in_force_changes_nothing(cell, two):
    cell.topic.announce(two[0], STARTED_NS)
    cell.hear(two[1], STARTED_NS)
    assert (cell.topic.calibration, cell.taken, len(cell.said)) == (two[0], [], 1)


def test_the_same_with_a_newer_stamp_is_not_taken_up_anew(cell, two):
    """A new correction would begin, for nothing."""
    cell.topic.announce(two[0], STARTED_NS - SECOND)
    cell.hear(two[0], STARTED_NS)
    assert cell.taken == []
    assert cell.said[-1] == (two[0].id, STARTED_NS)


def test_a_refused_calibration_is_reported_and_the_active_one_republished(cell, two):
    cell.topic.announce(two[0], STARTED_NS - SECOND)
    cell.refuses.add(two[1].id)
    cell.hear(two[1], STARTED_NS + SECOND)
    assert cell.topic.calibration is two[0]
    assert "belongs elsewhere" in cell.topic.refused
    assert [level for level, _ in cell.node.logged] == ["error"]
    assert cell.said[-1][0] == two[0].id
    assert cell.said[-1][1] >= STARTED_NS


def test_two_that_refuse_each_other_do_not_fill_the_network(cell, two):
    cell.topic.announce(two[0], STARTED_NS)
    cell.refuses.add(two[1].id)
    for i in range(100):  # one every tenth of a second
        cell.node.now_ns = STARTED_NS + i * SECOND // 10
        cell.hear(two[1], cell.topic.since_ns + 1)
    assert 2 <= len(cell.said) - 1 <= 3


def test_a_refusal_is_over_with_the_next_that_is_taken(cell, two):
    cell.refuses.add(two[1].id)
    cell.hear(two[1], STARTED_NS)
    assert (cell.topic.calibration, cell.said) == (None, [])
    assert cell.topic.refused
    cell.hear(two[0], STARTED_NS + 1)
    assert cell.topic.refused == ""


@pytest.mark.parametrize("since_ns", [0, STARTED_NS + 60 * SECOND])
def test_a_stamp_of_nobody_or_of_a_clock_ahead_counts_as_now(cell, two, since_ns):
    cell.hear(two[0], since_ns)
    assert cell.topic.since_ns == STARTED_NS
    cell.hear(two[1], since_ns)  # and is newer than what was before
    assert cell.topic.calibration.id == two[1].id
    assert cell.topic.since_ns == STARTED_NS + 1


def test_a_clock_a_little_ahead_is_believed(cell, two):
    cell.hear(two[0], STARTED_NS + 5 * SECOND)
    assert cell.topic.since_ns == STARTED_NS + 5 * SECOND


def test_what_is_decided_now_is_newer_than_all_before(cell, two):
    cell.topic.announce(two[0], STARTED_NS + 5 * SECOND)
    assert cell.topic.decided() == STARTED_NS + 5 * SECOND + 1
    cell.node.now_ns = STARTED_NS + 7 * SECOND
    assert cell.topic.decided() == STARTED_NS + 7 * SECOND


def spoken(cells, turns=20):
    """Let each cell hear all that every cell says, and return how many messages there were."""
    heard = 0
    for _ in range(turns):
        said = [message for cell in cells for message in cell.node.messages(TOPIC)]
        for message in said[heard:]:
            for cell in cells:
                cell.topic._on_message(message, {})
        heard = len(said)
    return sum(len(cell.node.messages(TOPIC)) for cell in cells)


@pytest.mark.parametrize("now_ns", [0, STARTED_NS], ids=["simulated time stands", "real time"])
@pytest.mark.parametrize("ahead_ns", [SECOND // 2, 86_400 * SECOND])
def test_a_node_does_not_answer_itself_whatever_the_date_of_its_calibration(two, now_ns, ahead_ns):
    cell = Cell()
    cell.node.now_ns = now_ns
    cell.topic.announce(two[0], STARTED_NS + ahead_ns)
    assert spoken([cell]) == 1
    assert cell.topic.calibration is two[0]


@pytest.mark.parametrize("clocks", [(0, 0), (STARTED_NS, STARTED_NS), (0, STARTED_NS)])
def test_nodes_with_two_calibrations_of_tomorrow_fall_silent(two, clocks):
    cells = [Cell(), Cell(), Cell()]
    for cell, now_ns in zip(cells, (*clocks, clocks[0]), strict=True):
        cell.node.now_ns = now_ns
    for cell, calibration in zip(cells, two, strict=False):
        cell.topic.announce(calibration, STARTED_NS + 86_400 * SECOND)
    assert spoken(cells) <= 9
    assert all(cell.topic.calibration is not None for cell in cells)


def test_a_message_that_is_none_is_refused_in_one_line(cell, two):
    message = message_mapping.calibration_message(cell.made, two[0], STARTED_NS)
    message.sample_period = -1.0
    cell.topic._on_message(message, {})
    assert cell.topic.calibration is None
    assert "\n" not in cell.topic.refused
    assert "it was altered on the way" in cell.topic.refused


def test_a_node_that_does_not_follow_does_not_listen(two):
    assert Cell(listens=False).node.listening == {}
    assert [*Cell(listens=True).node.listening] == [TOPIC]
