"""How a program ends that is asked to while it only loads: at once, and without a traceback.

It imports nothing that takes time: what loads before its handlers are in force has none.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Collection, Iterator
from contextlib import contextmanager

STDERR = 2


@contextmanager
def nothing_to_undo(
    numbers: Collection[signal.Signals], code: int = 0, said: str = ""
) -> Iterator[None]:
    """Let each of the signals ``numbers`` end the process at once, while it only loads.

    code: it exits with;  said: on stderr, if anything
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # signals are the main thread's
        return

    def end(*_: object) -> None:
        os.write(STDERR, said.encode())
        os._exit(code)

    before = {number: signal.getsignal(number) for number in numbers}
    for number, handler in before.items():
        if handler is not signal.SIG_IGN:  # as SIGHUP is below nohup
            signal.signal(number, end)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)
