"""The emulated device through a real pseudo-terminal into the real driver, all accounted for."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from omsm_ros.core.machine.trajectories import Spiral
from omsm_ros.core.samples.blocks import Status
from omsm_ros.core.surface.nominal import OffAxisParaboloid
from omsm_ros.devices.blocks import BlockPair
from omsm_ros.devices.generic_stream import GenericStreamDevice, StreamSettings
from omsm_ros.devices.transport import SerialTransport
from omsm_ros.emulators import generic_stream
from omsm_ros.emulators.generic_stream import Faults, FaultyLine, GenericStreamEmulator, Played
from omsm_ros.emulators.pseudo_terminal import Pty
from omsm_ros.errors import ConfigurationError, DeviceError
from omsm_ros.protocols.generic_stream import FRAME, FrameDecoder, encode_frames
from omsm_ros.twin.cell import Cell, Recording, record

SOON = 10.0
EVERY_FAULT = {"noise": 0.03, "flip": 0.03, "truncate": 0.03, "drop": 0.03, "duplicate": 0.03}


@pytest.fixture(scope="module")
def recording() -> Recording:
    """A spiral over the paper's mirror, with a stretch where the probe sees nothing."""
    mirror = OffAxisParaboloid(parent_focal_length=25.4e-3, off_axis_distance=50.8e-3)
    spiral = Spiral(surface=mirror, start_radius=2e-3, feed_per_turn=1e-3, spindle_speed=30.0)
    whole = record(Cell(), spiral, mirror, substeps=2)
    status = whole.distance.status.copy()
    status[700:730] = Status.NO_TARGET
    distance = whole.distance.distance.copy()
    distance[700:715] = np.nan
    return replace(whole, distance=replace(whole.distance, status=status, distance=distance))


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
        self.played = Played()
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


@pytest.fixture
def pty(tmp_path: Path) -> Iterator[Pty]:
    with Pty(tmp_path / "six-channel") as opened:
        yield opened


@pytest.fixture
def driver(pty: Pty) -> Iterator[GenericStreamDevice]:
    device = GenericStreamDevice(SerialTransport(pty.path), StreamSettings(pause=1e6))
    device.open()
    yield device
    device.close()


def drain(driver: GenericStreamDevice, playing: Playing) -> list[BlockPair]:
    """Everything the emulator sends, until it has ended and the line is empty."""
    blocks: list[BlockPair] = []
    deadline = time.monotonic() + SOON
    while time.monotonic() < deadline:
        ended, before = playing.done, driver.wire.bytes_received
        blocks += driver.poll(0.3)
        if ended and driver.wire.bytes_received == before:
            return blocks
    raise AssertionError("the emulator did not end")


def assert_reproduced(blocks: list[BlockPair], recording: Recording, offset: int = 0) -> None:
    """Each delivered sample is the twin's own, to half a count, whatever was lost around it."""
    for axes, distance in blocks:
        part = slice(axes.first_sample - offset, axes.first_sample - offset + len(axes))
        for name, half_count in (
            ("x", 5e-11),
            ("y", 5e-11),
            ("z", 5e-11),
            ("b", 5e-10),
            ("c", 5e-10),
        ):
            expected = getattr(recording.axes, name)[part]
            error = abs(getattr(axes, name) - expected)
            assert error.max() <= half_count * 1.0001 + 1e-15, name
        np.testing.assert_array_equal(distance.status, recording.distance.status[part])
        np.testing.assert_allclose(
            distance.distance, recording.distance.distance[part], rtol=0, atol=0.50001e-9
        )


# --- end to end -------------------------------------------------------------------------


def test_every_sample_arrives_as_the_twin_made_it(
    pty: Pty, driver: GenericStreamDevice, recording: Recording
) -> None:
    with Playing(GenericStreamEmulator(pty), recording) as playing:
        blocks = drain(driver, playing)
    blocks += driver.close()
    count = len(recording.axes)
    assert playing.played == Played(samples=count, intact=count)
    assert playing.progress == count
    assert sum(len(axes) for axes, _ in blocks) == count
    assert [axes.first_sample for axes, _ in blocks] == list(range(0, count, 100))
    assert_reproduced(blocks, recording)
    found = driver.statistics
    assert (found.lost, found.duplicates, found.restarts) == (0, 0, 0)
    assert (driver.wire.bytes_discarded, driver.unknown_status, found.period_warnings) == (0, 0, 0)


@pytest.mark.parametrize("seed", [1, 2])
def test_every_sample_is_accounted_for_with_every_fault(
    pty: Pty, driver: GenericStreamDevice, recording: Recording, seed: int
) -> None:
    faults = Faults(**EVERY_FAULT, jump_at=500, jump_by=1000, seed=seed)
    with Playing(GenericStreamEmulator(pty, faults=faults), recording) as playing:
        blocks = drain(driver, playing)
    blocks += driver.close()
    played, found = playing.played, driver.statistics
    assert min(played.spoilt, played.dropped, played.duplicated) > 0
    assert played.samples + played.duplicated == played.intact + played.spoilt + played.dropped
    assert driver.wire.frames == played.intact == found.delivered + found.duplicates
    last = blocks[-1][0].first_sample + len(blocks[-1][0]) - 1
    assert found.delivered + found.lost == last - blocks[0][0].first_sample + 1
    early = [pair for pair in blocks if pair[0].first_sample < 500]
    late = [pair for pair in blocks if pair[0].first_sample >= 500]
    assert all(axes.first_sample >= 1500 for axes, _ in late)
    assert_reproduced(early, recording)
    assert_reproduced(late, recording, offset=1000)


def test_noise_in_mid_stream_costs_what_it_hits_and_no_more(
    pty: Pty, driver: GenericStreamDevice, recording: Recording
) -> None:
    emulator = GenericStreamEmulator(pty)
    with Playing(emulator, recording) as playing:
        blocks = drain(driver, playing)
    pty.write(np.random.default_rng(3).bytes(1000) + b"\xff")
    with Playing(emulator, recording) as playing:
        blocks += drain(driver, playing)
    blocks += driver.close()
    count = len(recording.axes)
    # The noise runs into the first frame of the second play.
    assert driver.statistics.lost == 1
    assert sum(len(axes) for axes, _ in blocks) == 2 * count - 1
    assert_reproduced([p for p in blocks if p[0].first_sample > count], recording, offset=count)


def test_a_device_restarted_in_the_middle_of_a_frame(
    pty: Pty, driver: GenericStreamDevice, recording: Recording
) -> None:
    with Playing(GenericStreamEmulator(pty), recording) as playing:
        before = drain(driver, playing)
    pty.write(encode_frames(np.zeros(1, FRAME))[:40])
    with Playing(GenericStreamEmulator(pty), recording) as playing:
        after = drain(driver, playing)
    after += driver.close()
    count = len(recording.axes)
    assert [axes.first_sample for axes, _ in after[:2]] == [1, 101]
    assert_reproduced(before + after, recording)
    found = driver.statistics
    assert (found.restarts, driver.wire.bad_length) == (1, 1)
    assert found.delivered == 2 * count - 1


def test_the_port_vanishes_and_comes_back(tmp_path: Path, recording: Recording) -> None:
    link = tmp_path / "six-channel"
    driver = GenericStreamDevice(SerialTransport(str(link)), StreamSettings(pause=1e6))
    blocks: list[BlockPair] = []
    with Pty(link) as pty:
        driver.open()
        with Playing(GenericStreamEmulator(pty), recording) as playing:
            blocks += drain(driver, playing)
        pty.write(encode_frames(np.zeros(1, FRAME))[:40])
    with pytest.raises(DeviceError, match=r"six-channel.*was lost"):
        driver.poll(SOON)
    blocks += driver.close()
    with pytest.raises(DeviceError, match="cannot open"):
        driver.open()
    with Pty(link) as pty:
        driver.open()
        with Playing(GenericStreamEmulator(pty), recording) as playing:
            blocks += drain(driver, playing)
        blocks += driver.close()
    assert driver.statistics.delivered == 2 * len(recording.axes)
    assert driver.statistics.restarts == 1
    assert_reproduced(blocks, recording)


def test_a_driver_that_comes_back_sees_a_gap_for_what_it_missed(
    pty: Pty, driver: GenericStreamDevice, recording: Recording
) -> None:
    emulator = GenericStreamEmulator(pty)
    with Playing(emulator, recording) as playing:
        blocks = drain(driver, playing)
    blocks += driver.close()
    unheard = emulator.play(recording, math.inf)
    count = len(recording.axes)
    assert unheard == Played(samples=count, unread=count)
    driver.open()
    with Playing(emulator, recording) as playing:
        blocks += drain(driver, playing)
    blocks += driver.close()
    found = driver.statistics
    assert (found.delivered, found.lost, found.gaps) == (2 * count, count, 1)
    assert_reproduced([p for p in blocks if p[0].first_sample < count], recording)
    assert_reproduced([p for p in blocks if p[0].first_sample >= count], recording, 2 * count)


def test_stopping_is_prompt_and_accounted_for(
    pty: Pty, driver: GenericStreamDevice, recording: Recording
) -> None:
    with Playing(GenericStreamEmulator(pty), recording, time_lapse=0.01) as playing:
        while not driver.wire.frames:
            driver.poll(SOON)
    assert 0 < playing.played.samples < len(recording.axes)
    assert playing.played.samples == playing.played.intact + playing.played.unread


# --- pacing and the device's own state --------------------------------------------------


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
    faults = Faults(silence_at=50, silence=3.0)
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


# --- faults -----------------------------------------------------------------------------


@given(
    st.lists(st.sampled_from([0.0, 0.1, 0.5, 1.0]), min_size=5, max_size=5),
    st.integers(0, 1000),
    st.lists(st.integers(1, 20), min_size=1, max_size=5),
)
def test_the_line_knows_what_survives_it(rates: list[float], seed: int, sizes: list[int]) -> None:
    """Against the decoder: intact frames come out, in order, and nothing else does."""
    line = FaultyLine(Faults(**dict(zip(EVERY_FAULT, rates, strict=True)), seed=seed))
    decoder = FrameDecoder()
    total, survived = Played(), 0
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
        faults = Faults(**EVERY_FAULT, seed=seed)
        GenericStreamEmulator(sink, faults=faults).play(recording, math.inf)
        wires.append(sink.data)
    assert wires[0] == wires[1] != wires[2]


@pytest.mark.parametrize("name", list(EVERY_FAULT))
def test_each_fault_strikes_as_often_as_asked(recording: Recording, name: str) -> None:
    sink = Sink()
    played = GenericStreamEmulator(sink, faults=Faults(**{name: 0.1})).play(recording, math.inf)
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
        Faults(**arguments)


@pytest.mark.parametrize("time_lapse", [0.0, -1.0, math.nan])
def test_senseless_time_lapse_is_refused(recording: Recording, time_lapse: float) -> None:
    with pytest.raises(ConfigurationError, match="time_lapse"):
        GenericStreamEmulator(Sink()).play(recording, time_lapse)
