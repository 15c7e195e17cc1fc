"""Connecting, losing, connecting again: a reader with a scripted device."""

from __future__ import annotations

import threading

import pytest

from omsm_ros.errors import DeviceError, DeviceTimeoutError, NoSamplesError
from omsm_ros.instruments.blocks import BlockPair
from omsm_ros.instruments.reader import DeviceReader, State

BLOCK = BlockPair(None, None)


class Scripted:
    """Opens and polls as told: an error is raised, a list returned; ``stop`` at the end."""

    trouble = ""

    def __init__(self, stop: threading.Event, opens: list[object], polls: list[object]) -> None:
        self.opens, self.polls, self.stop = opens, polls, stop
        self.closed = 0

    def _next(self, script: list[object]) -> list[BlockPair]:
        step = script.pop(0) if script else []
        if not self.opens and not self.polls:
            self.stop.set()
        if isinstance(step, Exception):
            raise step
        return step  # type: ignore[return-value]

    def open(self) -> None:
        self._next(self.opens)

    def poll(self, timeout: float) -> list[BlockPair]:
        return self._next(self.polls)

    def close(self) -> list[BlockPair]:
        self.closed += 1
        return []


def run(
    opens: list[object], polls: list[object]
) -> tuple[DeviceReader, list[str], list[BlockPair]]:
    stop = threading.Event()
    notes: list[str] = []
    got: list[BlockPair] = []
    device = Scripted(stop, opens, polls)
    reader = DeviceReader(device, got.extend, notes.append, lambda text: notes.append(f"! {text}"))
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("omsm_ros.instruments.reader.BACK_OFF_S", (1e-3, 4e-3))
        reader.run(stop)
    assert device.closed >= 1
    assert reader.state is State.ENDED
    return reader, notes, got


def test_blocks_are_handed_over_and_connections_counted() -> None:
    reader, notes, got = run([[]], [[BLOCK], [BLOCK, BLOCK]])
    assert len(got) == 3
    assert reader.connections == 1
    assert notes == ["connected and set up"]


def test_it_connects_again_and_tells_each_trouble_once() -> None:
    gone = DeviceError("gone")
    reader, notes, got = run([gone, gone, gone, [], []], [[BLOCK], DeviceError("lost"), [BLOCK]])
    assert len(got) == 2
    assert reader.connections == 2
    assert notes == [
        "! gone; trying again",
        "connected and set up",
        "! lost; trying again",
        "connected and set up",
    ]


def test_that_nothing_can_be_read_stays_until_samples_come() -> None:
    mute = NoSamplesError("mute")
    reader, notes, _ = run([[], [], []], [mute, [], mute, [], [BLOCK]])
    assert notes == ["connected and set up", "! mute; trying again", "connected and set up"]
    reader, notes, _ = run([[], []], [[BLOCK], mute])
    assert notes[-1] == "! mute; trying again"
    assert reader.trouble == "mute"


def test_an_internal_error_is_reported_and_the_node_continues() -> None:
    reader, notes, got = run([[], []], [ZeroDivisionError("of ours"), [BLOCK]])
    assert len(got) == 1
    assert reader.connections == 2
    assert "of ours" in notes[1]


def test_the_device_own_trouble_is_passed_on() -> None:
    stop = threading.Event()
    device = Scripted(stop, [[]], [[BLOCK]])
    device.trouble = "measures at 900 Hz"
    complaints: list[str] = []
    reader = DeviceReader(device, lambda _: None, complain=complaints.append)
    reader.run(stop)
    assert reader.trouble == "measures at 900 Hz"
    # It reads on: nothing is tried again.
    assert complaints == ["measures at 900 Hz"]


def test_a_device_that_comes_back_at_any_time_is_connected_within_half_a_second() -> None:
    """The pause between two attempts to connect is never longer."""
    waited: list[float] = []

    class Hurried(threading.Event):
        def wait(self, timeout: float | None = None) -> bool:
            waited.append(timeout or 0.0)
            return self.is_set()

    stop = Hurried()
    DeviceReader(Scripted(stop, [DeviceError("gone")] * 20, []), lambda _: None).run(stop)
    assert len(waited) == 20
    assert min(waited) >= 0.2
    assert max(waited) <= 0.5


def test_a_stop_ends_a_long_pause_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("omsm_ros.instruments.reader.BACK_OFF_S", (1e6, 1e6))
    stop = threading.Event()
    device = Scripted(threading.Event(), [DeviceError("gone")] * 5, [[]])
    reader = DeviceReader(device, lambda _: None)
    thread = threading.Thread(target=reader.run, args=(stop,))
    thread.start()
    stop.set()
    thread.join(5.0)
    assert not thread.is_alive()


def test_a_defect_while_the_device_is_let_go_does_not_end_the_reading(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("omsm_ros.instruments.reader.BACK_OFF_S", (1e-3, 4e-3))
    stop = threading.Event()

    class Stubborn(Scripted):
        def close(self) -> list[BlockPair]:
            self.closed += 1
            raise KeyError("the partial block")

    device = Stubborn(stop, [[], []], [DeviceError("pulled"), [BLOCK]])
    got: list[BlockPair] = []
    reader = DeviceReader(device, got.extend, lambda _: None)
    reader.run(stop)
    assert (device.closed, got, reader.connections) == (2, [BLOCK], 2)


class Endless(Scripted):
    """Polls without end, a millisecond each."""

    def poll(self, timeout: float) -> list[BlockPair]:
        self.stop.wait(1e-3)
        return [BLOCK]


def reading(device: Scripted, stop: threading.Event) -> tuple[DeviceReader, threading.Thread]:
    reader = DeviceReader(device, lambda _: None)
    thread = threading.Thread(target=reader.run, args=(stop,))
    thread.start()
    while reader.state is not State.READING:
        stop.wait(1e-3)
    return reader, thread


def test_a_request_is_done_by_the_reading_thread() -> None:
    stop = threading.Event()
    reader, thread = reading(Endless(stop, [[]], [[]]), stop)
    doers: list[threading.Thread] = []
    reader.ask(lambda: doers.append(threading.current_thread()), 5.0)
    assert doers == [thread]

    def refuse() -> None:
        raise DeviceError("the target is in range")

    def silent() -> None:
        raise DeviceTimeoutError("no answer to DRK")

    with pytest.raises(DeviceError, match="in range"):
        reader.ask(refuse, 5.0)
    with pytest.raises(DeviceError, match="no answer to DRK"):
        reader.ask(silent, 5.0)
    assert reader.state is State.READING
    stop.set()
    thread.join()
    with pytest.raises(DeviceError, match="not being read"):
        reader.ask(refuse, 5.0)


def test_a_request_that_is_never_done_is_given_up() -> None:
    stop, held = threading.Event(), threading.Event()

    class Stuck(Endless):
        def poll(self, timeout: float) -> list[BlockPair]:
            held.wait(10.0)
            return []

    reader, thread = reading(Stuck(stop, [[]], [[]]), stop)
    with pytest.raises(DeviceError, match=r"within 0\.1 s"):
        reader.ask(lambda: None, 0.1)
    stop.set()
    held.set()
    thread.join()
