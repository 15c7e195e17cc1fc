"""Driver nodes: of probe, axes, reference sensor and accelerometer.

A thread reads the device, and its blocks are published; no fault of the line ends the node.
"""

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from typing import Any

from omsm_msgs import msg
from rclpy.publisher import Publisher
from std_msgs.msg import String
from std_srvs.srv import Trigger

from omsm_ros.core.calibration.calibration import PROBE
from omsm_ros.core.streams.blocks import AccelerationBlock, AxisBlock, Block, DistanceBlock
from omsm_ros.core.streams.monitoring import RecentIncrease, SampleFlow
from omsm_ros.errors import ConfigurationError
from omsm_ros.instruments.factory import make_accelerometer, make_axes, make_device, make_reference
from omsm_ros.instruments.parameters import (
    ACCELEROMETER_PARAMETERS,
    AXIS_PARAMETERS,
    PARAMETERS,
    REFERENCE_PARAMETERS,
)
from omsm_ros.instruments.reader import DeviceReader, State
from omsm_ros.instruments.stream import StreamDevice
from omsm_ros.io import json_and_yaml, message_mapping
from omsm_ros.io.figure_messages import probe_message
from omsm_ros.nodes.background_worker import BackgroundWorker
from omsm_ros.nodes.diagnostics import ERROR, WARN, StateReport
from omsm_ros.nodes.managed import ManagedNode
from omsm_ros.nodes.running import run, serve
from omsm_ros.nodes.topics import FRAME_PREFIX, LATCHED_QOS, publish_on
from omsm_ros.quantities import Parameter

_FAULTS = (
    *("bad", "lost", "losses", "malformed", "restarts"),
    *("spoilt", "period_w", "unknown", "missed", "overruns"),
)
_END_S = 5.0
# A dark reference takes some three seconds; more if the device is slow to answer.
_DARK_REFERENCE_S = 30.0


# Message of a kind of blocks, and the parameter of its frame.
_OUTPUTS: Mapping[type[Block], tuple[type, Parameter]] = {
    AxisBlock: (msg.AxisBlock, Parameter("machine_frame", "machine", "frame of the axes")),
    DistanceBlock: (msg.DistanceBlock, Parameter("probe_frame", "probe", "frame of the distance")),
    AccelerationBlock: (
        msg.AccelerationBlock,
        Parameter("accelerometer_frame", "probe", "frame of the acceleration"),
    ),
}


class DriverNode(ManagedNode):
    """Reads a device and publishes its blocks."""

    hardware = "port"

    def __init__(
        self,
        name: str,
        parameters: Sequence[Parameter],
        make: Callable[[dict[str, Any], Callable[[], int]], StreamDevice],
        topics: Mapping[type[Block], str],
        settings: str | None = None,
    ) -> None:
        """topics: of each kind of blocks;  settings: topic of the probe's settings; None = none."""
        frames = (_OUTPUTS[kind][1] for kind in topics)
        super().__init__(name, (*parameters, *frames, FRAME_PREFIX))
        self._make = make
        self._topics = topics
        self._settings_topic = settings
        self._settings: Publisher | None = None

    def configure(self, undo: ExitStack) -> None:
        """Make the device, not yet connected."""
        self._device = self._make(self.values, lambda: self.get_clock().now().nanoseconds)
        self._reader = DeviceReader(
            self._device,
            self._publish,
            self.get_logger().info,
            self.get_logger().warning,
            connected=self._publish_settings,
        )
        self._recent, self._flow = RecentIncrease(), SampleFlow()
        self._reported: dict[str, object] = {}
        if self._settings_topic:
            self._settings = publish_on(self, undo, String, self._settings_topic, LATCHED_QOS)
            self._plotted = publish_on(self, undo, msg.ProbeSettings, "probe", LATCHED_QOS)
        self._publisher_of = {
            kind: self.publish_on(undo, _OUTPUTS[kind][0], topic)
            for kind, topic in self._topics.items()
            if kind is not AxisBlock or self._device.channels.axes is not None
        }

    def activate(self, undo: ExitStack) -> None:
        """Begin to read the device."""
        stop = threading.Event()
        thread = threading.Thread(target=self._reader.run, args=(stop,), daemon=True)
        undo.callback(thread.join, timeout=_END_S)
        undo.callback(stop.set)
        thread.start()

    def _publish(self, blocks: Sequence[Any]) -> None:
        """Publish blocks, or pairs of them, each on the topic of its kind."""
        self._publish_settings()
        for item in blocks:
            for block in item if isinstance(item, tuple) else (item,):
                if (publisher := self._publisher_of.get(type(block))) is not None:
                    frame = self.values[_OUTPUTS[type(block)][1].name]
                    publisher.publish(message_mapping.block_message(self._messages, block, frame))

    def _publish_settings(self) -> None:
        """Publish changed settings, before the first samples that were taken with them."""
        if self._settings is None:
            return
        named = {"device": self.values["device"], **self._device.settings}
        reported = {f"{PROBE}{name}": value for name, value in named.items()}
        if reported != self._reported:
            self._reported = reported
            self._settings.publish(String(data=json_and_yaml.text_of(reported)))
            now_ns = self.get_clock().now().nanoseconds
            self._plotted.publish(probe_message(self._messages, named, now_ns))

    def report(self) -> StateReport:
        """Return the counts of all samples, and the present faults."""
        counts, now = self._device.counts(), time.monotonic()
        self._flow.update(int(counts["decoded"]), now)
        values: dict[str, object] = {**self._device.identity, "state": self._reader.state.value}
        values |= counts | {"connections": self._reader.connections}
        values["rate_hz"] = round(self._flow.rate, 3)
        for kind, publisher in self._publisher_of.items():
            values[f"{self._topics[kind]}_subscribers"] = publisher.get_subscription_count()
        report = StateReport(f"reading at {self._flow.rate:.6g} Hz", values)
        if self._reader.trouble:
            report.add(ERROR, self._reader.trouble)
        if caution := self._device.caution:
            report.add(WARN, caution)
        self._add_faults(report, counts, now)
        if self._reader.state is State.READING:
            silent, never = self._flow.silent(now), "connected, but no sample has come yet"
            period = self.values["sample_period"]
            report.add_silence(silent, period, "no sample for {:.0f} s", never)
        return report

    def _add_faults(self, report: StateReport, counts: dict[str, float], now: float) -> None:
        faults = {name: n for name, n in counts.items() if name.startswith(_FAULTS)}
        if "restarts" in faults:  # a counter is reset for another measurement
            faults["restarts"] -= counts.get("resets", 0.0)
        if seen := self._recent.update(faults, now):
            text = ", ".join(f"{name} {rise:.0f}" for name, rise in seen.items())
            report.add(WARN, f"just now: {text}")


class ConfocalDriverNode(DriverNode):
    """Reads a probe, with its encoders if it has some, and publishes distance and axes."""

    def __init__(self) -> None:
        super().__init__(
            "confocal_driver",
            PARAMETERS,
            make_device,
            {AxisBlock: "axes", DistanceBlock: "confocal"},
            settings="probe_settings",
        )

    def configure(self, undo: ExitStack) -> None:
        """Make the device, not yet connected, and answer requests."""
        super().configure(undo)
        self._worker = BackgroundWorker(self, undo)
        serve(self, undo, Trigger, "~/dark_reference", self._on_dark_reference)

    async def _on_dark_reference(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> None:
        take = getattr(self._device, "dark_reference", None)
        if take is None:
            raise ConfigurationError(
                f"device {self.values['device']!r} takes no dark reference by command; take "
                "it as the device's manual says"
            )
        light = await self._worker.do(partial(self._reader.ask, take, _DARK_REFERENCE_S))
        stray = f", stray light {light}" if light else ""
        response.success, response.message = True, f"dark reference taken{stray}; identify again"


def _driver(*settings: Any) -> Callable[[], None]:
    return partial(run, partial(DriverNode, *settings))


confocal_driver = partial(run, ConfocalDriverNode)
axis_driver = _driver("axis_driver", AXIS_PARAMETERS, make_axes, {AxisBlock: "axes"})
reference_driver = _driver(
    "reference_driver", REFERENCE_PARAMETERS, make_reference, {DistanceBlock: "reference"}
)
accelerometer_driver = _driver(
    "accelerometer_driver",
    ACCELEROMETER_PARAMETERS,
    make_accelerometer,
    {AccelerationBlock: "acceleration"},
)
