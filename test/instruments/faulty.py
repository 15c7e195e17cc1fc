"""Faults that only tests ask for, added to an emulator of any device."""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from omsm_ros.core.streams.blocks import Status
from omsm_ros.instruments.emulator import Instrument, InstrumentFaults, Measured


@dataclass(slots=True)
class Faults(InstrumentFaults):
    """Counts are used up, ``merge`` lasts until it is set back.

    saturate, drop_out: samples with status SATURATED, and NO_TARGET
    noise: random bytes before the next samples
    cut: bytes missing in the middle of the next ones sent
    garbage_answers: commands answered with random bytes
    ignore_commands: commands without answer
    merge: time for which samples are collected before they are sent [s]
    """

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
        super().__init__(*arguments, **options)
        self.faults = Faults()

    def restart(self) -> None:
        self._kept = b""
        super().restart()

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
            if sent := super()._spoil([piece]):
                self.truth.append((self._taken + i, (self._counter + i) % self.counter_range))
            pieces += sent
        return pieces

    def _measure(self, now: float) -> list[bytes]:
        wire = b"".join(super()._measure(now))
        if now < max(self._off_until, self._quiet_until):
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

    def _exchange(self, now: float, stop: threading.Event | None) -> None:
        # Samples measured before an answer that waited are sent first: no telegram is split.
        if self._later and self._later[0][0] <= now:
            self._send_kept()
        super()._exchange(now, stop)

    def say(self, wire: bytes) -> None:
        if self.faults.use("ignore_commands", 1):
            return
        if self.faults.use("garbage_answers", 1):
            wire = self._random.bytes(len(wire))
        self._send_kept()
        super().say(wire)

    def _send_kept(self) -> None:
        kept, self._kept = self._kept, b""
        self._line.write(kept)


def faulty(emulator: type[Instrument]) -> type[Any]:
    """Return the class of an emulator with these faults."""
    return type(f"Faulty{emulator.__name__}", (Faulty, emulator), {})
