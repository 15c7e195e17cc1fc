"""How a node's process deals with the memory that the middleware takes and frees.

Nothing is imported here that takes time: it is needed before the rest loads.
"""

from __future__ import annotations

import ctypes
import gc
import os
import signal
import sys
from collections.abc import Collection
from contextlib import suppress

RETURN_PERIOD_S = 10.0
"""Between two times at which a node gives back what it does not need."""

_M_ARENA_MAX = -8  # of <malloc.h>
_LIBC = ctypes.CDLL(None)
_SETTINGS, _KEPT_BY_THREADS = "GLIBC_TUNABLES", "glibc.malloc.tcache_count"


def use_single_malloc_arena(held_back: Collection[signal.Signals] = ()) -> None:
    """Let all threads share one pool of memory; each of the middleware's would keep its own.

    A thread would also keep small pieces that were freed, seven of each size: what it needed once,
    in a burst, lies scattered behind that burst for as long as the thread lives, and no page in
    between goes back. glibc hears of that only where a process begins, so this one begins again,
    under its number, unless that was set before. Signals ``held_back`` wait until then.
    """
    mallopt = getattr(_LIBC, "mallopt", None)  # glibc has it
    if mallopt is None:
        return
    mallopt(_M_ARENA_MAX, 1)
    before = os.environ.get(_SETTINGS, "")
    if _KEPT_BY_THREADS not in before:
        os.environ[_SETTINGS] = f"{before}:{_KEPT_BY_THREADS}=0".lstrip(":")
        signal.pthread_sigmask(signal.SIG_BLOCK, held_back)
        with suppress(OSError):  # then it goes on as it is
            os.execv(sys.executable, sys.orig_argv)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, held_back)


def freeze_garbage_collector() -> None:
    """Let Python look no more through what there is by now: a node needs it to its end.

    Its modules are more than 80 000 objects. Without them a look at all that came since takes less
    than a millisecond, so that ``return_free_memory`` can ask for one while samples come in.
    """
    gc.collect()
    gc.freeze()


def return_free_memory() -> None:
    """Return to the system what was freed in between, not at the end alone.

    What a listener has not taken is kept for it. When it is sent and freed, small pieces lie
    behind it that are not, so the pool would stay as large as the largest backlog that ever was,
    and grow with each that finds no room in what earlier ones left.

    Python itself looks at all of its objects only when a quarter of them is new. Until then it
    keeps cycles that nothing refers to, and up to 2000 empty tuples of each length: a node would
    grow for hours.
    """
    gc.collect()
    trim = getattr(_LIBC, "malloc_trim", None)  # glibc has it
    if trim is not None:
        trim(0)
