"""What has happened lately, as against ever? A fault of this morning is history, not a state.

All times come from the caller [s], from a clock that only goes forward.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

# As long as somebody who looks up at an alarm needs to find its cause still named.
WINDOW_S = 10.0


class RecentIncrease:
    """By how much counts rose within the last ``window`` [s].

    What was counted before the first look counts as new then.
    """

    def __init__(self, window: float = WINDOW_S) -> None:
        self._window = window
        self._looks: deque[tuple[float, dict[str, float]]] = deque()

    def update(self, counts: Mapping[str, float], now: float) -> dict[str, float]:
        """Return name → increase, of those that rose; a count that fell began anew at zero."""
        self._looks.append((now, dict(counts)))
        while len(self._looks) > 1 and self._looks[1][0] <= now - self._window:
            self._looks.popleft()
        since, before = self._looks[0]
        base = before if since <= now - self._window else {}
        rises = {
            name: value - earlier if value >= (earlier := base.get(name, 0)) else value
            for name, value in counts.items()
        }
        return {name: rise for name, rise in rises.items() if rise > 0}


class Flow:
    """Samples that come: how many a second, and since when none."""

    def __init__(self, window: float = WINDOW_S) -> None:
        self._window = window
        self._looks: deque[tuple[float, int]] = deque()
        self._last: float | None = None

    def update(self, samples: int, now: float) -> None:
        """Note the number of ``samples`` that came in all."""
        if samples > (self._looks[-1][1] if self._looks else 0):
            self._last = now
        self._looks.append((now, samples))
        while len(self._looks) > 2 and self._looks[1][0] <= now - self._window:
            self._looks.popleft()

    def silent(self, now: float) -> float | None:
        """Return the time since a sample was last seen to have come; None if none ever did."""
        return None if self._last is None else now - self._last

    @property
    def rate(self) -> float:
        """Samples a second over the window [1/s]."""
        if len(self._looks) < 2:
            return 0.0
        (start, before), (end, after) = self._looks[0], self._looks[-1]
        return (after - before) / (end - start) if end > start else 0.0
