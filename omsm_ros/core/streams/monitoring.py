"""Counters of a running node: recent increases, sample rates, latencies, and playback time.

All times come from the caller and must not decrease.
"""

from collections import deque
from collections.abc import Mapping

import numpy as np

from omsm_ros.units import MILLISECOND_S, NANOSECOND_S, NANOSECONDS_PER_S

# A fault stays in the diagnostics for this long, so that a user who looks up still sees it.
WINDOW_S = 10.0


class RecentIncrease:
    """Increase of counts within the last ``WINDOW_S``.

    At the first update all that was counted before is new.
    """

    def __init__(self) -> None:
        self._looks: deque[tuple[float, dict[str, float]]] = deque()

    def update(self, counts: Mapping[str, float], now: float) -> dict[str, float]:
        """Return name → increase of the counts that rose; one that fell was reset to zero."""
        self._looks.append((now, dict(counts)))
        while len(self._looks) > 1 and self._looks[1][0] <= now - WINDOW_S:
            self._looks.popleft()
        since, before = self._looks[0]
        base = before if since <= now - WINDOW_S else {}
        rises = {
            name: value - earlier if value >= (earlier := base.get(name, 0)) else value
            for name, value in counts.items()
        }
        return {name: rise for name, rise in rises.items() if rise > 0}


class SampleFlow:
    """Sample rate of a stream over ``WINDOW_S``, and the time since its last sample."""

    def __init__(self) -> None:
        self._looks: deque[tuple[float, int]] = deque()
        self._last: float | None = None

    def update(self, samples: int, now: float) -> None:
        """Enter the total number of ``samples`` so far."""
        if samples > (self._looks[-1][1] if self._looks else 0):
            self._last = now
        self._looks.append((now, samples))
        while len(self._looks) > 2 and self._looks[1][0] <= now - WINDOW_S:
            self._looks.popleft()

    def silent(self, now: float) -> float | None:
        """Return the time since the last sample [s]; None before the first one."""
        return None if self._last is None else now - self._last

    @property
    def rate(self) -> float:
        """Sample rate over the window [1/s]."""
        if len(self._looks) < 2:
            return 0.0
        (start, before), (end, after) = self._looks[0], self._looks[-1]
        return (after - before) / (end - start) if end > start else 0.0


class LoadMeter:
    """Latencies of the last ``window`` blocks, and processor time between two reports."""

    def __init__(self, window: int = 10_000) -> None:
        self._latencies = np.zeros(window, np.int64)  # ring buffer [ns]
        self._blocks = 0
        self._cpu = self._wall = 0.0
        self._worst_ns = 0

    def block(self, arrived_ns: int, done_ns: int) -> None:
        """Enter a block that arrived at ``arrived_ns`` and was done at ``done_ns`` [ns]."""
        self._latencies[self._blocks % len(self._latencies)] = done_ns - arrived_ns
        self._blocks += 1
        self._worst_ns = max(self._worst_ns, done_ns - arrived_ns)

    def worst_ms(self) -> float:
        """Return the greatest latency since the last call [ms]."""
        worst, self._worst_ns = self._worst_ns, 0
        return worst * NANOSECOND_S / MILLISECOND_S

    def report(self, cpu: float, wall: float) -> dict[str, float]:
        """Return median, 99 % point and maximum latency [ms]; share of a core since last called.

        cpu, wall: processor time used so far, and any steady clock [s]
        """
        share = (cpu - self._cpu) / (wall - self._wall) if wall > self._wall else 0.0
        self._cpu, self._wall = cpu, wall
        found = {"cpu_share": round(share, 4)}
        if self._blocks:
            points = np.percentile(self._latencies[: self._blocks], (50, 99, 100))
            values = np.round(points * NANOSECOND_S / MILLISECOND_S, 3).tolist()
            names = ("latency_median_ms", "latency_p99_ms", "latency_max_ms")
            found |= zip(names, values, strict=True)
        return found


class Playback:
    """Time of a recording that is played, against a steady clock [s].

    begin_ns: time of the recording at which it begins [ns]
    rate: seconds of the recording per second; 0 plays all at once
    """

    def __init__(self, begin_ns: int, rate: float) -> None:
        self._begin_ns, self._rate = begin_ns, rate
        self._played = 0.0  # seconds of the recording up to the last resume
        self._since: float | None = None

    @property
    def paused(self) -> bool:
        """True while the recording is paused."""
        return self._since is None

    def resume(self, now: float) -> None:
        """Continue, if paused."""
        if self._since is None:
            self._since = now

    def pause(self, now: float) -> None:
        """Pause, if playing."""
        self._played, self._since = self._seconds(now), None

    def go_to(self, stamp_ns: int, now: float) -> None:
        """Continue from another time of the recording."""
        self._played = (stamp_ns - self._begin_ns) / NANOSECONDS_PER_S
        self._since = None if self._since is None else now

    def time_ns(self, now: float) -> int:
        """Return the time of the recording [ns]."""
        return self._begin_ns + round(self._seconds(now) * NANOSECONDS_PER_S)

    def late(self, stamp_ns: int, now: float) -> float | None:
        """Return how long a message of ``stamp_ns`` has been due [s]; None if it is not due yet.

        At rate 0 every message is due at once.
        """
        if self.paused:
            return None
        if not self._rate:
            return 0.0
        overdue = (self.time_ns(now) - stamp_ns) / (NANOSECONDS_PER_S * self._rate)
        return overdue if overdue >= 0 else None

    def _seconds(self, now: float) -> float:
        return self._played + (0.0 if self._since is None else (now - self._since) * self._rate)
