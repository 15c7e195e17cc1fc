"""Reads a device continuously and connects again after each fault of its line."""

import queue
import threading
import time
from collections.abc import Callable, Sequence
from concurrent import futures
from enum import Enum
from typing import Any

from omsm_ros.errors import ConfigurationError, DeviceError, NoSamplesError, defect
from omsm_ros.instruments.blocks import BlockPair

# Requests of other threads wait for a read to end, so it is short [s].
_READ_S = 0.05
# Time from one connection to the next: at first, and at most [s].
BACK_OFF_S = (0.25, 0.5)


class State(Enum):
    """State of a reader."""

    CONNECTING = "connecting"  # or setting the device up
    READING = "reading"
    LOST = "lost"  # waits before it connects again
    ENDED = "ended"


class DeviceReader:
    """Connects, reads, hands blocks over, and connects again after growing pauses.

    trouble: what keeps it from reading, one line; empty while it reads. The trouble that a device
        sends nothing readable stays until samples come, since a new connection does not remove it
    connections: how often the device was connected and set up
    """

    def __init__(
        self,
        device: Any,
        deliver: Callable[[Sequence[BlockPair]], None],
        note: Callable[[str], None] = lambda _: None,
        complain: Callable[[str], None] = lambda _: None,
        connected: Callable[[], None] = lambda: None,
    ) -> None:
        """device: as ``StreamDevice``
        complain, note: called once for each new trouble, and once when it is over
        connected: called when the device was set up, before its samples are delivered
        """
        self.state = State.CONNECTING
        self.trouble = "not connected yet"
        self.connections = 0
        self._device = device
        self._deliver = deliver
        self._note, self._warn = note, complain
        self._when_connected = connected
        self._unproven = False
        self._requests: queue.SimpleQueue[tuple[Callable[[], Any], futures.Future[Any]]] = (
            queue.SimpleQueue()
        )

    def ask(self, request: Callable[[], Any], patience: float) -> Any:
        """Let the reading thread do ``request`` to the device between two reads; return its result.

        Raises what ``request`` raises; DeviceError if the device is not being read, or after
        ``patience`` [s].
        """
        if self.state is not State.READING:
            raise DeviceError(f"the device is not being read now: {self.trouble or 'it ended'}")
        done: futures.Future[Any] = futures.Future()
        self._requests.put((request, done))
        try:
            return done.result(patience)
        except futures.TimeoutError as err:  # another one than the built-in of Python 3.10
            if not done.cancel() and done.done():
                raise  # the device did not answer
            raise DeviceError(f"the device did not do it within {patience:g} s") from err

    def _do_requests(self) -> None:
        while not self._requests.empty():
            request, done = self._requests.get()
            if not done.set_running_or_notify_cancel():
                continue
            try:
                done.set_result(request())
            except Exception as err:  # raised where the request was made
                done.set_exception(err)

    def run(self, stop: threading.Event) -> None:
        """Read until ``stop``."""
        least = pause = BACK_OFF_S[0]
        while not stop.is_set():
            began = time.monotonic()
            if self._read_once(stop):
                pause = least
            stop.wait(max(began + pause - time.monotonic(), least))
            pause = min(2 * pause, BACK_OFF_S[1])
        self.state = State.ENDED

    def _read_once(self, stop: threading.Event) -> bool:
        """Read until the device is lost; return whether any sample came."""
        self.state, any_came = State.CONNECTING, False
        try:
            self._device.open()
            self.connections += 1
            self.state = State.READING
            if not self._unproven:
                self._tell("")
            self._when_connected()
            while not stop.is_set():
                self._do_requests()
                blocks = self._device.poll(_READ_S)
                any_came |= bool(blocks)
                self._deliver_blocks(blocks)
        except Exception as err:  # an internal error must not end the reading
            if isinstance(err, DeviceError | ConfigurationError):
                self._unproven = isinstance(err, NoSamplesError)
            self._lose(err)
        try:  # hand over the partial block, whatever state the device is in
            self._deliver_blocks(self._device.close())
        except Exception as err:
            self._lose(err)
        return any_came

    def _lose(self, err: Exception) -> None:
        self.state = State.LOST
        known = isinstance(err, DeviceError | ConfigurationError)
        self._tell(str(err) if known else defect(err))

    def _deliver_blocks(self, blocks: Sequence[BlockPair]) -> None:
        if blocks:
            self._deliver(blocks)
        if self.state is State.READING:
            self._unproven &= not blocks
            if self._device.trouble or not self._unproven:
                self._tell(self._device.trouble)

    def _tell(self, trouble: str) -> None:
        if trouble != self.trouble:
            self.trouble = trouble
            if not trouble:
                self._note("connected and set up")
            elif self.state is State.READING:
                self._warn(trouble)
            else:
                self._warn(f"{trouble}; trying again")
