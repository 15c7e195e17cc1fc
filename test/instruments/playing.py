"""A stream that plays on its own thread, and one who keeps what it says."""

from __future__ import annotations

import math
import threading

from omsm_ros.instruments.six_channel.emulator import GenericStreamEmulator, PlayedCounts
from omsm_ros.twin.cell import Recording

SOON = 10.0
EVERY_FAULT = {"noise": 0.03, "flip": 0.03, "truncate": 0.03, "drop": 0.03, "duplicate": 0.03}


class Sink:
    """In place of a Pty: keeps what is written, accepts at most ``capacity`` bytes."""

    def __init__(self, capacity: float = math.inf, has_reader: bool = True) -> None:
        self.data = b""
        self.writes: list[int] = []
        self.capacity, self.has_reader = capacity, has_reader

    def write(self, data: bytes, stop: threading.Event | None = None) -> int:
        taken = int(min(len(data), self.capacity - len(self.data)))
        self.data += data[:taken]
        self.writes.append(taken)
        return taken


class Playing:
    """An emulator at work in a thread of its own, ended with the ``with`` block."""

    def __init__(
        self, emulator: GenericStreamEmulator, recording: Recording, time_lapse: float = math.inf
    ) -> None:
        self.stop = threading.Event()
        self.progress = 0
        self.played = PlayedCounts()
        self._arguments = (emulator, recording, time_lapse)
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Playing:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop.set()
        self._thread.join(SOON)
        assert not self._thread.is_alive()

    @property
    def done(self) -> bool:
        return not self._thread.is_alive()

    def _run(self) -> None:
        emulator, recording, time_lapse = self._arguments
        self.played = emulator.play(recording, time_lapse, self.stop, self._note)

    def _note(self, samples: int) -> None:
        self.progress = samples
