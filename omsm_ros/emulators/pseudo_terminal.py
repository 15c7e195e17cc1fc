"""A serial port without hardware: the device's end of a pseudo-terminal."""

from __future__ import annotations

import os
import select
import threading
import time
import tty
from pathlib import Path
from types import TracebackType

from omsm_ros.errors import ConfigurationError, DeviceError

# How often a wait looks at its stop event.
_LOOK_S = 0.05
_CHUNK_BYTES = 65_536


class Pty:
    """A pseudo-terminal in raw mode whose other end a driver opens like a serial port.

    It outlives drivers that close and open again. Bytes written while nobody has the port
    open are lost, as on a real line. While a driver has it open but does not read, ``write``
    waits: nothing is lost, where a real UART would overrun.

    Nothing shows when another driver opens it, so ``sessions`` stays 0.

    Not imitated: baud rate, parity, modem lines, breaks.
    """

    sessions = 0

    def __init__(self, link: str | Path | None = None) -> None:
        """link: symbolic link to create, a name that stays the same; replaced if it exists."""
        self._link = None if link is None else Path(link)
        self._master: int | None = None
        self._slave_name = ""

    def __enter__(self) -> Pty:
        self.plug()
        return self

    def plug(self) -> None:
        """Offer the port, under the same link as before."""
        self._master, slave = os.openpty()
        try:
            tty.setraw(slave)
            self._slave_name = os.ttyname(slave)
        finally:
            # Kept open here, it would hide whether a driver is there.
            os.close(slave)
        os.set_blocking(self._master, False)
        try:
            self._make_link()
        except OSError as err:
            self.close()
            raise DeviceError(
                f"cannot create link {str(self._link)!r}: {err}; choose another"
            ) from err
        except ConfigurationError:
            self.close()
            raise

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Remove the port; an open driver sees its connection lost."""
        if self._link is not None and self._points_here(self._link):
            self._link.unlink()
        if self._master is not None:
            os.close(self._master)
            self._master = None

    def unplug(self) -> None:
        """Take the port away, as a cable that is pulled."""
        self.close()

    @property
    def path(self) -> str:
        """What a driver opens: the link if there is one, else the terminal's own name."""
        return str(self._link or self._slave_name)

    @property
    def has_reader(self) -> bool:
        """Whether a driver has the port open."""
        return not self._events(0.0) & select.POLLHUP

    def wait_for_reader(self, timeout: float, stop: threading.Event | None = None) -> bool:
        """Wait until a driver opens the port; False after ``timeout`` [s] or ``stop``."""
        stop = stop or threading.Event()
        deadline = time.monotonic() + timeout
        while not self.has_reader:
            if time.monotonic() > deadline or stop.wait(_LOOK_S):
                return False
        return True

    def read(self) -> bytes:
        """Return what the driver sent; b"" if nothing."""
        try:
            return os.read(self._descriptor(), _CHUNK_BYTES)
        except OSError:  # nothing there, or no driver
            return b""

    def write(self, data: bytes, stop: threading.Event | None = None) -> int:
        """Return bytes of ``data`` a driver can get: fewer without one, or when ``stop`` is set."""
        remaining = memoryview(data)
        while remaining and not (stop and stop.is_set()):
            events = self._events(_LOOK_S)
            if events & select.POLLHUP:
                break
            if events & select.POLLOUT:
                remaining = remaining[self._write_some(remaining) :]
        return len(data) - len(remaining)

    def _write_some(self, data: memoryview) -> int:
        try:
            return os.write(self._descriptor(), data)
        except BlockingIOError:
            return 0

    def _events(self, timeout: float) -> int:
        poll = select.poll()
        poll.register(self._descriptor(), select.POLLOUT)
        found = poll.poll(timeout * 1000)
        return found[0][1] if found else 0

    def _descriptor(self) -> int:
        if self._master is None:
            raise DeviceError("the pseudo-terminal is closed; use it inside its with block")
        return self._master

    def _make_link(self) -> None:
        if self._link is None:
            return
        if self._link.is_symlink():
            self._link.unlink()
        elif self._link.exists():
            raise ConfigurationError(
                f"link {str(self._link)!r} exists and is not a symbolic link; choose another name"
            )
        self._link.symlink_to(self._slave_name)

    def _points_here(self, link: Path) -> bool:
        try:
            return link.is_symlink() and os.readlink(link) == self._slave_name
        except OSError:  # a name that can be none
            return False
