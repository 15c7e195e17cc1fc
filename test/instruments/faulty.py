"""Faults that only tests ask for, added to an emulator of any device."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from omsm_ros.core.streams.blocks import Status
from omsm_ros.errors import DeviceError
from omsm_ros.instruments.emulator import Instrument, InstrumentFaults, Measured


class NumberedSource:
    """Supplies samples without end; sample k is at x = k nm, so it can be identified.

    All channels follow from k: see ``NumberedSource.take``.
    """

    length, period = math.inf, 1e-3

    def take(self, first: int, count: int) -> Measured:
        """Return distance (10 + k mod 80) µm, y -k nm, z k mod 1000 µm, b k µrad, c k mrad."""
        k = np.arange(first, first + count, dtype=np.float64)
        return Measured(
            (10 + k % 80) * 1e-6,
            np.full(count, 0.5, np.float32),
            np.full(count, Status.OK, np.uint8),
            {"x": k * 1e-9, "y": -k * 1e-9, "z": k % 1000 * 1e-6, "b": k * 1e-6, "c": k * 1e-3},
        )


@dataclass(slots=True)
class Faults(InstrumentFaults):
    """Counts are used up, ``merge`` and ``slow_answers`` last until they are set back.

    lose, duplicate: samples not sent, sent twice
    slow_answers: delay of answers [s]
    saturate, drop_out: samples with status SATURATED, and NO_TARGET
    noise: random bytes before the next samples
    cut: bytes missing in the middle of the next ones sent
    garbage_answers: commands answered with random bytes
    ignore_commands: commands without answer
    merge: time for which samples are collected before they are sent [s]
    """

    lose: int = 0
    duplicate: int = 0
    slow_answers: float = 0.0
    saturate: int = 0
    drop_out: int = 0
    noise: int = 0
    cut: int = 0
    garbage_answers: int = 0
    ignore_commands: int = 0
    merge: float = 0.0

    def use(self, name: str, most: int) -> int:
        """Return how many of ``name`` occur now, at most ``most``."""
        used: int = min(getattr(self, name), most)
        setattr(self, name, getattr(self, name) - used)
        return used


class Faulty(Instrument):
    """Derive from this and from an emulator: see ``faulty``.

    truth: ``(true number, device counter)`` of each sample sent, in order; the true number counts
        triggers since the source began
    """

    faults: Faults

    def __init__(self, *arguments: Any, **options: Any) -> None:
        self.truth: list[tuple[int, int]] = []
        self._clock_offset = 0
        self._kept, self._kept_since = b"", 0.0
        self._quiet_until = self._off_until = 0.0
        self._unplugged = False
        self._later: list[tuple[float, bytes]] = []
        super().__init__(*arguments, **options)
        if not (self._source or self._triggered):
            self._source = NumberedSource()
        self.faults = Faults()

    def unplug(self, seconds: float) -> None:
        """Disconnect the line for ``seconds``; the device continues to measure."""
        self._off_until = self._clock() + seconds
        self._line.unplug()
        self._unplugged = True

    def power_cycle(self, seconds: float) -> None:
        """Switch off for ``seconds``, then on with factory settings and a counter at zero."""
        self.unplug(seconds)
        self.restart()
        self._started = self._off_until

    def restart(self) -> None:
        """Set settings and counter as after switching on; the line stays connected."""
        self._kept, self._counter = b"", 0
        self._later.clear()
        self._started = self._clock()
        self.reset()

    def reset_counter(self) -> None:
        """Count from zero again, as upon a trigger command."""
        self._counter = 0

    def stall(self, seconds: float) -> None:
        """Stop sending and answering for ``seconds``; samples of that time are lost."""
        self._quiet_until = self._clock() + seconds

    def streaming(self) -> bool:
        return super().streaming() and not self._stopped(self._clock())

    def _stopped(self, now: float) -> bool:
        return now < max(self._off_until, self._quiet_until)

    def step(self, stop: threading.Event | None = None) -> None:
        now = self._clock()
        if self._unplugged and now >= self._off_until:
            self._line.plug()
            self._unplugged = False
        if self._stopped(now):
            self._measure(now)
            return
        try:
            # Samples measured before an answer that waited are sent first: no telegram is split.
            if self._later and self._later[0][0] <= now:
                self._send_kept()
            super().step(stop)
        except (DeviceError, OSError):
            # Another thread may unplug the line while it is in use.
            if self._clock() >= self._off_until:
                raise

    def greet(self) -> None:
        self._later.clear()
        super().greet()

    def step_clock(self, nanoseconds: int) -> None:
        """Set the device's clock ahead."""
        self._clock_offset += nanoseconds

    def pack(self, measured: Measured, counters: np.ndarray, times_ns: np.ndarray) -> list[bytes]:
        status, distance = measured.status.copy(), measured.distance.copy()
        intensity = measured.intensity.copy()
        saturated = self.faults.use("saturate", len(measured))
        status[:saturated] = Status.SATURATED
        count = self.faults.use("drop_out", len(measured) - saturated)
        lost = slice(saturated, saturated + count)
        status[lost], distance[lost], intensity[lost] = Status.NO_TARGET, np.nan, 0.0
        seen = replace(measured, status=status, distance=distance, intensity=intensity)
        return super().pack(seen, counters, times_ns + self._clock_offset)

    def _spoil(self, packed: list[bytes]) -> list[bytes]:
        pieces: list[bytes] = []
        for i, piece in enumerate(packed):
            sent = super()._spoil([piece])
            if not sent or (piece and self.faults.use("lose", 1)):
                continue
            self.truth.append((self._taken + i, (self._counter + i) % self.counter_range))
            pieces += sent * (1 + self.faults.use("duplicate", 1))
        return pieces

    def _measure(self, now: float) -> list[bytes]:
        if now < self._started:
            self._origin = now
            return []
        while self._later and self._later[0][0] <= now and not self._stopped(now):
            self._line.write(self._later.pop(0)[1])
        wire = b"".join(super()._measure(now))
        if self._stopped(now):
            return []
        if self.faults.noise and wire:
            wire = self._random.bytes(self.faults.use("noise", 1 << 20)) + wire
        if self.faults.cut and len(wire) > self.faults.cut:
            place = len(wire) // 2
            wire = wire[:place] + wire[place + self.faults.use("cut", len(wire)) :]
        if self.faults.merge:
            self._kept_since = self._kept_since if self._kept else now
            self._kept += wire
            if now - self._kept_since < self.faults.merge:
                return []
            wire = b""
        wire, self._kept = self._kept + wire, b""
        return [wire]

    def say(self, wire: bytes) -> None:
        if self.faults.use("ignore_commands", 1):
            return
        if self.faults.use("garbage_answers", 1):
            wire = self._random.bytes(len(wire))
        self._send_kept()
        if self.faults.slow_answers or self._later:
            self._later.append((self._clock() + self.faults.slow_answers, wire))
        else:
            super().say(wire)

    def _send_kept(self) -> None:
        kept, self._kept = self._kept, b""
        self._line.write(kept)


def faulty(emulator: type[Instrument]) -> type[Any]:
    """Return the class of an emulator with these faults."""
    return type(f"Faulty{emulator.__name__}", (Faulty, emulator), {})
