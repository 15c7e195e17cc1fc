"""Which samples of a stream of unknown length stand for all of it, in bounded memory?"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


class EvenSelection:
    """Keeps every k-th row, k the least power of two with which no more than ``most`` are kept.

    What is kept does not depend on how the stream was cut. It lies in one piece: of small parts
    each would cost more than its rows, for as long as the stream lasts.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._every = 1
        self._seen = 0
        self._room: NDArray[Any] = np.empty(0)

    def __len__(self) -> int:
        """Rows kept."""
        return -(-self._seen // self._every)

    @property
    def every(self) -> int:
        """Of how many rows one is kept."""
        return self._every

    def add(self, rows: NDArray[Any]) -> None:
        """Take in the next ``rows`` (n, …)."""
        self.add_chosen(rows[self.chosen(len(rows))], len(rows))

    def chosen(self, rows: int) -> slice:
        """Return which of the next ``rows`` are wanted, for whoever makes only those."""
        while -(-(self._seen + rows) // self._every) > self._most:
            self._halve()
        return slice(-self._seen % self._every, rows, self._every)

    def add_chosen(self, part: NDArray[Any], rows: int) -> None:
        """Take in what :meth:`chosen` asked for, (k, …), of the next ``rows``."""
        held = len(self)
        self._seen += rows
        if len(part):
            self._make_room(held, part)
            self._room[held : held + len(part)] = part

    def _make_room(self, held: int, part: NDArray[Any]) -> None:
        needed = held + len(part)
        if needed > len(self._room):
            room = np.empty((min(max(2 * held, needed), self._most), *part.shape[1:]), part.dtype)
            if held:
                room[:held] = self._room[:held]
            self._room = room

    def _halve(self) -> None:
        """Leave out every other row."""
        held = len(self)
        self._room[: -(-held // 2)] = self._room[:held:2].copy()
        self._every *= 2

    def rows(self) -> NDArray[Any]:
        """Return all rows kept so far, in order, until the next are added; empty before any."""
        return self._room[: len(self)]
