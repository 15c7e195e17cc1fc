"""A command that is asked to end removes what it has not finished, as it does on Ctrl-C."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

# As "kill", "systemctl stop" or a batch system ask, and a terminal that is closed.
_ASKED = (signal.SIGTERM, signal.SIGHUP)


class AskedToEndError(KeyboardInterrupt):
    """The signal ``number`` came; like Ctrl-C it is no error of what is being done."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


@contextmanager
def interrupted_when_asked() -> Iterator[None]:
    """Raise AskedToEndError where a signal would end the process at once; the second one does."""
    if threading.current_thread() is not threading.main_thread():
        yield  # signals are the main thread's
        return

    def asked(number: int, _: object) -> None:
        signal.signal(number, signal.SIG_DFL)
        raise AskedToEndError(number)

    # What is ignored stays so, as SIGHUP below nohup.
    ours = [number for number in _ASKED if signal.getsignal(number) is signal.SIG_DFL]
    for number in ours:
        signal.signal(number, asked)
    try:
        yield
    finally:
        for number in ours:
            signal.signal(number, signal.SIG_DFL)


def end_as_asked(number: int) -> None:
    """End this process by the signal ``number``, so that who waits for it sees by what it ended."""
    signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)
