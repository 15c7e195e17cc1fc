"""Which samples of a stream of unknown length stand for all of it, in bounded memory?"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


class EvenSelection:
    """Keeps every k-th row, k the least power of two with which no more than ``most`` are kept.

    What is kept does not depend on how the stream was cut.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._every = 1
        self._seen = 0
        self._parts: list[NDArray[Any]] = []

    def __len__(self) -> int:
        """Rows kept."""
        return -(-self._seen // self._every)

    @property
    def every(self) -> int:
        """Of how many rows one is kept."""
        return self._every

    def add(self, rows: NDArray[Any]) -> None:
        """Take in the next ``rows`` (n, …)."""
        self.add_chosen(rows[self.chosen(len(rows))].copy(), len(rows))

    def chosen(self, rows: int) -> slice:
        """Return which of the next ``rows`` are wanted, for whoever makes only those."""
        while -(-(self._seen + rows) // self._every) > self._most:
            self._halve()
        return slice(-self._seen % self._every, rows, self._every)

    def add_chosen(self, part: NDArray[Any], rows: int) -> None:
        """Take in what :meth:`chosen` asked for, (k, …), of the next ``rows``."""
        self._seen += rows
        if len(part):
            self._parts.append(part)

    def _halve(self) -> None:
        """Leave out every other row, part by part, for all at once would need them twice."""
        before = 0
        for place, part in enumerate(self._parts):
            self._parts[place] = part[before % 2 :: 2].copy()
            before += len(part)
        self._every *= 2

    def rows(self) -> NDArray[Any]:
        """Return all rows kept so far, in order; empty before the first."""
        if len(self._parts) != 1:
            self._parts = [np.concatenate(self._parts)] if self._parts else [np.empty(0)]
        return self._parts[0]
