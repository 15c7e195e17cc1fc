"""A report has the level of its most severe finding, lists all, and is published each second."""

import itertools

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

from diagnostic_msgs.msg import DiagnosticStatus

from omsm_ros.nodes.diagnostics import (
    ERROR,
    OK,
    STALE,
    WARN,
    Diagnostics,
    StateReport,
    log_internal_error,
)

from .fake_node import FakeNode

FINDINGS = [(WARN, "look"), (STALE, "nothing comes"), (ERROR, "it cannot")]


def test_without_a_finding_it_is_well_and_says_its_message():
    report = StateReport("correcting")
    assert (report.level, report.text, report.values) == (OK, "correcting", {})


@pytest.mark.parametrize("order", [*itertools.permutations(range(3))])
def test_the_gravest_comes_first_in_whatever_order_they_were_found(order):
    """To an operator silence is graver than a warning, although ROS numbers it higher than all."""
    report = StateReport("correcting")
    for place in order:
        report.add(*FINDINGS[place])
    assert report.level == ERROR
    assert report.text == "it cannot; nothing comes; look"


@pytest.mark.parametrize(("found", "level"), [((0, 1), STALE), ((0,), WARN), ((1,), STALE)])
def test_the_level_is_that_of_the_gravest(found, level):
    report = StateReport("")
    for place in found:
        report.add(*FINDINGS[place])
    assert report.level == level


def test_findings_of_one_level_stay_in_their_order():
    report = StateReport("")
    for text in ("a", "b", "c"):
        report.add(WARN, text)
    assert report.text == "a; b; c"


def published(node, report, **more):
    Diagnostics(node, lambda: report, **more).publish()
    (array,) = node.messages("/diagnostics")
    (status,) = array.status
    return array, status


def test_what_is_published_has_name_stamp_hardware_and_values():
    node = FakeNode("confocal_driver")
    report = StateReport("reading", {"received": 5, "rate_hz": 1000.0, "state": "reading"})
    array, status = published(node, report, hardware_id=lambda: "tcp://probe:7891")
    assert status.name == "/omsm/confocal_driver"
    assert status.hardware_id == "tcp://probe:7891"
    assert status.level == DiagnosticStatus.OK
    assert {pair.key: pair.value for pair in status.values} == {
        "received": "5", "rate_hz": "1000.0", "state": "reading",
    }  # fmt: skip
    assert array.header.stamp.sec == node.now_ns // 10**9


@pytest.mark.parametrize(("simulated", "now_ns", "reported"), [
    (True, 0, True), (True, 5, False), (False, 0, False),
])  # fmt: skip
def test_simulated_time_that_nobody_sets_is_reported(simulated, now_ns, reported):
    node = FakeNode()
    node.simulated, node.now_ns = simulated, now_ns
    _, status = published(node, StateReport("correcting"))
    assert ("no node publishes /clock" in status.message) == reported
    assert status.level == (DiagnosticStatus.WARN if reported else DiagnosticStatus.OK)


def test_defects_are_those_of_the_node_itself():
    one, other = FakeNode("one_with_defects"), FakeNode("one_without")
    line = log_internal_error(one, ValueError("first"))
    assert "ValueError: first" in line
    assert one.logged == [("error", line)]
    assert published(one, StateReport("well"))[1].level == DiagnosticStatus.ERROR
    assert published(other, StateReport("well"))[1].message == "well"


def test_somebody_who_looks_for_a_defect_sees_it_raised(monkeypatch):
    monkeypatch.setenv("OMSM_DEBUG", "1")
    node = FakeNode("debugged")
    with pytest.raises(ValueError, match="here"):
        log_internal_error(node, ValueError("here"))
    assert node.logged == []
