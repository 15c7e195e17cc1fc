"""How far is a task? Who does it tells whoever wants to know."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[int, int], None]
"""Called with what is done and what there is in all: messages, lines or bags."""


def no_progress(done: int, total: int) -> None:
    """Report to nobody."""
