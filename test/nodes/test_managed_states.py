"""How far a node was brought, what a failed step undoes, and what it says of itself meanwhile."""

from contextlib import ExitStack
from types import SimpleNamespace

import pytest

pytest.importorskip("lifecycle_msgs", reason="ROS 2 is not installed")

from lifecycle_msgs.srv import ChangeState
from rclpy.lifecycle import TransitionCallbackReturn

from omsm_ros.errors import DeviceError
from omsm_ros.nodes.diagnostics import ERROR, OK, WARN, StateReport
from omsm_ros.nodes.managed import LifecycleStage, ManagedNode

from .fake_node import FakeNode

DONE, FAILED = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


class Managed(FakeNode):
    """A ManagedNode's own methods, of which each step can be told to fail."""

    on_configure, on_activate = ManagedNode.on_configure, ManagedNode.on_activate
    on_deactivate, on_cleanup = ManagedNode.on_deactivate, ManagedNode.on_cleanup
    on_shutdown, _attempt, _end = ManagedNode.on_shutdown, ManagedNode._attempt, ManagedNode._end
    _configure, _activate, _undo = (
        ManagedNode._configure, ManagedNode._activate, ManagedNode._undo,
    )  # fmt: skip
    _wait_for_last_messages = ManagedNode._wait_for_last_messages
    _keeps_parameters, _report = ManagedNode._keeps_parameters, ManagedNode._report
    publish_on, active, start = ManagedNode.publish_on, ManagedNode.active, ManagedNode.start
    _answer_impossible_transitions = ManagedNode._answer_impossible_transitions

    def __init__(self):
        super().__init__("driver")
        self.stage, self.values, self.fatal, self._failure = (
            LifecycleStage.UNCONFIGURED,
            {},
            None,
            None,
        )
        self._configured, self._activated, self._outputs = ExitStack(), ExitStack(), []
        self._declared = SimpleNamespace(values=lambda: {"port": "a"}, check_overrides=lambda: None)
        self.did, self.fails, self.rivals = [], {}, 1

    def step(self, name, undo):
        undo.callback(self.did.append, f"undo {name}")
        self.did.append(name)
        if name in self.fails:
            raise self.fails[name]

    def configure(self, undo):
        self.step("configure", undo)

    def activate(self, undo):
        self.step("activate", undo)

    def report(self):
        return StateReport("reading", {"received": 5})

    def trigger_configure(self):
        self.on_configure(None)

    def trigger_activate(self):
        self.on_activate(None)

    def count_publishers(self, _):
        return self.rivals


@pytest.fixture
def node():
    return Managed()


def test_there_and_back_undoes_each_step_in_reverse(node):
    assert (node.on_configure(None), node.stage) == (DONE, LifecycleStage.INACTIVE)
    assert node.values == {"port": "a"}
    assert (node.on_activate(None), node.stage, node.active) == (DONE, LifecycleStage.ACTIVE, True)
    assert (node.on_deactivate(None), node.stage) == (DONE, LifecycleStage.INACTIVE)
    assert (node.on_cleanup(None), node.stage) == (DONE, LifecycleStage.UNCONFIGURED)
    assert node.did == ["configure", "activate", "undo activate", "undo configure"]


def test_a_shutdown_from_activity_undoes_everything(node):
    node.on_configure(None)
    node.on_activate(None)
    assert (node.on_shutdown(None), node.stage) == (DONE, LifecycleStage.FINALIZED)
    assert node.did[2:] == ["undo activate", "undo configure"]


@pytest.mark.parametrize("step", ["configure", "activate"])
def test_a_failed_transition_is_undone_reported_and_can_be_retried(node, step):
    node.fails[step] = DeviceError("no answer from tcp://a:1;\ncheck the cable")
    node.on_configure(None)
    outcome = node.on_activate(None) if step == "activate" else None
    assert outcome in (FAILED, None)
    assert node.did[-1] == f"undo {step}"
    assert node.stage is (
        LifecycleStage.INACTIVE if step == "activate" else LifecycleStage.UNCONFIGURED
    )
    line = "DeviceError: no answer from tcp://a:1; check the cable"
    assert node.logged == [("error", line)]
    report = node._report()
    assert report.level == ERROR
    assert report.text.startswith("no answer from tcp://a:1; check the cable; ")
    node.fails.clear()
    again = node.on_activate if step == "activate" else node.on_configure
    assert again(None) == DONE
    assert node._report().level != ERROR


def test_a_defect_in_a_step_fails_it_and_is_counted(node):
    node.name = "driver_with_a_defect"
    node.fails["configure"] = KeyError("z")
    assert node.on_configure(None) == FAILED
    assert "a defect of omsm_ros" in node.logged[0][1]


def test_what_fails_while_it_is_undone_stops_nothing(node):
    node.name = "driver_that_breaks_when_undone"
    node.on_configure(None)
    node._configured.callback(lambda: 1 / 0)
    assert node.on_cleanup(None) == DONE
    assert node.did[-1] == "undo configure"
    assert "ZeroDivisionError" in node.logged[0][1]


@pytest.mark.parametrize("looks", [1, 3])
def test_who_listens_is_given_time_to_fetch_the_last(node, looks):
    """The publishers leave once every message has arrived, and not with a deactivation."""
    answers = iter([False] * (looks - 1) + [True])

    def wait_for_all_acked(timeout):
        node.did.append("wait")
        return next(answers)

    node.on_configure(None)
    node._outputs = [SimpleNamespace(wait_for_all_acked=wait_for_all_acked)]
    node.on_activate(None)
    node.on_deactivate(None)
    assert "wait" not in node.did
    node.on_cleanup(None)
    assert node.did[-looks - 1 :] == ["wait"] * looks + ["undo configure"]


@pytest.mark.parametrize("auto", [True, False])
def test_it_starts_by_itself_unless_it_is_to_be_left_alone(node, auto):
    node.parameters["autostart"] = SimpleNamespace(value=auto)
    node.start()
    assert node.stage is (LifecycleStage.ACTIVE if auto else LifecycleStage.UNCONFIGURED)


def test_what_keeps_it_from_starting_is_raised_and_it_goes_no_further(node):
    node.parameters["autostart"] = SimpleNamespace(value=True)
    node.fails["configure"] = DeviceError("no port")
    with pytest.raises(DeviceError, match="no port"):
        node.start()
    assert "activate" not in node.did


def test_only_what_works_is_well(node):
    report = node._report()
    assert (report.level, report.values["lifecycle"]) == (WARN, "unconfigured")
    assert "received" not in report.values
    assert report.text == "unconfigured: it does nothing until it is activated"
    node.on_configure(None)
    report = node._report()
    assert (report.level, report.values["received"]) == (WARN, 5)
    node.on_activate(None)
    report = node._report()
    assert (report.level, report.text, report.values["lifecycle"]) == (OK, "reading", "active")


def test_another_that_publishes_the_same_is_reported(node):
    with ExitStack() as undo:
        node.publish_on(undo, object, "axes")
        node.on_configure(None)
        node.on_activate(None)
        assert node._report().level == OK
        node.rivals = 2
        report = node._report()
        assert report.level == WARN
        assert "2 nodes publish axes: end all but one" in report.text
    assert node._outputs == []
    assert node._report().level == OK


def test_parameters_are_kept_once_they_are_in_force(node):
    assert node._keeps_parameters() == ""
    node.on_configure(None)
    assert "driver is configured, and it is inactive" in node._keeps_parameters()
    assert "ros2 lifecycle" in node._keeps_parameters()


def test_an_impossible_transition_is_answered_not_raised(node):
    def impossible(request, response):
        raise RuntimeError("rcl_lifecycle: no transition")

    node.create_service(ChangeState, "~/change_state", impossible)
    node._answer_impossible_transitions()
    (service,) = node.services
    request, response = ChangeState.Request(), ChangeState.Response(success=True)
    request.transition.label = "activate"
    assert not service.callback(request, response).success
    assert node.logged == [("warning", "transition 'activate' is impossible while unconfigured")]
