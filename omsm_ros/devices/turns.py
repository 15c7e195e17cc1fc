"""Whole turns of encoders that wrap, also past telegrams that noise on the wire has garbled."""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from omsm_ros.core.samples.blocks import IntArray

# Of a turn: no axis changes its step by more from one sample to the next.
_LITTLE = 1 / 64
# Steps in a row that differ by little: this is where the axis is, wherever it was before. Of
# garbled counts so many do so by chance once in 10⁹.
_ALIKE = 6

_Steps = TypeVar("_Steps", IntArray, int)


class Turns:
    """Continues the counts of an encoder that starts again at zero after ``wrap``; 0 = never.

    The axis moves less than half a turn between two samples, so a step is the shorter way round.
    Two steps to a garbled count and back may add up to a whole turn. So the count before a jump is
    kept: what comes back to it, or goes on elsewhere, has the turns that bring it next to it.
    """

    def __init__(self, wrap: int) -> None:
        self._wrap = wrap
        self._last = self._step = 0
        self._seen = 0  # samples since the first, or since one whose first steps differed
        self._kept: int | None = None  # the count before a jump
        self._since = self._alike = 0

    def continued(self, counts: IntArray) -> IntArray:
        """Return the counts (n,) with their whole turns; the first of all are within one."""
        if not self._wrap:
            return counts
        if self._seen > _ALIKE and self._kept is None:
            steps = self._shorter(np.diff(counts, prepend=self._last))
            before = np.concatenate([[self._step], steps[:-1]])
            if np.all(np.abs(steps - before) <= _LITTLE * self._wrap):
                turned: IntArray = self._last + np.cumsum(steps)
                if len(turned):
                    self._last, self._step = int(turned[-1]), int(steps[-1])
                return turned
        return np.array([self._next(int(count)) for count in counts], dtype=np.int64)

    def _next(self, count: int) -> int:
        step = self._shorter(count - self._last)
        value = self._last + step
        differs = abs(step - self._step) > _LITTLE * self._wrap
        if self._kept is not None:
            value, step = self._after_a_jump(value, step, differs)
        elif self._seen <= _ALIKE:
            if self._seen == 0 or (self._seen > 1 and differs):  # the one before was garbled
                value, step, self._seen = count, 0, 0
            self._seen += 1
        elif differs:
            self._kept, self._since, self._alike = self._last, 0, 0
        self._last, self._step = value, step
        return value

    def _after_a_jump(self, value: int, step: int, differs: bool) -> tuple[int, int]:
        assert self._kept is not None
        self._since += 1
        self._alike = 0 if differs else self._alike + 1
        off = self._shorter(value - self._kept)
        if abs(off) <= _LITTLE * self._wrap:
            value, step, self._kept = self._kept + off, 0, None
        elif self._alike >= _ALIKE:
            if self._alike < self._since - 1:  # else it went there at once: a gap
                value = self._kept + off
            self._kept = None
        return value, step

    def _shorter(self, steps: _Steps) -> _Steps:
        half = self._wrap // 2
        return (steps + half) % self._wrap - half
