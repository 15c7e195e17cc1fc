"""The base of all nodes: lifecycle, checked parameters and diagnostics.

``ros2 lifecycle`` takes a node from unconfigured (parameters may be set) over inactive (they are in
force) to active (it works) and back; unless ``autostart`` is false it becomes active by itself. A
node implements the steps, and puts on the stack ``undo`` how each is undone:

    configure(undo): make the objects that the parameters describe
    activate(undo):  begin to receive and publish data
    report():        return its state while it is configured
"""

import difflib
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from enum import Enum
from typing import Any, ClassVar

from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    ParameterType,
    SetParametersResult,
)
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.duration import Duration
from rclpy.exceptions import InvalidParameterTypeException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from std_srvs.srv import Trigger

from omsm_ros.errors import ConfigurationError, OmsmError, one_line, shortened
from omsm_ros.io import message_mapping
from omsm_ros.nodes import topics
from omsm_ros.nodes.diagnostics import ERROR, WARN, Diagnostics, StateReport, log_internal_error
from omsm_ros.nodes.memory import RETURN_PERIOD_S, return_free_memory
from omsm_ros.quantities import Parameter

_QOS_PREFIX = "qos_overrides."
# Longest unknown name in an answer.
_MOST_CHARACTERS = 80
_TYPES = range(ParameterType.PARAMETER_NOT_SET, ParameterType.PARAMETER_STRING_ARRAY + 1)


class DeclaredParameters:
    """Declares ``parameters`` on ``node``; an invalid one prevents its configuration.

    refusal: returns why no parameter may be set now; empty if they may
    """

    def __init__(
        self, node: Node, parameters: Sequence[Parameter], refusal: Callable[[], str]
    ) -> None:
        self._node, self._refusal = node, refusal
        self._parameters = {parameter.name: parameter for parameter in parameters}
        self._wrong: dict[str, ConfigurationError] = {}
        # rclpy ignores parameters that are not declared; here they are errors.
        self._given = dict(node._parameter_overrides)
        for parameter in parameters:
            self._declare(parameter)
        node.add_on_set_parameters_callback(self._on_set)
        for service in node.services:
            if service.srv_type in (SetParameters, SetParametersAtomically):
                service.callback = _rejecting_untyped(service.callback)

    def _declare(self, parameter: Parameter) -> None:
        value: Any = parameter.default
        if parameter.name in self._given:
            try:
                value = parameter.checked(self._given[parameter.name].value)
            except ConfigurationError as err:
                self._wrong[parameter.name] = err
        self._node.declare_parameter(
            parameter.name, value, _descriptor(parameter), ignore_override=True
        )

    def values(self) -> dict[str, Any]:
        """Return all parameters by name; ConfigurationError for one that is invalid or unknown."""
        try:
            for err in self._wrong.values():
                raise err
            self.check_known([name for name in self._given if not name.startswith(_QOS_PREFIX)])
            values = {
                name: parameter.checked(self._node.get_parameter(name).value)
                for name, parameter in self._parameters.items()
            }
            # Frames of several cells must differ.
            prefix = values.get("frame_prefix", "")
            return values | {n: prefix + values[n] for n in values if n.endswith("_frame")}
        except ConfigurationError as err:
            raise ConfigurationError(f"{self._node.get_name()}: {err}") from err

    def check_overrides(self) -> None:
        """Raise ConfigurationError for a qos_overrides.* of a topic that the node does not have."""
        self.check_known([name for name in self._given if name.startswith(_QOS_PREFIX)])

    def check_known(self, names: Sequence[str]) -> None:
        """Raise ConfigurationError for an unknown parameter, with the nearest name."""
        for name in names:
            if not self._node.has_parameter(name):
                name = shortened(name, _MOST_CHARACTERS)
                near = difflib.get_close_matches(name, self._parameters, 1)
                hint = f"did you mean {near[0]!r}?" if near else "`ros2 param list` shows them all"
                raise ConfigurationError(f"unknown parameter {name!r}; {hint}")

    def _on_set(self, wanted: list[RosParameter]) -> SetParametersResult:
        for given in wanted:
            parameter = self._parameters.get(given.name)
            if parameter is None:
                continue
            try:
                parameter.checked(given.value)
            except ConfigurationError as err:
                return SetParametersResult(successful=False, reason=str(err))
            if refusal := self._refusal():
                return SetParametersResult(successful=False, reason=f"{given.name!r} {refusal}")
        for given in wanted:
            self._wrong.pop(given.name, None)
        return SetParametersResult(successful=True)


def _rejecting_untyped(set_them: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """Return a callback that refuses a value of unknown type, which rclpy does not answer."""

    def answer(request: Any, response: Any) -> Any:
        for given in request.parameters:
            kind = given.value.type
            if not _TYPES.start <= kind < _TYPES.stop:
                reason = f"{given.name!r} has type {kind}, expected 0 to {_TYPES.stop - 1}"
                refused = SetParametersResult(successful=False, reason=reason)
                if isinstance(response, SetParametersAtomically.Response):
                    response.result = refused
                else:
                    response.results = [refused] * len(request.parameters)
                return response
        return set_them(request, response)

    return answer


def _descriptor(parameter: Parameter) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(description=parameter.text, read_only=parameter.fixed)
    quantity = parameter.quantity
    if quantity is None or quantity.signed:
        return descriptor
    stated = [value for value in (parameter.default, parameter.unset) if value is not None]
    low, high = min(quantity.low, *stated), max(quantity.high, *stated)  # type: ignore[type-var]
    if type(parameter.default) is int:
        descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high), step=0)]
    else:
        span = FloatingPointRange(from_value=float(low), to_value=float(high), step=0.0)
        descriptor.floating_point_range = [span]
    return descriptor


def _acknowledged(publisher: Publisher) -> bool:
    """Return whether all messages have arrived; waits for it 10 ms, with other threads stopped."""
    try:
        return bool(publisher.wait_for_all_acked(_STEP))
    except rclpy_implementation.RCLError:  # a middleware that cannot tell
        time.sleep(_STEP.nanoseconds / 1e9)
        return not publisher.get_subscription_count()


NAMESPACE = "omsm"
ARGUMENTS: dict[str, list[str]] = {}
"""Further arguments for ROS of one of several nodes of a process, by its name."""
# A destroyed publisher drops what its subscribers have not acknowledged, so it waits before that.
# In short steps, since rclpy stops other threads meanwhile. A subscriber that stands still has 1 s.
_STEPS, _STEP = 100, Duration(nanoseconds=10_000_000)
AUTOSTART = Parameter("autostart", True, "configure and activate at the start", fixed=True)


class LifecycleStage(Enum):
    """State of the lifecycle of a node."""

    UNCONFIGURED = "unconfigured"
    INACTIVE = "inactive"
    ACTIVE = "active"
    FINALIZED = "finalized"


class ManagedNode(LifecycleNode):  # type: ignore[misc]
    """A node with a lifecycle.

    name, parameters: of a kind of which there is one node; others are given both
    values: its parameters, once it is configured
    fatal: an error that ends the node, with exit code 2
    closes_last: of the nodes of a process, since the others use what it offers
    hardware: the parameter that names its device, or what stands for one; empty without
    """

    name: ClassVar[str]
    parameters: ClassVar[Sequence[Parameter]]
    closes_last = False
    hardware = ""

    def __init__(self, name: str = "", parameters: Sequence[Parameter] = ()) -> None:
        name, parameters = name or self.name, parameters or self.parameters
        try:
            super().__init__(name, namespace=NAMESPACE, cli_args=ARGUMENTS.get(name))
        except (
            InvalidParameterTypeException
        ) as err:  # of a parameter of rclpy, such as use_sim_time
            raise ConfigurationError(f"{name}: {err}") from err
        except rclpy_implementation.RCLError as err:
            if "invalid" not in str(err):
                raise
            what = str(err).split(", at ")[0]
            raise ConfigurationError(f"{name}: {what}; give another __node or __ns") from err
        self.stage = LifecycleStage.UNCONFIGURED
        self.values: dict[str, Any] = {}
        self._messages = message_mapping.ros_messages()
        self.fatal: OmsmError | None = None
        self._failure: Exception | None = None
        self._configured, self._activated = ExitStack(), ExitStack()
        self._outputs: list[Publisher] = []
        self._declared = DeclaredParameters(self, (*parameters, AUTOSTART), self._keeps_parameters)
        self._answer_impossible_transitions()
        self.diagnostics = Diagnostics(self, self._report, self.hardware_id)
        self.create_service(Trigger, f"~/{topics.PROCESSED}", topics.answer_processed_counts)
        topics.every(self, ExitStack(), RETURN_PERIOD_S, return_free_memory)

    def configure(self, undo: ExitStack) -> None:
        """Make the objects that ``self.values`` describe; raises OmsmError."""

    def activate(self, undo: ExitStack) -> None:
        """Begin to receive and publish data; raises OmsmError."""

    def report(self) -> StateReport:
        """Return the state of a node that is configured."""
        return StateReport("")

    def hardware_id(self) -> str:
        """Return the name of the node's device; empty without one."""
        return str(self.values.get(self.hardware, ""))

    @property
    def active(self) -> bool:
        """Return whether the node is active."""
        return self.stage is LifecycleStage.ACTIVE

    def start(self) -> None:
        """Configure and activate if ``autostart``; raise what prevented it."""
        if not self.get_parameter(AUTOSTART.name).value:
            return
        for step in (self.trigger_configure, self.trigger_activate):
            step()
            if self._failure is not None:
                raise self._failure

    def close(self) -> None:
        """Undo all steps, in reverse order."""
        if self.stage is not LifecycleStage.FINALIZED:
            self.trigger_shutdown()

    def publish_on(
        self, undo: ExitStack, kind: Any, topic: str, qos: QoSProfile = topics.SAMPLES_QOS
    ) -> Publisher:
        """Return a publisher of a topic that no other node should publish."""
        made = topics.publish_on(self, undo, kind, topic, qos)
        self._outputs.append(made)
        undo.callback(self._outputs.remove, made)
        return made

    def set_parameters_atomically(self, parameter_list: list[Any]) -> SetParametersResult:
        """Set all or none; unlike rclpy, name an unknown one."""
        try:
            self._declared.check_known([parameter.name for parameter in parameter_list])
        except ConfigurationError as err:
            return SetParametersResult(successful=False, reason=str(err))
        return super().set_parameters_atomically(parameter_list)

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Configure; called by ``ros2 lifecycle``, as those below."""
        return self._attempt(self._configure, self._configured, LifecycleStage.INACTIVE)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Activate."""
        return self._attempt(self._activate, self._activated, LifecycleStage.ACTIVE)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Undo the activation."""
        return self._end(LifecycleStage.INACTIVE)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Undo the configuration."""
        return self._end(LifecycleStage.UNCONFIGURED)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Undo all steps finally."""
        return self._end(LifecycleStage.FINALIZED)

    def _configure(self) -> None:
        self.values = self._declared.values()
        self.configure(self._configured)

    def _activate(self) -> None:
        self.activate(self._activated)
        self._declared.check_overrides()

    def _attempt(
        self, step: Callable[[], None], undo: ExitStack, reached: LifecycleStage
    ) -> TransitionCallbackReturn:
        self._failure = None
        try:
            step()
        except Exception as err:
            self._failure = err
            if isinstance(err, OmsmError):
                self.get_logger().error(f"{type(err).__name__}: {one_line(err)}")
            else:
                log_internal_error(self, err)
            undo.close()
            return TransitionCallbackReturn.FAILURE
        self.stage = reached
        return TransitionCallbackReturn.SUCCESS

    def _end(self, reached: LifecycleStage) -> TransitionCallbackReturn:
        self._undo(self._activated)
        if reached is not LifecycleStage.INACTIVE:
            self._wait_for_last_messages()
            self._undo(self._configured)
        self.stage = reached
        self._failure = None
        return TransitionCallbackReturn.SUCCESS

    def _undo(self, stack: ExitStack) -> None:
        try:
            stack.close()
        except Exception as err:  # the rest is undone nevertheless
            log_internal_error(self, err)

    def _wait_for_last_messages(self) -> None:
        for _ in range(_STEPS):
            if all(map(_acknowledged, self._outputs)):
                return
        self.get_logger().warning("a subscriber has not received the last messages within 1 s")

    def _answer_impossible_transitions(self) -> None:
        """Let a request for an impossible transition be answered, where rcl raises an exception."""
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
        if self.stage is LifecycleStage.UNCONFIGURED:
            return ""
        return (
            f"takes effect when {self.get_name()} is configured, and it is {self.stage.value}: "
            "`ros2 lifecycle set` it to deactivate and cleanup, set, then configure and activate"
        )

    def _report(self) -> StateReport:
        configured = self.stage is not LifecycleStage.UNCONFIGURED
        report = self.report() if configured else StateReport("")
        if self.stage is not LifecycleStage.ACTIVE:
            report.add(WARN, f"{self.stage.value}: it does nothing until it is activated")
        if self._failure is not None:
            report.add(ERROR, one_line(self._failure))
        for publisher in self._outputs:
            if (count := self.count_publishers(publisher.topic_name)) > 1:
                report.add(
                    WARN,
                    f"{count} nodes publish {publisher.topic_name}: end all but one "
                    "(a killed one disappears within 20 s)",
                )
        report.values["lifecycle"] = self.stage.value
        return report
