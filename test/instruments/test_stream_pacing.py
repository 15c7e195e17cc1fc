"""The emulated stream's pace, its own clock and number, and its faults."""

from __future__ import annotations

import math
import threading
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from omsm_ros.errors import ConfigurationError
from omsm_ros.instruments.six_channel import emulator as generic_stream
from omsm_ros.instruments.six_channel.emulator import (
    FaultyLine,
    GenericStreamEmulator,
    PlayedCounts,
    StreamFaults,
)
from omsm_ros.instruments.six_channel.protocol import FRAME, FrameDecoder
from omsm_ros.twin.cell import Recording

from .playing import EVERY_FAULT, Sink

# Pacing and the device's own state.


@pytest.mark.parametrize("time_lapse", [0.5, 1.0, 20.0, 40.0, 5000.0])
def test_pace_on_a_simulated_clock(
    monkeypatch: pytest.MonkeyPatch, recording: Recording, time_lapse: float
) -> None:
    """No frame before its trigger, none much later than one write interval after it."""
    clock = SimpleNamespace(now=100.0)

    class Stop(threading.Event):
        def wait(self, timeout: float | None = None) -> bool:
            clock.now += timeout or 0.0
            return False

    monkeypatch.setattr(generic_stream, "time", SimpleNamespace(monotonic=lambda: clock.now))
    moments: list[tuple[int, float]] = []
    GenericStreamEmulator(Sink()).play(
        recording, time_lapse, Stop(), lambda samples: moments.append((samples, clock.now - 100.0))
    )
    period = recording.axes.sample_period / time_lapse
    written = np.array([samples for samples, _ in moments])
    when = np.array([moment for _, moment in moments])
    np.testing.assert_allclose(when, (written - 1) * period, atol=1e-9)
    sizes = np.diff(np.r_[0, written])
    allowed = max(period, generic_stream.WRITE_INTERVAL_S)
    assert (sizes * period <= allowed * (1 + 1e-9)).all()
    assert sizes.max() <= generic_stream.MAX_CHUNK_FRAMES


def decoded(sink: Sink) -> np.ndarray:
    return FrameDecoder().feed(sink.data)


@pytest.mark.parametrize("time_lapse", [1e3, math.inf])
def test_the_device_clock_is_true_in_any_time_lapse(
    recording: Recording, time_lapse: float
) -> None:
    sink = Sink()
    GenericStreamEmulator(sink, first_device_time_ns=7).play(recording, time_lapse)
    times = decoded(sink)["device_time"]
    np.testing.assert_array_equal(times, 7 + np.arange(len(recording.axes)) * 1_000_000)


def test_sequence_and_clock_run_on_from_play_to_play(recording: Recording) -> None:
    sink = Sink()
    count = len(recording.axes)
    emulator = GenericStreamEmulator(sink, first_sequence=2**32 - 5)
    emulator.play(recording, math.inf)
    emulator.play(recording, math.inf)
    frames = decoded(sink)
    np.testing.assert_array_equal(frames["sequence"], (2**32 - 5 + np.arange(2 * count)) % 2**32)
    np.testing.assert_array_equal(frames["device_time"], np.arange(2 * count) * 1_000_000)


def test_silence_is_a_pause_of_the_trigger(recording: Recording) -> None:
    sink = Sink()
    faults = StreamFaults(silence_at=50, silence=3.0)
    GenericStreamEmulator(sink, faults=faults).play(recording, math.inf)
    frames = decoded(sink)
    np.testing.assert_array_equal(frames["sequence"], np.arange(len(recording.axes)))
    steps = np.diff(frames["device_time"].astype(np.int64))
    assert steps[49] == 3_001_000_000
    assert (np.delete(steps, 49) == 1_000_000).all()


@pytest.mark.parametrize("has_reader", [True, False])
def test_a_frame_cut_off_spoils_the_next_only_if_somebody_listens(
    recording: Recording, has_reader: bool
) -> None:
    count = len(recording.axes)
    sink = Sink(capacity=10 * 63 + 20, has_reader=has_reader)
    emulator = GenericStreamEmulator(sink)
    first = emulator.play(recording, math.inf)
    assert (first.intact, first.unread) == (10, count - 10)
    sink.capacity = math.inf
    second = emulator.play(recording, math.inf)
    assert (second.intact, second.spoilt) == ((count - 1, 1) if has_reader else (count, 0))


# Faults.


@given(
    st.lists(st.sampled_from([0.0, 0.1, 0.5, 1.0]), min_size=5, max_size=5),
    st.integers(0, 1000),
    st.lists(st.integers(1, 20), min_size=1, max_size=5),
)
def test_the_faulty_link_counts_intact_frames(
    rates: list[float], seed: int, sizes: list[int]
) -> None:
    """Against the decoder: intact frames come out, in order, and nothing else does."""
    line = FaultyLine(StreamFaults(**dict(zip(EVERY_FAULT, rates, strict=True)), seed=seed))
    decoder = FrameDecoder()
    total, survived = PlayedCounts(), 0
    frames = np.zeros(sum(sizes), FRAME)
    frames["sequence"] = np.arange(len(frames))
    found = []
    for end, size in zip(np.cumsum(sizes), sizes, strict=True):
        pieces, intact, plan = line.transmit(frames[end - size : end])
        found.append(decoder.feed(b"".join(pieces))["sequence"])
        total, survived = total + plan, survived + int(intact.sum())
        assert len(pieces) == len(intact) == plan.samples + plan.duplicated - plan.dropped
    sequence = np.concatenate(found).astype(int)
    assert len(sequence) == survived
    assert (np.diff(sequence) >= 0).all()
    assert total.samples == len(frames)


def test_faults_repeat_with_their_seed(recording: Recording) -> None:
    wires = []
    for seed in (1, 1, 2):
        sink = Sink()
        faults = StreamFaults(**EVERY_FAULT, seed=seed)
        GenericStreamEmulator(sink, faults=faults).play(recording, math.inf)
        wires.append(sink.data)
    assert wires[0] == wires[1] != wires[2]


@pytest.mark.parametrize("name", list(EVERY_FAULT))
def test_each_fault_strikes_as_often_as_asked(recording: Recording, name: str) -> None:
    sink = Sink()
    played = GenericStreamEmulator(sink, faults=StreamFaults(**{name: 0.1})).play(
        recording, math.inf
    )
    struck = {"drop": played.dropped, "duplicate": played.duplicated}.get(name, played.spoilt)
    expected = 0.1 * played.samples * (2 if name == "truncate" else 1)
    # Four standard deviations of a binomial count; a cut frame spoils two unless they meet.
    assert abs(struck - expected) < 4 * math.sqrt(expected) + 0.02 * played.samples


@pytest.mark.parametrize(
    ("arguments", "named"),
    [({"noise": 1.5}, r"noise 1\.5"), ({"drop": -1}, "drop -1"), ({"silence": -2.0}, r"-2\.0")],
)
def test_senseless_faults_are_refused(arguments: dict[str, float], named: str) -> None:
    with pytest.raises(ConfigurationError, match=named):
        StreamFaults(**arguments)


@pytest.mark.parametrize("time_lapse", [0.0, -1.0, math.nan])
def test_senseless_time_lapse_is_refused(recording: Recording, time_lapse: float) -> None:
    with pytest.raises(ConfigurationError, match="time_lapse"):
        GenericStreamEmulator(Sink()).play(recording, time_lapse)
