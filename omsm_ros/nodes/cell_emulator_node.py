"""``cell_emulator``: the cell's probe and encoders on an emulated port, fed by the twin."""

from __future__ import annotations

from functools import partial

from rclpy.node import Node
from std_srvs.srv import Trigger

from omsm_ros.emulators.generic_stream import Faults
from omsm_ros.emulators.players import emulated, line_for
from omsm_ros.errors import ConfigurationError, OmsmError
from omsm_ros.nodes.running import NAMESPACE, OK, Diagnostics, parameter, run
from omsm_ros.storage.disturbance_file import load_disturbances
from omsm_ros.twin.disturbances import NOTHING
from omsm_ros.twin.scenario import Scenario, scan_of, step_test_of


class CellEmulatorNode(Node):
    """Plays a motion on request; each motion starts the trigger counter anew.

    Services: ``~/step_test``, ``~/scan`` (std_srvs/Trigger) answer as soon as the motion has
    been worked out and starts; ``~/stop`` ends it.
    """

    def __init__(self) -> None:
        super().__init__("cell_emulator", namespace=NAMESPACE)
        link = parameter(
            self, "link", "/tmp/omsm_cell", "serial port to offer, or tcp://127.0.0.1:PORT"
        )
        self._time_lapse = parameter(
            self, "time_lapse", 1.0, "how much faster than real time to play [1]"
        )
        if not self._time_lapse > 0:
            raise ConfigurationError(f"time_lapse {self._time_lapse!r} must be positive")
        self._scenario = Scenario(
            seed=parameter(self, "seed", 1, "seed of all noise"),
            spindle_speed=parameter(self, "spindle_speed", 30.0, "[rpm], negative reverses"),
            feed_per_turn=parameter(self, "feed_per_turn", 1e-4, "radial feed [m]"),
            start_radius=parameter(self, "start_radius", 12.7e-3, "start of the spiral [m]"),
            step_rise=parameter(self, "step_rise", 20e-3, "edge of the step test [s], 0 = sharp"),
            sample_period=parameter(self, "sample_period", 1e-3, "of the trigger [s]"),
        )
        file = parameter(self, "disturbances", "", "file of what is wrong with the machine")
        self._disturbances = load_disturbances(file) if file else NOTHING
        faults = Faults(
            seed=self._scenario.seed,
            noise=parameter(self, "fault_noise", 0.0, "noise burst before a frame, probability"),
            flip=parameter(self, "fault_flip", 0.0, "flipped bit in a frame, probability"),
            drop=parameter(self, "fault_drop", 0.0, "frame lost, probability"),
        )
        device = parameter(self, "device", "six_channel", "what to imitate, as in the driver")
        self._line = line_for(link)
        self._line.__enter__()
        self._player = emulated(device).player(self._line, faults)
        self.create_service(Trigger, "~/step_test", partial(self._start, step_test_of))
        self.create_service(Trigger, "~/scan", partial(self._start, scan_of))
        self.create_service(Trigger, "~/stop", self._on_stop)
        self._diagnostics = Diagnostics(self, self._report, hardware_id=link)
        self.get_logger().info(f"cell at {link}, time lapse {self._time_lapse:g}")

    def _start(self, motion_of, request, response):  # type: ignore[no-untyped-def]
        if self._player.playing:
            response.success, response.message = False, "a motion is running; stop it first"
            return response
        try:
            recording = motion_of(self._scenario, self._disturbances)
        except OmsmError as err:
            response.success, response.message = False, str(err)
            return response
        self._player.start(recording, self._time_lapse)
        response.success, response.message = True, f"{len(recording.axes)} samples"
        return response

    def _on_stop(self, request, response):  # type: ignore[no-untyped-def]
        self._player.halt()
        response.success, response.message = True, f"{self._player.played} samples played"
        return response

    def _report(self) -> tuple[bytes, str, dict[str, object]]:
        words = "playing" if self._player.playing else "waiting"
        return OK, words, {"samples_played": self._player.played}

    def close(self) -> None:
        """End the motion and withdraw the port."""
        self._player.close()
        self._line.__exit__(None, None, None)


def main() -> None:
    """Entry point of ``ros2 run omsm_ros cell_emulator``."""
    run(CellEmulatorNode)


if __name__ == "__main__":
    main()
