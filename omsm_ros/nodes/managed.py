"""What every node of this package is: managed, set by its parameters, honest about its state.

``ros2 lifecycle`` takes it from unconfigured (parameters may be set) over inactive (they are in
force) to active (it works) and back; unless ``autostart`` is false it goes there by itself. A
node says what each of the two steps makes, and on the stack that it is handed, how it is undone:

    configure(undo): what the parameters describe
    activate(undo):  what takes and gives data
    report():        its state while it is configured
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from enum import Enum
from typing import Any

from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import InvalidParameterTypeException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from std_srvs.srv import Trigger

from omsm_ros.errors import ConfigurationError, OmsmError, one_line
from omsm_ros.nodes import topics
from omsm_ros.nodes.declared import Declared
from omsm_ros.nodes.diagnostics import ERROR, WARN, Diagnostics, Report, survive
from omsm_ros.nodes.memory import RETURN_PERIOD_S, give_back
from omsm_ros.parameters import Parameter

NAMESPACE = "omsm"
# A publisher that is destroyed takes along what who listens has not fetched yet; the middleware
# itself would tell so only every three seconds. In steps, as a busy machine counts time.
_STEPS, _STEP_S = 20, 0.01
AUTOSTART = Parameter("autostart", True, "configure and activate at the start", fixed=True)


class Stage(Enum):
    """How far a node has been brought."""

    UNCONFIGURED = "unconfigured"
    INACTIVE = "inactive"
    ACTIVE = "active"
    FINALIZED = "finalized"


class ManagedNode(LifecycleNode):  # type: ignore[misc]
    """A node that is configured, activated, deactivated and cleaned up from outside.

    values: its parameters, once it is configured
    fatal: what ends the node for good, once set; exit code 2
    """

    def __init__(self, name: str, parameters: Sequence[Parameter]) -> None:
        try:
            super().__init__(name, namespace=NAMESPACE)
        except InvalidParameterTypeException as err:  # of one that rclpy itself has: use_sim_time
            raise ConfigurationError(f"{name}: {err}") from err
        except rclpy_implementation.RCLError as err:
            if "invalid" not in str(err):
                raise
            what = str(err).split(", at ")[0]
            raise ConfigurationError(f"{name}: {what}; give another __node or __ns") from err
        self.stage = Stage.UNCONFIGURED
        self.values: dict[str, Any] = {}
        self.fatal: OmsmError | None = None
        self._failure: Exception | None = None
        self._configured, self._activated = ExitStack(), ExitStack()
        self._outputs: list[Publisher] = []
        self._declared = Declared(self, (*parameters, AUTOSTART), self._keeps_parameters)
        self._answer_impossible_transitions()
        self.diagnostics = Diagnostics(self, self._report, self.hardware_id)
        self.create_service(Trigger, f"~/{topics.TAKEN}", topics.tell_taken)
        self.create_timer(RETURN_PERIOD_S, give_back, clock=Clock(clock_type=ClockType.STEADY_TIME))

    # What a node fills in.

    def configure(self, undo: ExitStack) -> None:
        """Make what ``self.values`` describe; raises OmsmError."""

    def activate(self, undo: ExitStack) -> None:
        """Begin to take and give data; raises OmsmError."""

    def report(self) -> Report:
        """Return the state of a node that is configured."""
        return Report("")

    def hardware_id(self) -> str:
        """Return what the node's device is called; empty without one."""
        return ""

    # For a node to use.

    @property
    def active(self) -> bool:
        """Whether it works."""
        return self.stage is Stage.ACTIVE

    def start(self) -> None:
        """Configure and activate, unless it is to be left alone; raises what kept it from it."""
        if not self.get_parameter(AUTOSTART.name).value:
            return
        for step in (self.trigger_configure, self.trigger_activate):
            step()
            if self._failure is not None:
                raise self._failure

    def close(self) -> None:
        """Undo everything, in the order in which it is undone by hand."""
        if self.stage is not Stage.FINALIZED:
            self.trigger_shutdown()

    def publish_on(
        self, undo: ExitStack, kind: Any, topic: str, qos: QoSProfile = topics.SAMPLES_QOS
    ) -> Publisher:
        """Return a publisher of the node's own results, of which there should be one only."""
        made = topics.publish_on(self, undo, kind, topic, qos)
        self._outputs.append(made)
        undo.callback(self._outputs.remove, made)
        return made

    # Parameters.

    def set_parameters_atomically(self, parameter_list: list[Any]) -> SetParametersResult:
        """Set all or none; rclpy itself does not say which one it does not know."""
        try:
            self._declared.check_known([parameter.name for parameter in parameter_list])
        except ConfigurationError as err:
            return SetParametersResult(successful=False, reason=str(err))
        return super().set_parameters_atomically(parameter_list)

    # Transitions.

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Configure; called by ``ros2 lifecycle``, as those below."""
        return self._attempt(self._configure, self._configured, Stage.INACTIVE)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Activate."""
        return self._attempt(self._activate, self._activated, Stage.ACTIVE)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Undo the activation."""
        return self._end(Stage.INACTIVE)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Undo the configuration."""
        return self._end(Stage.UNCONFIGURED)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Undo everything, for good."""
        return self._end(Stage.FINALIZED)

    def _configure(self) -> None:
        self.values = self._declared.values()
        self.configure(self._configured)

    def _activate(self) -> None:
        self.activate(self._activated)
        self._declared.check_overrides()

    def _attempt(
        self, step: Callable[[], None], undo: ExitStack, reached: Stage
    ) -> TransitionCallbackReturn:
        self._failure = None
        try:
            step()
        except Exception as err:
            self._failure = err
            if isinstance(err, OmsmError):
                self.get_logger().error(f"{type(err).__name__}: {one_line(err)}")
            else:
                survive(self, err)
            undo.close()
            return TransitionCallbackReturn.FAILURE
        self.stage = reached
        return TransitionCallbackReturn.SUCCESS

    def _end(self, reached: Stage) -> TransitionCallbackReturn:
        self._undo(self._activated)
        if reached is not Stage.INACTIVE:
            self._let_the_last_arrive()
            self._undo(self._configured)
        self.stage = reached
        self._failure = None
        return TransitionCallbackReturn.SUCCESS

    def _undo(self, stack: ExitStack) -> None:
        try:
            stack.close()
        except Exception as err:  # the rest has been undone all the same
            survive(self, err)

    def _let_the_last_arrive(self) -> None:
        if any(publisher.get_subscription_count() for publisher in self._outputs):
            for _ in range(_STEPS):
                time.sleep(_STEP_S)

    def _answer_impossible_transitions(self) -> None:
        """Let a request for a transition that is none be answered, as refused, not raised."""
        (service,) = (made for made in self.services if made.srv_type is ChangeState)
        change = service.callback

        def answer(request: Any, response: Any) -> Any:
            try:
                return change(request, response)
            except RuntimeError:  # of rcl
                asked = request.transition.label or request.transition.id
                self.get_logger().warning(
                    f"transition {asked!r} is impossible while {self.stage.value}"
                )
                response.success = False
                return response

        service.callback = answer

    def _keeps_parameters(self) -> str:
        if self.stage is Stage.UNCONFIGURED:
            return ""
        return (
            f"takes effect when {self.get_name()} is configured, and it is {self.stage.value}: "
            "`ros2 lifecycle set` it to deactivate and cleanup, set, then configure and activate"
        )

    # State.

    def _report(self) -> Report:
        if self.stage is Stage.UNCONFIGURED:
            report = Report("")
        else:
            report = self.report()
        if self.stage is not Stage.ACTIVE:
            report.add(WARN, f"{self.stage.value}: it does nothing until it is activated")
        if self._failure is not None:
            report.add(ERROR, one_line(self._failure))
        for publisher in self._outputs:
            if (count := self.count_publishers(publisher.topic_name)) > 1:
                report.add(
                    WARN,
                    f"{count} nodes publish {publisher.topic_name}: end all but one "
                    "(one that was killed is forgotten within 20 s)",
                )
        report.values["lifecycle"] = self.stage.value
        return report
