"""Connecting, losing, connecting again: a reader with a scripted device."""

from __future__ import annotations

import threading

from omsm_ros.devices.blocks import BlockPair
from omsm_ros.devices.reader import DeviceReader, State
from omsm_ros.errors import DeviceError

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
    reader = DeviceReader(device, got.extend, notes.append, back_off=(1e-3, 4e-3))
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
        "gone; trying again",
        "connected and set up",
        "lost; trying again",
        "connected and set up",
    ]


def test_a_defect_is_told_and_survived() -> None:
    reader, notes, got = run([[], []], [ZeroDivisionError("of ours"), [BLOCK]])
    assert len(got) == 1
    assert reader.connections == 2
    assert "of ours" in notes[1]


def test_the_device_own_trouble_is_passed_on() -> None:
    stop = threading.Event()
    device = Scripted(stop, [[]], [[BLOCK]])
    device.trouble = "measures at 900 Hz"
    reader = DeviceReader(device, lambda _: None)
    reader.run(stop)
    assert reader.trouble == "measures at 900 Hz"


def test_a_stop_ends_a_long_pause_at_once() -> None:
    stop = threading.Event()
    device = Scripted(threading.Event(), [DeviceError("gone")] * 5, [[]])
    reader = DeviceReader(device, lambda _: None, back_off=(1e6, 1e6))
    thread = threading.Thread(target=reader.run, args=(stop,))
    thread.start()
    stop.set()
    thread.join(5.0)
    assert not thread.is_alive()


def test_a_defect_while_the_device_is_let_go_does_not_end_the_reading() -> None:
    stop = threading.Event()

    class Stubborn(Scripted):
        def close(self) -> list[BlockPair]:
            self.closed += 1
            raise KeyError("the partial block")

    device = Stubborn(stop, [[], []], [DeviceError("pulled"), [BLOCK]])
    got: list[BlockPair] = []
    reader = DeviceReader(device, got.extend, lambda _: None, back_off=(1e-3, 4e-3))
    reader.run(stop)
    assert (device.closed, got, reader.connections) == (2, [BLOCK], 2)
