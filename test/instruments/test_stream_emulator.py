"""The emulated six-channel stream: its pace, its own clock, and what its faults cost."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from loopback import SimulatedClock

from omsm_ros.instruments.emulator import InstrumentFaults, RecordingSource
from omsm_ros.instruments.six_channel.device import GenericStreamDevice, StreamSettings
from omsm_ros.instruments.six_channel.emulator import SixChannelEmulator
from omsm_ros.instruments.six_channel.protocol import FrameDecoder
from omsm_ros.twin.cell import Recording

from .faulty import Faults

STEP_S = 0.005


class Sink:
    """In place of a line: keeps what is written."""

    has_reader, sessions = True, 0

    def __init__(self) -> None:
        self.decoder = FrameDecoder()
        self.frames: list[np.ndarray] = []
        self.wire = b""

    def plug(self) -> None: ...
    def unplug(self) -> None: ...

    def read(self) -> bytes:
        return b""

    def write(self, data: bytes, stop: object = None) -> int:
        self.wire += data
        self.frames.append(self.decoder.feed(data))
        return len(data)

    @property
    def sent(self) -> np.ndarray:
        return np.concatenate(self.frames)


def played(
    recording: Recording, lapse: float = 1.0, seed: int = 1, **rates: float
) -> tuple[Sink, list[tuple[float, int]]]:
    """Play a motion on simulated time: the line, and how many samples were sent by when [s]."""
    sink, clock = Sink(), SimulatedClock()
    emulator = SixChannelEmulator(sink, triggered=True, clock=clock, seed=seed)
    emulator.faults = InstrumentFaults(**rates)  # type: ignore[arg-type]
    begin, moments = clock.now, []
    emulator.play(RecordingSource(recording), lapse)
    while emulator.playing:
        clock.now += STEP_S
        emulator.step()
        moments.append((clock.now - begin, emulator.played))
    return sink, moments


@pytest.mark.parametrize("lapse", [0.5, 1.0, 20.0, 300.0])
def test_no_sample_before_its_trigger_and_none_a_step_late(
    recording: Recording, lapse: float
) -> None:
    _, moments = played(recording, lapse)
    period, count = recording.axes.sample_period / lapse, len(recording.axes)
    assert moments[-1][1] == count
    for now, samples in moments:
        due = min(now / period, count)
        assert due - 1 - 1e-6 <= samples <= due + 1e-6


@pytest.mark.parametrize("lapse", [1.0, 20.0])
def test_the_device_clock_is_true_in_any_time_lapse(recording: Recording, lapse: float) -> None:
    sink, _ = played(recording, lapse)
    np.testing.assert_array_equal(sink.sent["sequence"], np.arange(len(recording.axes)))
    steps = np.diff(sink.sent["device_time"].astype(np.int64))
    assert abs(steps - 1_000_000).max() <= 1


@pytest.mark.parametrize("name", ["noise_rate", "flip_rate", "drop_rate"])
def test_each_fault_strikes_as_often_as_asked(recording: Recording, name: str) -> None:
    sink, _ = played(recording, 20.0, **{name: 0.1})
    count = len(recording.axes)
    struck = count - len(sink.sent)
    # Four standard deviations of a binomial count.
    assert abs(struck - 0.1 * count) < 4 * math.sqrt(0.1 * 0.9 * count) + 1
    assert np.all(np.diff(sink.sent["sequence"].astype(np.int64)) > 0)


def test_faults_repeat_with_their_seed(recording: Recording) -> None:
    rates = {"noise_rate": 0.03, "flip_rate": 0.03, "drop_rate": 0.03}
    wires = [played(recording, 20.0, seed, **rates)[0].wire for seed in (1, 1, 2)]
    assert wires[0] == wires[1] != wires[2]


def test_every_sample_is_delivered_or_lost_with_all_faults(bench: Callable[..., Any]) -> None:
    made = bench(SixChannelEmulator, GenericStreamDevice, StreamSettings())
    made.instrument.faults = Faults(noise_rate=0.02, flip_rate=0.02, drop_rate=0.02)
    made.run(5.0)
    made.end()
    found = made.device.statistics
    sent = len(made.instrument.truth)
    assert 0.03 < found.lost / (found.lost + found.delivered) < 0.1
    assert 0.9 * sent < found.delivered < sent
    made.check()
