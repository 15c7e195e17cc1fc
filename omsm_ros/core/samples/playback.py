"""When is a recorded message due, played at another rate, paused, and begun later?"""

from __future__ import annotations

from omsm_ros.units import NANOSECONDS_PER_S


class Playback:
    """Time of a recording against a clock that only goes forward, whose readings are given [s].

    begin_ns: time of the recording with which it begins [ns]
    rate: seconds of the recording a second; 0 for all at once
    """

    def __init__(self, begin_ns: int, rate: float) -> None:
        self._begin_ns, self._rate = begin_ns, rate
        self._played = 0.0  # seconds of the recording, up to the last resumption
        self._since: float | None = None

    @property
    def paused(self) -> bool:
        """Whether time stands still."""
        return self._since is None

    def resume(self, now: float) -> None:
        """Let time go on, if it stands."""
        if self._since is None:
            self._since = now

    def pause(self, now: float) -> None:
        """Stop time, if it goes on."""
        self._played, self._since = self._seconds(now), None

    def go_to(self, stamp_ns: int, now: float) -> None:
        """Continue from another time of the recording."""
        self._played = (stamp_ns - self._begin_ns) / NANOSECONDS_PER_S
        self._since = None if self._since is None else now

    def time_ns(self, now: float) -> int:
        """Return the time of the recording [ns]."""
        return self._begin_ns + round(self._seconds(now) * NANOSECONDS_PER_S)

    def late(self, stamp_ns: int, now: float) -> float | None:
        """Return for how long a message of ``stamp_ns`` has been due [s]; None if it is not yet.

        At rate 0 nothing is ever late.
        """
        if self.paused:
            return None
        if not self._rate:
            return 0.0
        overdue = (self.time_ns(now) - stamp_ns) / (NANOSECONDS_PER_S * self._rate)
        return overdue if overdue >= 0 else None

    def _seconds(self, now: float) -> float:
        return self._played + (0.0 if self._since is None else (now - self._since) * self._rate)
