"""Signals and BLAS threads of a program while it loads.

A signal while the program only loads ends it at once, without a traceback. This module imports
nothing that takes time, because signals are not handled before.
"""

import os
import signal
import sys
import threading
from collections.abc import Collection, Iterator
from contextlib import contextmanager

STDERR = 2
# Number of BLAS threads. With several, long sums depend on their number, and on a busy computer
# they wait for each other for ten times as long as they compute.
_THREADS = "OMP_NUM_THREADS"
_PR_SET_PDEATHSIG = 1  # of <linux/prctl.h>


def one_thread_of_blas() -> None:
    """Limit BLAS to one thread, unless the user has set their number; call before it is loaded."""
    os.environ.setdefault(_THREADS, "1")


def end_with_parent(number: signal.Signals) -> None:
    """Let Linux send ``number`` to this process when the one that started it ends, even killed."""
    if sys.platform == "linux":
        import ctypes

        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, number)


@contextmanager
def exit_on_signal_while_loading(
    numbers: Collection[signal.Signals], code: int = 0, said: str = ""
) -> Iterator[None]:
    """End the process at once on the signals ``numbers`` while it only loads.

    code: exit status;  said: text for stderr, if any
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread handles signals
        return

    def end(*_: object) -> None:
        os.write(STDERR, said.encode())
        os._exit(code)

    before = {number: signal.getsignal(number) for number in numbers}
    for number, handler in before.items():
        if handler is not signal.SIG_IGN:  # as SIGHUP is under nohup
            signal.signal(number, end)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)
