"""How fast does a node keep up? Latency of its blocks and its share of a processor."""

from __future__ import annotations

import numpy as np

from omsm_ros.units import MILLISECOND_S, NANOSECOND_S


class LoadMeter:
    """Latencies of the last ``window`` blocks, and processor time between two reports.

    All times come from the caller; this only counts.
    """

    def __init__(self, window: int = 10_000) -> None:
        self._latencies = np.zeros(window, np.int64)  # of the newest, in a ring [ns]
        self._blocks = 0
        self._cpu = self._wall = 0.0
        self._worst_ns = 0

    def block(self, arrived_ns: int, done_ns: int) -> None:
        """Note the block that arrived at ``arrived_ns`` and was done at ``done_ns`` [ns]."""
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
            scaled = points * NANOSECOND_S / MILLISECOND_S
            names = ("latency_median_ms", "latency_p99_ms", "latency_max_ms")
            found |= {
                name: round(float(value), 3) for name, value in zip(names, scaled, strict=True)
            }
        return found
