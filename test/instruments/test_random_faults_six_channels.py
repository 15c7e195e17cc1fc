"""Random sequences of faults of the six-channel stream, from a line and from a PLC's ring."""

from __future__ import annotations

import ctypes
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from loopback import Loopback

from omsm_ros.instruments.emulator import Instrument, Measured
from omsm_ros.instruments.scaling import AXES
from omsm_ros.instruments.six_channel.device import GenericStreamDevice, StreamSettings
from omsm_ros.instruments.six_channel.emulator import SixChannelEmulator
from omsm_ros.instruments.six_channel.latches import AdsRing
from omsm_ros.instruments.six_channel.protocol import FRAME, FrameArray, StreamScaling

from .conftest import Bench
from .faulty import faulty
from .test_random_faults import (
    LASTS_S,
    MEMORY_FAULTS,
    NOTICED_S,
    Kind,
    Story,
    play,
    sequences,
    stories,
)

SCALING = StreamScaling()
RECORD = "<u4,<u8,<i4,u1,(5,)<i8"  # as the PLC writes it, without the check
RECORD_BYTES, RING_SAMPLES, PERIOD_S = 57, 1000, 1e-3


def frames_of(measured: Measured, counters: np.ndarray, times_ns: np.ndarray) -> FrameArray:
    frames = np.zeros(len(measured), FRAME)
    frames["sequence"], frames["device_time"] = counters, times_ns
    frames["status"] = measured.status
    frames["distance"] = SCALING.probe.counts(measured.distance)
    for i, (name, axis) in enumerate(zip(AXES, SCALING.axes, strict=True)):
        frames["counts"][:, i] = axis.counts(measured.axes[name])
    return frames


class Ring:
    """A PLC's memory, in place of a line: what is written stays, and is read whole."""

    def __init__(self, loop: Loopback) -> None:
        self._loop = loop
        self.clear()

    has_reader, sessions = True, 0

    def clear(self) -> None:
        self.written, self._image = 0, bytearray(RING_SAMPLES * RECORD_BYTES)

    def plug(self) -> None:
        self._loop.plug()

    def unplug(self) -> None:
        self._loop.unplug()

    def read(self) -> bytes:
        return b""

    def write(self, data: bytes, stop: object = None) -> int:
        for start in range(0, len(data), RECORD_BYTES):
            place = self.written % RING_SAMPLES * RECORD_BYTES
            self._image[place : place + RECORD_BYTES] = data[start : start + RECORD_BYTES]
            self.written += 1
        return len(data)

    def read_by_name(self, symbol: str, kind: Any, **_: Any) -> bytes:
        if not self._loop.has_reader:
            raise OSError("no route")
        if ctypes.sizeof(kind) > 8 + len(self._image):
            raise OSError("parameter size not correct")
        return self.written.to_bytes(8, "little") + bytes(self._image)


class Plc(Instrument):
    """Writes a record a trigger; one that is restarted begins with an empty ring."""

    counter_range = 2**32

    def __init__(self, ring: Ring, **options: Any) -> None:
        self._ring = ring
        super().__init__(ring, **options)  # type: ignore[arg-type]

    def reset(self) -> None:
        self._ring.clear()

    def pack(self, measured: Measured, counters: np.ndarray, times_ns: np.ndarray) -> list[bytes]:
        records = np.zeros(len(measured), RECORD)
        for target, source in zip(
            records.dtype.names or (),
            ("sequence", "device_time", "distance", "status", "counts"),
            strict=True,
        ):
            records[target] = frames_of(measured, counters, times_ns)[source]
        assert records.itemsize == RECORD_BYTES
        return [record.tobytes() for record in records]


class SimulatedRing(AdsRing):
    """The driver's side, on simulated time."""

    def __init__(self, loop: Loopback) -> None:
        super().__init__(f"ads://127.0.0.1?samples={RING_SAMPLES}")
        self._loop = loop

    def read(self, timeout: float) -> bytes:
        deadline = self._loop.clock.now + timeout
        while not (data := self._new()) and self._loop.clock.now < deadline:
            self._loop.wait(0.02)
        return data


def ring_bench(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Make a bench whose device reads a ring through what stands for pyads."""

    def make(emulator: type, device: type, settings: StreamSettings, **options: Any) -> Bench:
        loop = Loopback(interval=options.pop("interval"))
        ring = Ring(loop)
        connected = SimpleNamespace(
            open=loop.open,
            close=loop.close,
            read_by_name=ring.read_by_name,
            set_timeout=lambda _: None,
        )
        router = SimpleNamespace(create_connection=lambda *_: SimpleNamespace(close=lambda: None))
        monkeypatch.setattr("omsm_ros.instruments.six_channel.latches.socket", router)
        fake = SimpleNamespace(Connection=lambda *_: connected, ADSError=OSError)
        monkeypatch.setattr("omsm_ros.instruments.six_channel.latches._pyads", lambda: fake)
        driver = device(SimulatedRing(loop), settings, loop.clock.nanoseconds, loop.clock)
        return Bench(loop, faulty(emulator)(ring, clock=loop.clock), driver)

    return make


STREAM = Kind(
    SixChannelEmulator, GenericStreamDevice, StreamSettings(), checked=True, modulus=2**32
)
PLC = Kind(Plc, GenericStreamDevice, StreamSettings(), checked=True, modulus=2**32)


def ring_stories() -> st.SearchStrategy[Story]:
    return st.lists(
        st.tuples(st.one_of(MEMORY_FAULTS), st.floats(0.0, 1.5)), min_size=1, max_size=6
    )


@sequences(4)
@given(st.data())
def test_the_stream_lives_through_any_faults(bench: Any, data: st.DataObject) -> None:
    play(bench, STREAM, data.draw(stories(STREAM)))


@pytest.mark.soak
@pytest.mark.timeout(0)  # minutes on a busy host
@sequences(150)
@given(st.data())
def test_the_stream_lives_through_many_faults(bench: Any, data: st.DataObject) -> None:
    play(bench, STREAM, data.draw(stories(STREAM)))


@sequences(4)
@given(st.data())
def test_a_ring_is_read_through_any_faults(
    monkeypatch: pytest.MonkeyPatch, data: st.DataObject
) -> None:
    play(ring_bench(monkeypatch), PLC, data.draw(ring_stories()))


@pytest.mark.soak
@pytest.mark.timeout(0)  # minutes on a busy host
@sequences(150)
@given(st.data())
def test_a_ring_is_read_through_many_faults(
    monkeypatch: pytest.MonkeyPatch, data: st.DataObject
) -> None:
    play(ring_bench(monkeypatch), PLC, data.draw(ring_stories()))


@pytest.mark.parametrize("seconds", [0.5, 1.0, 3.0])
def test_what_a_ring_lost_while_nobody_read_it_is_a_gap(
    seconds: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The PLC measures on; of more than the ring holds only the newest are left."""
    run = ring_bench(monkeypatch)(Plc, GenericStreamDevice, StreamSettings(), interval=0.02)
    run.modulus = 2**32
    run.run(1.0)
    run.loop.wait(seconds)
    run.run(NOTICED_S - LASTS_S)
    run.end()
    run.check()
    lost = run.device.statistics.lost
    assert lost == pytest.approx(max(seconds / PERIOD_S - RING_SAMPLES, 0), abs=50)
    assert run.device.statistics.gaps == (lost > 0)
