"""Memory that was freed goes back to the system, also from below what is still in use."""

import ctypes
from pathlib import Path

import pytest

from omsm_ros.nodes.memory import give_back

PIECE, COUNT = 4000, 4000


def held_kib():
    (line,) = (t for t in Path("/proc/self/status").read_text().splitlines() if "RssAnon" in t)
    return int(line.split()[1])


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "malloc_trim"), reason="not glibc")
def test_what_was_freed_below_a_piece_in_use_is_given_back():
    """As a backlog is freed while younger pieces stay; 16 MB, of which the pool keeps none."""
    libc = ctypes.CDLL(None)
    libc.malloc.restype = ctypes.c_void_p
    libc.free.argtypes = [ctypes.c_void_p]
    give_back()
    before = held_kib()
    pieces = [libc.malloc(PIECE) for _ in range(COUNT)]
    for piece in pieces:
        ctypes.memset(piece, 1, PIECE)
    last = pieces.pop()
    full = held_kib() - before
    for piece in pieces:
        libc.free(piece)
    kept = held_kib() - before
    give_back()
    left = held_kib() - before
    libc.free(last)
    size = PIECE * COUNT / 1024
    assert full > 0.9 * size
    assert kept > 0.9 * size  # else there would be nothing to mend
    assert left < 0.1 * size
