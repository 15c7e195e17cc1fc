"""``cell_emulator``: the cell's six-channel stream on a pseudo-terminal, fed by the twin."""

from __future__ import annotations

import threading
from functools import partial

from rclpy.node import Node
from std_srvs.srv import Trigger

from omsm_ros.emulators.generic_stream import Faults, GenericStreamEmulator
from omsm_ros.emulators.pseudo_terminal import Pty
from omsm_ros.errors import ConfigurationError, OmsmError
from omsm_ros.nodes.running import NAMESPACE, OK, Diagnostics, parameter, run
from omsm_ros.twin.scenario import Scenario, scan_of, step_test_of


class CellEmulatorNode(Node):
    """Plays a motion on request; each motion starts the trigger counter anew.

    Services: ``~/step_test``, ``~/scan`` (std_srvs/Trigger) answer as soon as the motion has
    been worked out and starts; ``~/stop`` ends it.
    """

    def __init__(self) -> None:
        super().__init__("cell_emulator", namespace=NAMESPACE)
        link = parameter(self, "link", "/tmp/omsm_cell", "path of the serial port to offer")
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
        self._faults = Faults(
            seed=self._scenario.seed,
            noise=parameter(self, "fault_noise", 0.0, "noise burst before a frame, probability"),
            flip=parameter(self, "fault_flip", 0.0, "flipped bit in a frame, probability"),
            drop=parameter(self, "fault_drop", 0.0, "frame lost, probability"),
        )
        self._pty = Pty(link)
        self._pty.__enter__()
        self._stop = threading.Event()
        self._player: threading.Thread | None = None
        self._played = 0
        self.create_service(Trigger, "~/step_test", partial(self._start, step_test_of))
        self.create_service(Trigger, "~/scan", partial(self._start, scan_of))
        self.create_service(Trigger, "~/stop", self._on_stop)
        self._diagnostics = Diagnostics(self, self._report, hardware_id=link)
        self.get_logger().info(f"cell at {link}, time lapse {self._time_lapse:g}")

    def _start(self, motion_of, request, response):  # type: ignore[no-untyped-def]
        if self._player is not None and self._player.is_alive():
            response.success, response.message = False, "a motion is running; stop it first"
            return response
        try:
            recording = motion_of(self._scenario)
        except OmsmError as err:
            response.success, response.message = False, str(err)
            return response
        # A new device object: the trigger restarts its counter with each motion.
        emulator = GenericStreamEmulator(self._pty, faults=self._faults)
        self._stop.clear()
        self._played = 0
        self._player = threading.Thread(
            target=emulator.play,
            args=(recording, self._time_lapse, self._stop, self._on_progress),
            daemon=True,
        )
        self._player.start()
        response.success, response.message = True, f"{len(recording.axes)} samples"
        return response

    def _on_progress(self, samples: int) -> None:
        self._played = samples

    def _on_stop(self, request, response):  # type: ignore[no-untyped-def]
        self._halt()
        response.success, response.message = True, f"{self._played} samples played"
        return response

    def _halt(self) -> None:
        self._stop.set()
        if self._player is not None:
            self._player.join(timeout=5.0)

    def _report(self) -> tuple[bytes, str, dict[str, object]]:
        playing = self._player is not None and self._player.is_alive()
        return OK, "playing" if playing else "waiting", {"samples_played": self._played}

    def close(self) -> None:
        """End the motion and withdraw the port."""
        self._halt()
        self._pty.__exit__(None, None, None)


def main() -> None:
    """Entry point of ``ros2 run omsm_ros cell_emulator``."""
    run(CellEmulatorNode)


if __name__ == "__main__":
    main()
