"""How a node's process deals with the memory that the middleware takes and frees.

Nothing is imported here that takes time: it is needed before the rest loads.
"""

from __future__ import annotations

import ctypes

RETURN_PERIOD_S = 10.0
"""Between two times at which a node gives back what it does not need."""

_M_ARENA_MAX = -8  # of <malloc.h>
_LIBC = ctypes.CDLL(None)


def share_one_pool() -> None:
    """Let all threads share one pool of memory; each of the middleware's would keep its own."""
    mallopt = getattr(_LIBC, "mallopt", None)  # glibc has it
    if mallopt is not None:
        mallopt(_M_ARENA_MAX, 1)


def give_back() -> None:
    """Return to the system what was freed in between, not at the end alone.

    What a listener has not taken is kept for it. When it is sent and freed, small pieces lie
    behind it that are not, so the pool would stay as large as the largest backlog that ever was,
    and grow with each that finds no room in what earlier ones left.
    """
    trim = getattr(_LIBC, "malloc_trim", None)  # glibc has it
    if trim is not None:
        trim(0)
