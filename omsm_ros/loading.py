"""What a program settles before it loads: how it ends until then, and its threads.

Asked to end while it only loads, it does at once, and without a traceback. Nothing is imported here
that takes time: what loads before its handlers are in force has none.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Collection, Iterator
from contextlib import contextmanager

STDERR = 2
# Of BLAS, which takes one of each core for a sum over a long array: they wait for each other, on a
# busy computer for ten times as long as the sum takes, and sums depend on how many there are.
_THREADS = "OMP_NUM_THREADS"


def one_thread_of_blas() -> None:
    """Let BLAS, once it is loaded, compute in the thread that asks, unless the user has chosen."""
    os.environ.setdefault(_THREADS, "1")


@contextmanager
def exit_on_signal_while_loading(
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
