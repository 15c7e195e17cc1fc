"""Seconds on the terminal, where a command works for long and nobody can tell how long."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from threading import Event

from omsm_ros.seconds import beside, tick

# What is over before that needs no line.
_PATIENCE_S = 1.0


@contextmanager
def at_work(title: str, quiet: bool) -> Iterator[None]:
    """Count the seconds on stderr, with ``title``; silent for programs, in pipes and at first.

    Bars of what can be counted stand below it.
    """
    if quiet or not sys.stderr.isatty():
        yield
        return
    with beside(partial(_show, title)):
        yield


def _show(title: str, done: Event) -> None:
    if done.wait(_PATIENCE_S):
        return
    from tqdm import tqdm

    with tqdm(desc=title, bar_format="{desc}: {elapsed} so far", leave=False) as line:
        line.start_t -= _PATIENCE_S
        tick(line, done)
