"""Report the progress of a task."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event, Thread
from typing import Protocol

Progress = Callable[[int, int], None]
"""Function of the number done and the total: messages, lines or bags."""

_TICK_S = 0.5


def no_progress(done: int, total: int) -> None:
    """Ignore the progress."""


class ProgressLine(Protocol):
    """A line on the terminal with the elapsed time, such as a bar of ``tqdm``."""

    def refresh(self) -> object:
        """Draw the line again."""


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


def tick(line: ProgressLine, done: Event) -> None:
    """Refresh ``line`` twice per second until ``done``."""
    while not done.wait(_TICK_S):
        line.refresh()
