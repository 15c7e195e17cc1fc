"""``cell_emulator``: emulates probe and encoders of a cell on a port, with data of the twin."""

from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from omsm_msgs.action import Scan
from omsm_msgs.msg import AccelerationBlock
from rclpy.task import Future
from std_srvs.srv import Trigger

from omsm_ros import quantities
from omsm_ros.errors import ConfigurationError, OmsmError, shortened
from omsm_ros.instruments.emulator import InstrumentFaults
from omsm_ros.instruments.emulator_factory import (
    EMULATED,
    AccelerationFeed,
    emulated,
    line_for,
    player_for,
)
from omsm_ros.io import message_mapping
from omsm_ros.io.descriptions import load_disturbances
from omsm_ros.io.files import exclusive_lock, runtime_folder
from omsm_ros.nodes.background_worker import Cancelled, Goal, serve_action
from omsm_ros.nodes.diagnostics import StateReport
from omsm_ros.nodes.managed import ManagedNode
from omsm_ros.nodes.running import run, serve
from omsm_ros.nodes.topics import every
from omsm_ros.quantities import Parameter
from omsm_ros.twin.scenario import Scenario, planned_test_of, scan_of, verifying_scan_of
from omsm_ros.twin.sensors import ReferenceSensor

_SCENARIO = (
    Parameter("seed", 1, "seed of all noise", quantities.SEED),
    Parameter("spindle_speed", 30.0, "[rpm], negative reverses", quantities.SPEED),
    Parameter("feed_per_turn", 1e-4, "radial feed [m]", quantities.LENGTH),
    Parameter("start_radius", 12.7e-3, "start of the spiral [m]", quantities.LENGTH),
    Parameter("step_rise", 20e-3, "edge of the step test [s]; 0 = sharp", quantities.RISE, unset=0),
    Parameter("sample_period", 1e-3, "of the trigger [s]", quantities.SAMPLE_PERIOD),
)
_ACCELERATION_PERIOD_S, _FEEDBACK_PERIOD_S = 0.05, 0.2
_MOTIONS: dict[str, Any] = {
    Scan.Goal.STEP_TEST: planned_test_of,
    Scan.Goal.SCAN: scan_of,
    Scan.Goal.VERIFYING_SCAN: verifying_scan_of,
}
_FAULTS = (
    Parameter("fault_noise", 0.0, "noise burst before a frame", quantities.PROBABILITY),
    Parameter("fault_flip", 0.0, "flipped bit in a frame", quantities.PROBABILITY),
    Parameter("fault_drop", 0.0, "frame lost", quantities.PROBABILITY),
)
PARAMETERS = (
    Parameter(
        "device", "six_channel", "the device to emulate, as in the driver", choices=tuple(EMULATED)
    ),
    Parameter(
        "link", "", "serial port to offer, or tcp://127.0.0.1:PORT; empty = in a private folder"
    ),
    Parameter("link_beside", "", "of the second device, where the cell has one; as `link`"),
    Parameter("time_lapse", 1.0, "how much faster than real time to play", quantities.TIME_LAPSE),
    *_SCENARIO,
    Parameter("disturbances", "", "file of the errors of the simulated machine"),
    *_FAULTS,
)


class CellEmulatorNode(ManagedNode):
    """Plays a motion on request; each motion resets the trigger counter.

    An ``accelerometer`` among the disturbances is published on ``acceleration``.

    Services: ``~/step_test``, ``~/scan``, ``~/verifying_scan`` (std_srvs/Trigger; the last one
    scans from beyond the centre at twice the speed) answer as soon as the motion starts; ``~/stop``
    ends it. The action ``~/scan`` ends with the motion, and stops it when it is cancelled.
    """

    name, parameters = "cell_emulator", PARAMETERS
    closes_last = True  # or a driver would report that it lost its port
    _link = ""

    def hardware_id(self) -> str:
        """Return the port."""
        return self._link

    def configure(self, undo: ExitStack) -> None:
        """Offer the port, and answer requests."""
        values = self.values
        self._scenario = Scenario(**{p.name: values[p.name] for p in _SCENARIO})
        self._disturbances = load_disturbances(values["disturbances"] or None)
        second = emulated(values["device"]).second
        if second and second.node == "reference_driver" and not self._disturbances.reference:
            self._disturbances = replace(self._disturbances, reference=ReferenceSensor())
        rates = {f"{p.name.removeprefix('fault_')}_rate": values[p.name] for p in _FAULTS}
        self._link = values["link"] or str(runtime_folder(self.get_namespace()) / "cell")
        lines = _line(undo, self._link), self._second_line(undo)
        faults = InstrumentFaults(**rates)
        self._player = player_for(values["device"], *lines, faults, values["seed"])
        undo.callback(self._player.close)
        for name in _MOTIONS:
            serve(self, undo, Trigger, f"~/{name}", partial(self._on_start, name))
        serve(self, undo, Trigger, "~/stop", self._on_stop)
        serve_action(self, undo, Scan, "~/scan", self._on_scan)
        self._acceleration_lines = self.publish_on(undo, AccelerationBlock, "acceleration")
        self._feed: AccelerationFeed | None = None
        self.get_logger().info(f"cell at {self._link}, time lapse {values['time_lapse']:g}")

    def _second_line(self, undo: ExitStack) -> Any:
        device = self.values["device"]
        if (second := emulated(device).second) is None:
            return None
        link = self.values["link_beside"]
        if second.tcp and not link:
            raise ConfigurationError(f"device {device!r} needs a link_beside: tcp://127.0.0.1:PORT")
        return _line(undo, link or f"{self._link}_beside")

    def activate(self, undo: ExitStack) -> None:
        """Accept requests for motions."""
        undo.callback(self._player.halt)
        every(self, undo, _ACCELERATION_PERIOD_S, self._publish_acceleration)

    def _publish_acceleration(self) -> None:
        block = self._feed.due(self._player.played) if self._feed else None
        if block is not None:
            self._acceleration_lines.publish(message_mapping.block_message(self._messages, block))

    def _start(self, motion: str) -> int:
        """Start a motion and return its number of samples; OmsmError if it is not possible."""
        if motion not in _MOTIONS:
            raise ConfigurationError(
                f"motion {shortened(motion, 40)!r}, expected one of {[*_MOTIONS]}"
            )
        if not self.active:
            raise OmsmError("the emulator is inactive; activate it, and call again")
        if self._player.playing:
            raise OmsmError("a motion is running; wait until it has ended, or stop it")
        recording = _MOTIONS[motion](self._scenario, self._disturbances)
        self._feed = AccelerationFeed(recording, self.get_clock().now().nanoseconds)
        self._player.start(recording, self.values["time_lapse"])
        return len(recording.axes)

    def _on_start(self, motion: str, request: Any, response: Any) -> None:
        samples = self._start(motion)
        response.success, response.message = True, f"{samples} samples"

    async def _on_scan(self, request: Scan.Goal, result: Scan.Result, goal: Goal) -> None:
        samples, over = self._start(request.motion), Future()

        def look() -> None:
            try:
                goal.attend(played=self._player.played, samples=samples)
            except Cancelled as err:
                self._player.halt()
                over.set_exception(err)
            if not self._player.playing and not over.done():
                over.set_result(None)

        try:
            with ExitStack() as undo:
                every(self, undo, _FEEDBACK_PERIOD_S, look)
                await over
        finally:
            result.samples = self._player.played
        result.success = result.samples == samples
        result.message = f"{result.samples} of {samples} samples played"

    def _on_stop(self, request: Any, response: Any) -> None:
        self._player.halt()
        response.success, response.message = True, f"{self._player.played} samples played"

    def report(self) -> StateReport:
        """Return whether a motion is played, and how fast."""
        lapse = self.values["time_lapse"]
        faster = f", {lapse:g} times as fast as the machine" if lapse != 1 else ""
        words = f"playing{faster}" if self._player.playing else "waiting"
        return StateReport(words, {"samples_played": self._player.played, "time_lapse": lapse})


def _line(undo: ExitStack, link: str) -> Any:
    if not link.startswith("tcp://"):
        undo.enter_context(exclusive_lock(Path(link)))
    return undo.enter_context(line_for(link))


main = partial(run, CellEmulatorNode)
