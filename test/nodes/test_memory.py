"""Memory that was freed goes back to the system, also from below what is still in use."""

import ctypes
import gc
import os
import subprocess
import sys
import weakref
from pathlib import Path

import pytest

from omsm_ros.nodes.memory import return_free_memory

PIECE, COUNT = 4000, 4000

# Takes the pieces, frees all but the last, then returns what is free; the held memory after each.
BACKLOG = """
import ctypes
from omsm_ros.nodes import memory
from nodes.test_memory import COUNT, PIECE, held_kib

libc = ctypes.CDLL(None)
libc.malloc.restype = ctypes.c_void_p
libc.free.argtypes = [ctypes.c_void_p]
memory.return_free_memory()
before = held_kib()
pieces = [libc.malloc(PIECE) for _ in range(COUNT)]
for piece in pieces:
    ctypes.memset(piece, 1, PIECE)
print(held_kib() - before)
last = pieces.pop()
for piece in pieces:
    libc.free(piece)
print(held_kib() - before)
memory.return_free_memory()
print(held_kib() - before)
"""

# Each thread takes small pieces, seven of each size, far apart, frees all, and lives on.
BURST = """
import ctypes, signal, sys, threading
from omsm_ros.nodes import memory
from nodes.test_memory import held_kib

if sys.argv[1] == "nodes":
    memory.use_single_malloc_arena([signal.SIGINT])
libc = ctypes.CDLL(None)
libc.malloc.restype = ctypes.c_void_p
libc.free.argtypes = [ctypes.c_void_p]
done, end = threading.Barrier(9), threading.Event()

def burst():
    taken = [libc.malloc(n) for k in range(7) for size in range(16, 1025, 16) for n in (size, 3000)]
    for place in taken:
        ctypes.memset(place, 1, 16)
    for place in taken:
        libc.free(place)
    done.wait()
    end.wait()

before = held_kib()
for _ in range(8):
    threading.Thread(target=burst).start()
done.wait()
memory.return_free_memory()
print(held_kib() - before)
end.set()
"""
# Tells what it was begun with; asked to end as it begins again, it ends only where it hears it.
BEGUN = """
import os, signal, sys
from omsm_ros.nodes import memory

again = "tcache" in os.environ.get("GLIBC_TUNABLES", "")
signal.signal(signal.SIGUSR1, lambda *_: print("heard"))
if not again:
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGUSR1])
    os.kill(os.getpid(), signal.SIGUSR1)
print(os.getpid(), sys.argv[1:], os.environ.get("GLIBC_TUNABLES"), flush=True)
memory.use_single_malloc_arena([signal.SIGUSR1])
"""
# As a node keeps what it loaded: what refers to itself alone is gone, now and later.
KEPT = """
import gc
from omsm_ros.nodes import memory
from nodes.test_memory import lost_cycle

gc.disable()
early = lost_cycle()
memory.freeze_garbage_collector()
print(early() is None, gc.get_freeze_count() > 1000, len(gc.get_objects()) < 100)
late = lost_cycle()
memory.return_free_memory()
print(late() is None)
"""
glibc = pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "malloc_trim"), reason="not glibc")


def held_kib():
    (line,) = (t for t in Path("/proc/self/status").read_text().splitlines() if "RssAnon" in t)
    return int(line.split()[1])


class Cycle:
    """An object that refers to itself."""

    def __init__(self):
        self.itself = self


def lost_cycle():
    """A weak reference to a cycle that nothing else refers to."""
    return weakref.ref(Cycle())


def test_cycles_that_nothing_refers_to_are_given_back():
    gc.disable()
    try:
        cycle = lost_cycle()
        assert cycle() is not None
        return_free_memory()
        assert cycle() is None
    finally:
        gc.enable()


def test_what_a_node_loaded_is_looked_through_no_more():
    assert said(KEPT) == ["True True True", "True"]


@glibc
def test_what_was_freed_below_a_piece_in_use_is_given_back():
    """As a backlog is freed while younger pieces stay; 16 MB in a heap of its own."""
    full, kept, left = map(int, said(BACKLOG))
    size = PIECE * COUNT / 1024
    assert full > 0.9 * size
    assert kept > 0.9 * size  # else there would be nothing to mend
    assert left < 0.1 * size


def said(program, *arguments, **settings):
    """Its lines, run as a process whose glibc was told ``settings`` alone."""
    reported = {name: value for name, value in os.environ.items() if name != "GLIBC_TUNABLES"}
    reported["PYTHONPATH"] = os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])
    command = [sys.executable, "-c", program, *arguments]
    done = subprocess.run(command, env=reported | settings, check=True, stdout=subprocess.PIPE)
    return done.stdout.decode().splitlines()


@glibc
def test_threads_of_a_node_keep_nothing_of_a_burst():
    """Eight of them, of some 1.4 MB each; by default the small pieces hold most of it."""
    (usual,) = said(BURST, "others")
    assert int(usual) > 6000  # else there would be nothing to mend
    (kept,) = said(BURST, "nodes")
    assert int(kept) < 1000


@glibc
def test_a_process_begins_again_once_as_it_was():
    first, second, heard = said(BEGUN, "a b", "c")
    number, arguments = first.split(" ", 1)
    assert arguments == "['a b', 'c'] None"
    assert second == f"{number} ['a b', 'c'] glibc.malloc.tcache_count=0"
    assert heard == "heard"


@glibc
def test_user_settings_of_glibc_are_kept():
    other = "glibc.malloc.perturb=0"
    _, second, _ = said(BEGUN, GLIBC_TUNABLES=other)
    assert second.endswith(f"{other}:glibc.malloc.tcache_count=0")
    chosen = "glibc.malloc.tcache_count=3"
    (only,) = said(BEGUN, GLIBC_TUNABLES=chosen)
    assert only.endswith(chosen)
