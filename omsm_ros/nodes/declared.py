"""A node's parameters as ROS sees them: declared once, checked at each door, no others."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Sequence
from typing import Any

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    ParameterType,
    SetParametersResult,
)
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from omsm_ros.errors import ConfigurationError, shortened
from omsm_ros.parameters import Parameter

_QOS_PREFIX = "qos_overrides."
# Of a name that is none, in an answer.
_MOST_CHARACTERS = 80
_TYPES = range(ParameterType.PARAMETER_NOT_SET, ParameterType.PARAMETER_STRING_ARRAY + 1)


class Declared:
    """Declares ``parameters`` on ``node``; one that is wrong keeps the node from being configured.

    refusal: why no parameter may be set now; empty if they may
    """

    def __init__(
        self, node: Node, parameters: Sequence[Parameter], refusal: Callable[[], str]
    ) -> None:
        self._node, self._refusal = node, refusal
        self._parameters = {parameter.name: parameter for parameter in parameters}
        self._wrong: dict[str, ConfigurationError] = {}
        # rclpy ignores what is given but never declared; here it is an error.
        self._given = dict(node._parameter_overrides)
        for parameter in parameters:
            self._declare(parameter)
        node.add_on_set_parameters_callback(self._on_set)
        for service in node.services:
            if service.srv_type in (SetParameters, SetParametersAtomically):
                service.callback = _of_types_that_are(service.callback)

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
        """Return every parameter by name.

        Raises ConfigurationError for one that is wrong, missing, or known to nobody.
        """
        try:
            for err in self._wrong.values():
                raise err
            self.check_known([name for name in self._given if not name.startswith(_QOS_PREFIX)])
            return {
                name: parameter.checked(self._node.get_parameter(name).value)
                for name, parameter in self._parameters.items()
            }
        except ConfigurationError as err:
            raise ConfigurationError(f"{self._node.get_name()}: {err}") from err

    def check_overrides(self) -> None:
        """Raise ConfigurationError for a qos_overrides.* of a topic that the node does not have."""
        self.check_known([name for name in self._given if name.startswith(_QOS_PREFIX)])

    def check_known(self, names: Sequence[str]) -> None:
        """Raise ConfigurationError for one that the node does not have, with the nearest one."""
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


def _of_types_that_are(
    set_them: Callable[[Any, Any], Any],
) -> Callable[[Any, Any], Any]:
    """Return a callback that refuses a value of no type, which rclpy would leave unanswered."""

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
