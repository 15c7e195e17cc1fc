"""Frames to blocks with a scripted transport: every frame counted, every block consecutive."""

from __future__ import annotations

import contextlib
import itertools
import socket
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from omsm_ros.core.streams.blocks import Status
from omsm_ros.errors import DeviceError
from omsm_ros.instruments.blocks import BlockPair
from omsm_ros.instruments.counting import Counting, SequenceTracker
from omsm_ros.instruments.scaling import AxisScaling
from omsm_ros.instruments.six_channel.device import GenericStreamDevice, StreamSettings, samples_of
from omsm_ros.instruments.six_channel.protocol import ProbeScaling, StreamScaling, encode_frames
from omsm_ros.instruments.transport import TcpTransport

from .scripted_stream import AT_ONCE, NEVER, Script, frames_of, run, spans

# Blocks.


def test_values_reach_their_fields() -> None:
    settings = StreamSettings(
        pause=NEVER,
        scaling=StreamScaling(
            x=AxisScaling(10.0),
            y=AxisScaling(10.0, sign=-1),
            z=AxisScaling(10.0, offset=7.0),
            b=AxisScaling(2.0),
            c=AxisScaling(5.0),
            probe=ProbeScaling(polarity=-1),
        ),
    )
    ((axes, distance),), _ = run(encode_frames(frames_of([3, 4])), settings=settings)
    np.testing.assert_allclose(axes.x, [3.0, 4.0])
    np.testing.assert_allclose(axes.y, [-3.1, -4.1])
    np.testing.assert_allclose(axes.z, [10.2, 11.2])
    np.testing.assert_allclose(axes.b, [16.5, 21.5])
    np.testing.assert_allclose(axes.c, [6.8, 8.8])
    np.testing.assert_allclose(distance.distance, [-3e-9, -4e-9])
    assert distance.status.tolist() == [Status.OK, Status.OK]
    assert (axes.first_sample, axes.sample_period) == (3, 1e-3)


@given(st.integers(1, 400), st.integers(1, 130), st.lists(st.integers(0, 25_000)))
def test_any_portions_give_the_same_blocks(count: int, size: int, cuts: list[int]) -> None:
    wire = encode_frames(frames_of(np.arange(5, 5 + count)))
    edges = sorted({0, len(wire), *(c for c in cuts if c < len(wire))})
    portions = [wire[a:b] for a, b in itertools.pairwise(edges)]
    blocks, device = run(*portions, settings=StreamSettings(block_size=size, pause=NEVER))
    full, rest = divmod(count, size)
    assert [len(axes) for axes, _ in blocks] == [size] * full + [rest] * (rest > 0)
    samples = np.concatenate([axes.first_sample + np.arange(len(axes)) for axes, _ in blocks])
    np.testing.assert_array_equal(samples, np.arange(5, 5 + count))
    x = np.concatenate([axes.x for axes, _ in blocks])
    np.testing.assert_allclose(x, samples * 1e-9, rtol=1e-12)
    assert device.statistics.lost == 0


def test_a_pause_hands_over_the_partial_block() -> None:
    settings = StreamSettings(block_size=100, pause=AT_ONCE)
    device = GenericStreamDevice(Script(encode_frames(frames_of(np.arange(130)))), settings)
    device.open()
    assert spans(device.poll(0.0)) == [(0, 100)]
    assert device.statistics.pending == 30
    assert spans(device.poll(0.0)) == [(100, 30)]
    assert device.poll(0.0) == []
    assert device.close() == []


def test_no_pause_keeps_it_waiting() -> None:
    device = GenericStreamDevice(
        Script(encode_frames(frames_of([0, 1]))), StreamSettings(pause=NEVER)
    )
    device.open()
    assert device.poll(0.0) == device.poll(0.0) == []
    assert spans(device.close()) == [(0, 2)]


def test_noise_alone_counts_as_a_pause() -> None:
    script = Script(encode_frames(frames_of([0, 1])), b"\xaa\x00")
    device = GenericStreamDevice(script, StreamSettings(pause=AT_ONCE))
    device.open()
    assert device.poll(0.0) == []
    assert spans(device.poll(0.0)) == [(0, 2)]


# Sequence.


def test_a_gap_closes_the_block_and_is_counted() -> None:
    blocks, device = run(encode_frames(frames_of([0, 1, 2, 7, 8, 20])))
    assert spans(blocks) == [(0, 3), (7, 2), (20, 1)]
    assert (device.statistics.lost, device.statistics.gaps) == (15, 2)


def test_a_broken_frame_is_a_gap_of_one() -> None:
    wire = bytearray(encode_frames(frames_of(np.arange(10))))
    wire[4 * 63 + 20] ^= 0x80
    blocks, device = run(bytes(wire))
    assert spans(blocks) == [(0, 4), (5, 5)]
    found = device.statistics
    assert (
        found.lost == device._decoder.statistics.bad_crc + device._decoder.statistics.bad_cobs == 1
    )


def test_duplicates_are_left_out_and_counted() -> None:
    frames = frames_of([0, 1, 2, 3])[[0, 1, 1, 1, 2, 3, 3]]
    blocks, device = run(encode_frames(frames[:3]), encode_frames(frames[3:]))
    assert spans(blocks) == [(0, 4)]
    assert (device.statistics.duplicates, device.statistics.lost) == (3, 0)


def test_a_portion_of_duplicates_only() -> None:
    frames = frames_of([0, 1])
    blocks, device = run(encode_frames(frames), encode_frames(frames[[1, 1]]))
    assert spans(blocks) == [(0, 2)]
    assert device.statistics.duplicates == 2


def test_the_sequence_wraps_and_the_counter_does_not() -> None:
    blocks, device = run(encode_frames(frames_of(np.arange(2**32 - 3, 2**32 + 4))))
    assert spans(blocks) == [(2**32 - 3, 7)]
    assert device.statistics.lost == device.statistics.restarts == 0
    blocks, device = run(encode_frames(frames_of([2**32 - 2, 2**32 + 1, 2 * 2**32 - 9])[:2]))
    assert spans(blocks) == [(2**32 - 2, 1), (2**32 + 1, 1)]
    assert device.statistics.lost == 2


@pytest.mark.parametrize("first", [0, 3, 149, 150])
def test_a_restarted_device_counts_from_its_own_number(first: int) -> None:
    """Also where its first number happens to be the last, or the next, of before."""
    before = frames_of(np.arange(100, 150), start_ns=10**12)
    after = frames_of(np.arange(first, first + 20), start_ns=0)
    blocks, device = run(encode_frames(before) + encode_frames(after))
    assert spans(blocks) == [(100, 50), (first, 20)]
    found = device.statistics
    assert (found.restarts, found.lost, found.duplicates) == (1, 0, 0)


def test_a_number_that_falls_back_is_a_restart_even_if_the_clock_went_on() -> None:
    before = frames_of(np.arange(100, 150), start_ns=0)
    after = frames_of(np.arange(0, 20), start_ns=10**12)
    blocks, device = run(encode_frames(before), encode_frames(after))
    assert spans(blocks) == [(100, 50), (0, 20)]
    assert device.statistics.restarts == 1


def test_the_same_number_at_a_later_time_is_a_restart_too() -> None:
    blocks, device = run(
        encode_frames(frames_of(np.arange(7, 10), start_ns=0)),
        encode_frames(frames_of([9, 10], start_ns=10**12)),
    )
    assert spans(blocks) == [(7, 3), (9, 2)]
    found = device.statistics
    assert (found.restarts, found.duplicates, found.lost) == (1, 0, 0)


@given(
    st.lists(
        st.one_of(st.just(1), st.just(1), st.integers(0, 5), st.integers(2, 2**31 - 1)),
        min_size=1,
        max_size=60,
    ),
    st.integers(0, 2**32 - 1),
    st.data(),
)
def test_tracker_agrees_with_plain_counting(
    steps: list[int], start: int, data: st.DataObject
) -> None:
    """Against the definition, one frame at a time; portions as they come."""
    numbers = np.cumsum([start, *steps])
    frames = frames_of(numbers)
    samples = samples_of(frames, StreamScaling())
    cuts = sorted({0, len(frames), *data.draw(st.lists(st.integers(0, len(frames))))})
    tracker = SequenceTracker(Counting(2**32))
    runs = [r for a, b in itertools.pairwise(cuts) for r in tracker.split(samples[a:b])]
    seen = np.concatenate([r.first_sample + np.arange(len(r.samples)) for r in runs])
    np.testing.assert_array_equal(seen, np.unique(numbers))
    assert tracker.duplicates == len(numbers) - len(np.unique(numbers))
    assert tracker.lost == numbers[-1] - numbers[0] + 1 - len(np.unique(numbers))
    assert tracker.gaps == sum(step > 1 for step in steps)
    assert tracker.restarts == 0


# Silence.


class Moments:
    """A clock that is set."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def polled(script: Script, renew: float, seconds: float) -> GenericStreamDevice:
    clock = Moments()
    device = GenericStreamDevice(script, StreamSettings(renew=renew), time.time_ns, clock)
    device.open()
    for _ in range(round(seconds / 0.5)):
        clock.now += 0.5
        device.poll(0.05)
    return device


def test_a_silent_stream_is_connected_anew_again_and_again() -> None:
    """Each second at first, then after a tenth of the silence, at most ``renew``."""
    assert polled(Script(), renew=10.0, seconds=10.0).statistics.renewals == 10
    late = polled(Script(), renew=10.0, seconds=100.0).statistics.renewals
    assert polled(Script(), renew=10.0, seconds=200.0).statistics.renewals == late + 10
    assert polled(Script(), renew=0.5, seconds=10.0).statistics.renewals == 20


def test_one_that_speaks_or_may_rest_is_left_alone() -> None:
    portions = [encode_frames(frames_of([k])) for k in range(70)]
    assert polled(Script(*portions), renew=10.0, seconds=35.0).statistics.renewals == 0
    assert polled(Script(), renew=0.0, seconds=35.0).statistics.renewals == 0


class Silent:
    """A stream over a real connection that was served, and has been silent for a second."""

    def __init__(self, server: socket.socket, ends: contextlib.ExitStack) -> None:
        self.server, self.ends, self.clock = server, ends, Moments()
        host, port = server.getsockname()
        self.device = GenericStreamDevice(
            TcpTransport(host, port), StreamSettings(renew=10.0), time.time_ns, self.clock
        )
        self.device.open()
        self.first = ends.enter_context(server.accept()[0])
        self.first.sendall(encode_frames(frames_of(list(range(10)))) + b"half a frame")
        self.read(10)
        self.spare = self.silent()

    def silent(self) -> socket.socket:
        """The connection that the device makes after one more second of silence."""
        self.clock.now += 1.01
        self.device.poll(0.01)
        return self.ends.enter_context(self.server.accept()[0])

    def read(self, samples: int) -> None:
        given_up = time.monotonic() + 20
        while self.device.decoded < samples and time.monotonic() < given_up:
            self.clock.now += 0.001
            self.device.poll(0.05)
        assert self.device.decoded == samples


@pytest.fixture
def silent() -> Iterator[Silent]:
    with socket.create_server(("127.0.0.1", 0)) as server, contextlib.ExitStack() as ends:
        server.settimeout(20.0)
        found = Silent(server, ends)
        yield found
        found.device.close()


def test_a_device_that_forgot_its_connection_is_heard_a_second_after_its_return(
    silent: Silent,
) -> None:
    """The device serves none of its connections before; the counter tells what was lost."""
    served = silent.silent()
    served.sendall(encode_frames(frames_of(list(range(15, 25)))))
    silent.read(20)
    found = silent.device.statistics
    assert (found.renewals, found.lost, found.duplicates) == (2, 5, 0)
    assert [end.recv(1) for end in (silent.first, silent.spare)] == [b"", b""]


def test_a_device_that_waited_for_its_trigger_loses_nothing(silent: Silent) -> None:
    """It serves one connection only, and never saw the others that were made meanwhile."""
    for _ in range(5):
        silent.silent()
    silent.first.sendall(b"\0" + encode_frames(frames_of(list(range(10, 30)))))
    silent.read(30)
    assert silent.device.statistics.lost == 0
    assert silent.spare.recv(1) == b""


def test_a_spare_connection_that_is_closed_is_left(silent: Silent) -> None:
    silent.spare.close()
    silent.device.poll(0.01)
    silent.first.sendall(b"\0" + encode_frames(frames_of(list(range(10, 30)))))
    silent.read(30)


def test_one_that_is_gone_is_an_error() -> None:
    class Gone(Script):
        def open(self) -> None:
            raise DeviceError("no route to host")

    class Lost(Script):
        def spare(self) -> Script:
            return Gone()

    assert polled(Lost(), renew=10.0, seconds=9.5).statistics.renewals == 0
    with pytest.raises(DeviceError, match="no route"):
        polled(Lost(), renew=10.0, seconds=12.0)


def test_counts_agree_at_every_moment() -> None:
    """Another thread asks for them while samples pass from the tracker to the blocks."""
    script = Script(encode_frames(frames_of(np.arange(250))))
    device = GenericStreamDevice(script, StreamSettings(pause=NEVER))
    device.open()
    found: list[dict[str, float]] = []
    asker = threading.Thread(target=lambda: found.append(device.counts()))
    cut = device._cutter.add

    def slow(*arguments: Any, **options: Any) -> Iterator[BlockPair]:
        if not asker.ident:
            asker.start()
            asker.join(0.05)
        return cut(*arguments, **options)

    device._cutter.add = slow  # type: ignore[method-assign]
    device.poll(0.0)
    asker.join()
    assert (found[0]["decoded"], found[0]["delivered"], found[0]["pending"]) == (250, 200, 50)
