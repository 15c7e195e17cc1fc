"""``vibration_monitor``: measures vibration and its effect on heights."""

import time
from contextlib import ExitStack
from functools import partial
from typing import Any

from omsm_msgs.msg import AccelerationBlock
from omsm_msgs.msg import VibrationLevels as LevelsMessage
from std_msgs.msg import String

from omsm_ros import quantities
from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.ripple.accelerometer import (
    AXES,
    PROBE,
    SLIDE,
    Alarm,
    MonitorOptions,
    RunningSpectrum,
)
from omsm_ros.core.streams.monitoring import RecentIncrease, SampleFlow
from omsm_ros.errors import ConfigurationError, OmsmError
from omsm_ros.io import json_and_yaml, message_mapping
from omsm_ros.io.calibration_file import load_calibration
from omsm_ros.io.figure_messages import vibration_message
from omsm_ros.nodes.calibration_topic import CalibrationTopic
from omsm_ros.nodes.diagnostics import STALE, WARN, StateReport
from omsm_ros.nodes.managed import ManagedNode
from omsm_ros.nodes.running import run
from omsm_ros.nodes.topics import MessageInfo, listen, publish_on
from omsm_ros.quantities import Parameter
from omsm_ros.readable import quantity

PARAMETERS = (
    Parameter("bands", "5 50 150 500 2000", "edges of the bands, rising [Hz]"),
    Parameter("window", 1.0, "length of a spectrum [s]", quantities.WAIT),
    Parameter("averages", 4, "spectra over which levels are averaged", quantities.COUNT),
    Parameter("mount", PROBE, "where the accelerometer sits", choices=(PROBE, SLIDE)),
    Parameter("axis", "z", "along which a height is measured", choices=AXES),
    Parameter("alarm", 20e-9, "effect on a height at which to warn, rms [m]", quantities.STEP),
    Parameter("release", 0.7, "share of it below which the alarm ends", quantities.PROBABILITY),
    Parameter("calibration", "", "file with the response; empty = that of the topic alone"),
)


class VibrationMonitorNode(ManagedNode):
    """Subscribes to ``acceleration`` and ``calibration``; publishes levels on ``vibration``."""

    name, parameters = "vibration_monitor", PARAMETERS

    def configure(self, undo: ExitStack) -> None:
        """Set options, alarm and calibration."""
        values = self.values
        self._running = RunningSpectrum(
            MonitorOptions(
                edges=_edges(values["bands"]),
                window=values["window"],
                averages=values["averages"],
                mount=values["mount"],
                axis=values["axis"],
            )
        )
        self._alarm = Alarm(values["alarm"], values["release"])
        self._refused, self._blocks_refused = "", 0
        self._lately = RecentIncrease()
        self._flow, self._block = SampleFlow(), 0.0
        self._calibration: Calibration | None = None
        self._topic = CalibrationTopic(self, undo, self._use, listens=True)
        if path := values["calibration"]:
            self._calibration = load_calibration(path)

    def activate(self, undo: ExitStack) -> None:
        """Begin to receive and publish."""
        self._task_result = 0
        self._publisher = publish_on(self, undo, String, "vibration")
        self._plotted = publish_on(self, undo, LevelsMessage, "vibration_levels")
        listen(self, undo, AccelerationBlock, "acceleration", self._take)

    def _use(self, calibration: Calibration, _: int) -> None:
        self._calibration = calibration

    def _take(self, message: Any, _: MessageInfo) -> None:
        try:
            block = message_mapping.block_of(message)
            self._running.push(block)
        except OmsmError as err:
            self._refused = str(err)
            self._blocks_refused += 1
            return
        self._block = len(block) * block.sample_period
        levels = self._levels()
        was = self._alarm.raised
        if levels is not None and self._alarm.update(levels.height_total) != was:
            text = "raised" if self._alarm.raised else "ended"
            self.get_logger().warning(f"vibration alarm {text}: {self._line(levels)}")
        # Once for each spectrum, also with short blocks.
        if levels is not None and levels.windows != self._task_result:
            self._task_result = levels.windows
            content = {**levels.entry(), "alarm": self._alarm.raised, "limit": self._alarm.limit}
            self._publisher.publish(String(data=json_and_yaml.text_of(content)))
            alarm = self._alarm
            self._plotted.publish(
                vibration_message(self._messages, levels, alarm.raised, alarm.limit, message.header)
            )

    def _levels(self) -> Any:
        known = self._calibration
        return self._running.levels(known.dynamics if known else None)

    def _line(self, levels: Any) -> str:
        axis, frequency, size = levels.line
        line = f"{quantity(size, 'm/s²')} along {axis} at {quantity(frequency, 'Hz', 4)}"
        if levels.height_line is None:
            return f"strongest line {line}"
        return (
            f"{quantity(levels.height_total, 'm')} rms on a height, most of it at "
            f"{quantity(levels.height_line[0], 'Hz', 4)}; strongest line {line}"
        )

    def report(self) -> StateReport:
        """Return levels by band and axis, the effect on a height, and the alarm."""
        running, levels = self._running, self._levels()
        report = StateReport("listening", {
            "samples": running.received, "samples_lost": running.lost,
            "restarts": running.restarts, "alarms": self._alarm.times,
            "alarm": self._alarm.raised,
        })  # fmt: skip
        if levels is None:
            report.add(STALE, "no full window of acceleration yet")
        else:
            report.message = self._line(levels)
            report.values.update(_figures(levels))
            if self.values["mount"] == SLIDE and self._calibration is not None:
                report.values["response_valid_up_to"] = self._calibration.valid_up_to
            if self._alarm.raised:
                report.add(WARN, f"vibration beyond {quantity(self._alarm.limit, 'm')}: "
                                 f"{self._line(levels)}")  # fmt: skip
            if levels.height is None:
                report.add(WARN, "effect on a height not evaluated: no calibration yet")
        now = time.monotonic()
        self._flow.update(running.received, now)
        text = "no acceleration for {:.0f} s; the levels are of before"
        report.add_silence(self._flow.silent(now), self._block, text)
        refused = {"blocks_refused": self._blocks_refused}
        report.values |= refused
        if self._lately.update(refused, now):
            report.add(WARN, f"a block was refused: {self._refused}")
        return report


def _figures(levels: Any) -> dict[str, object]:
    found: dict[str, object] = {"windows": levels.windows}
    for place, (low, high) in enumerate(levels.bands):
        band = f"{low:g}_{high:g}_hz"
        for axis in AXES:
            found[f"rms_{axis}_{band}"] = levels.rms[axis][place]
        if levels.height is not None:
            found[f"height_{band}"] = levels.height[place]
    axis, frequency, size = levels.line
    found |= {"line_axis": axis, "line_frequency": frequency, "line_amplitude": size}
    if levels.height_line is not None:
        found |= dict(
            zip(("height_line_frequency", "height_line_amplitude"), levels.height_line, strict=True)
        )
    return found | {"height": levels.height_total}


def _edges(text: str) -> tuple[float, ...]:
    try:
        return tuple(float(word) for word in text.split())
    except ValueError as err:
        raise ConfigurationError(
            f"parameter 'bands' is {text!r}, expected numbers in Hz with spaces between"
        ) from err


main = partial(run, VibrationMonitorNode)
