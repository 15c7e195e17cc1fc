"""State and show the progress of a task."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event, Thread

Progress = Callable[[int, int], None]
"""Function of the number done and the total: messages, samples or bags."""

_TICK_S = 0.5
_stated = 0, 0


def state_progress(done: int, total: int) -> None:
    """State how much of the process's task is done, and of how much; total 0: not known."""
    global _stated
    _stated = done, total


def stated_progress() -> tuple[int, int]:
    """Return what was stated last."""
    return _stated


@contextmanager
def refresh_in_thread(show: Callable[[Event], object]) -> Iterator[None]:
    """Run ``show`` in a thread; set its event at the end and wait for it."""
    done = Event()
    shown = Thread(target=show, args=(done,), daemon=True)
    shown.start()
    try:
        yield
    finally:
        done.set()
        shown.join()


def tick(refresh: Callable[[], object], done: Event) -> None:
    """Call ``refresh``, which draws a line again, twice per second until ``done``."""
    while not done.wait(_TICK_S):
        refresh()
