"""How far is a task? Who does it tells whoever wants to know."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event, Thread
from typing import Protocol

Progress = Callable[[int, int], None]
"""Called with what is done and what there is in all: messages, lines or bags."""


def no_progress(done: int, total: int) -> None:
    """Report to nobody."""


# The seconds of a line on a terminal, which go on while nothing is counted.

_TICK_S = 0.5


class ProgressLine(Protocol):
    """What shows a time, as a bar of ``tqdm`` does."""

    def refresh(self) -> object:
        """Show it anew."""


@contextmanager
def refresh_in_thread(show: Callable[[Event], object]) -> Iterator[None]:
    """Let ``show`` run in a thread of its own; its event is set at the end, which waits for it."""
    done = Event()
    shown = Thread(target=show, args=(done,), daemon=True)
    shown.start()
    try:
        yield
    finally:
        done.set()
        shown.join()


def tick(line: ProgressLine, done: Event) -> None:
    """Refresh ``line`` twice a second until ``done``."""
    while not done.wait(_TICK_S):
        line.refresh()
