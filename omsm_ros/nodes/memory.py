"""Limits the memory of a node's process.

The module has no slow imports, since it is needed before the others load.
"""

import gc
import os
import signal
import sys
from collections.abc import Collection
from contextlib import suppress
from typing import Any

RETURN_PERIOD_S = 10.0
"""Time between two returns of free memory to the system [s]."""

_M_ARENA_MAX = -8  # of <malloc.h>
_SETTINGS, _KEPT_BY_THREADS = "GLIBC_TUNABLES", "glibc.malloc.tcache_count"


def use_single_malloc_arena(held_back: Collection[signal.Signals] = ()) -> None:
    """Let all threads share one malloc arena, without caches of their own.

    Each thread of the middleware would keep an arena, and a cache of seven freed pieces of each
    size, which keep the pages around them from being returned. glibc reads that setting only at the
    start of a process, so this process executes itself again, unless it is set. Signals
    ``held_back`` are blocked until then.
    """
    mallopt = _from_glibc("mallopt")
    if mallopt is None:
        return
    mallopt(_M_ARENA_MAX, 1)
    before = os.environ.get(_SETTINGS, "")
    if _KEPT_BY_THREADS not in before:
        os.environ[_SETTINGS] = f"{before}:{_KEPT_BY_THREADS}=0".lstrip(":")
        signal.pthread_sigmask(signal.SIG_BLOCK, held_back)
        with suppress(OSError):  # then it continues without
            os.execv(sys.executable, sys.orig_argv)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, held_back)


def freeze_garbage_collector() -> None:
    """Exclude the present objects from garbage collection: a node needs them to its end.

    Its modules have more than 80 000 objects. Without them a collection takes less than a
    millisecond, so ``return_free_memory`` can do one while samples arrive.
    """
    gc.collect()
    gc.freeze()


def return_free_memory() -> None:
    """Collect garbage, and return free memory within the heap to the system.

    Messages that a subscriber has not taken are kept. When they are freed, small pieces behind them
    are still in use, so without trimming the heap stays as large as the largest backlog, and grows
    with fragmentation.

    Python's own full collections come only when a quarter of all objects is new; until then unused
    cycles, and up to 2000 empty tuples of each length, let a node grow for hours.
    """
    gc.collect()
    trim = _from_glibc("malloc_trim")
    if trim is not None:
        trim(0)


def _from_glibc(name: str) -> Any:
    import ctypes  # here, because signals are not handled while this module loads

    return getattr(ctypes.CDLL(None), name, None)
