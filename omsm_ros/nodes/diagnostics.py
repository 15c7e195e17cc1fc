"""Publishes the state of a node once a second: its present state as a level, counts as values.

OK: it works.  WARN: it works, but should be checked.  STALE: no input arrives.  ERROR: it cannot
work. Faults that are over are only counted.
"""

import os
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from omsm_ros.errors import DEBUG, defect
from omsm_ros.nodes.topics import every

PERIOD_S = 1.0
OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
STALE = DiagnosticStatus.STALE

_SEVERITY = (OK, WARN, STALE, ERROR)
_COMPLAINT_PERIOD_S = 5.0
# Silence before a report: longer than the pauses of a step test, or five samples [s].
_SILENCE_S, _SILENCE_PERIODS = 2.0, 5
# Number of internal errors of a node, and the line of the last one.
_defects: dict[str, tuple[int, str]] = {}


@dataclass
class StateReport:
    """The state of a node.  message: without findings;  values: counts and figures, by name."""

    message: str
    values: dict[str, object] = field(default_factory=dict)
    findings: list[tuple[bytes, str]] = field(default_factory=list)

    def add(self, level: bytes, text: str) -> None:
        """Add a present finding."""
        self.findings.append((level, text))

    def add_silence(self, silent: float | None, period: float, text: str, never: str = "") -> None:
        """Add ``text``, with the seconds, if ``silent`` is longer than usual.

        silent: time since the last sample [s];  None = before the first: add ``never`` if any
        period: usual time between two samples [s]
        """
        if silent is None and never:
            self.add(STALE, never)
        elif silent is not None and silent > max(_SILENCE_S, _SILENCE_PERIODS * period):
            self.add(STALE, text.format(silent))

    @property
    def level(self) -> bytes:
        """Return the most severe level."""
        return max((level for level, _ in self.findings), key=_SEVERITY.index, default=OK)

    @property
    def text(self) -> str:
        """Return all findings, the most severe first; the message without any."""
        ordered = sorted(self.findings, key=lambda found: -_SEVERITY.index(found[0]))
        return "; ".join(text for _, text in ordered) or self.message


class Diagnostics:
    """Publishes a node's report on ``/diagnostics`` every second of a steady clock."""

    def __init__(
        self, node: Node, report: Callable[[], StateReport], hardware_id: Callable[[], str] = str
    ) -> None:
        """report, hardware_id: called from the node's executor."""
        self._node, self._report, self._hardware_id = node, report, hardware_id
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        every(node, ExitStack(), PERIOD_S, self.publish)

    def publish(self) -> None:
        """Publish now."""
        report = self._report()
        clock = self._node.get_clock()
        if clock.ros_time_is_active and clock.now().nanoseconds == 0:
            report.add(WARN, "use_sim_time is set, but no node publishes /clock: stamps are 0")
        count, last = _defects.get(self._node.get_fully_qualified_name(), (0, ""))
        if count:
            report.values["defects"] = count
            report.add(ERROR, f"{last} ({count} in all)")
        status = DiagnosticStatus(
            level=report.level,
            name=self._node.get_fully_qualified_name(),
            message=report.text,
            hardware_id=self._hardware_id(),
            values=[KeyValue(key=key, value=str(value)) for key, value in report.values.items()],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array)


def log_internal_error(node: Node, err: Exception) -> str:
    """Count and log an internal error; return the line to report."""
    if os.environ.get(DEBUG):
        raise err
    name, line = node.get_fully_qualified_name(), defect(err)
    _defects[name] = (_defects.get(name, (0, ""))[0] + 1, line)
    node.get_logger().error(line, throttle_duration_sec=_COMPLAINT_PERIOD_S)
    return line
