"""Device time → host time, through what every arrival proves.

A frame arrives after it was taken, never before: ``arrival - device time`` is the offset
of the two clocks plus a delay ≥ 0. Its lower envelope is therefore the offset plus the
*least* delay of the link, untouched by scheduling and buffering of the host.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from omsm_ros.errors import ConfigurationError
from omsm_ros.units import MILLISECOND_S, NANOSECONDS_PER_S, PPM

# Crystals differ by some tens of ppm; the envelope must be able to rise as fast.
DEFAULT_CREEP = 50 * PPM

# All arrivals later than this for so long are no delay any more: the host's clock was set.
HOST_STEP_NS = round(100 * MILLISECOND_S * NANOSECONDS_PER_S)
HOST_STEP_AFTER_NS = 10 * NANOSECONDS_PER_S


class DeviceClock:
    """Running minimum of ``arrival - device time`` that rises by ``creep`` [s/s] at most.

    A device clock that runs faster than the host's, however much, is followed at once; one
    that runs slower is followed up to ``creep``. Between arrivals host time is interpolated,
    so stamps neither jump nor bunch. They rise strictly whatever the arrivals do, also over
    a restart of the device. A host clock set back is followed at once (stamps stand still
    until it has caught up), one set forward after ten seconds.
    """

    def __init__(self, creep: float = DEFAULT_CREEP) -> None:
        if not 0 <= creep < 1:
            raise ConfigurationError(f"creep {creep!r} s/s, expected 0 to 1")
        self._creep = creep
        self._last_stamp: int | None = None
        self.restart()

    def restart(self) -> None:
        """Forget the offset: the device's clock started anew. Stamps still only rise."""
        self._latest: _Anchor | None = None
        self._former: _Anchor | None = None
        self._near = 0

    def observe(self, device_ns: int, arrival_ns: int) -> None:
        """A frame taken at ``device_ns`` was complete at the host at ``arrival_ns``.

        Of frames that arrive together, the last tells most and is enough.
        """
        offset = arrival_ns - device_ns
        if self._latest is None or device_ns - self._near > HOST_STEP_AFTER_NS:
            envelope, self._near = offset, device_ns
        else:
            rise = math.ceil(self._creep * max(0, device_ns - self._latest.device_ns))
            envelope = min(offset, self._latest.offset_ns + rise)
        if offset - envelope < HOST_STEP_NS:
            self._near = device_ns
        self._former, self._latest = self._latest, _Anchor(device_ns, envelope)

    def to_host(self, device_ns: int) -> int:
        """Host time [ns] of ``device_ns``, later than every stamp given before."""
        stamp = device_ns + self._offset_at(device_ns)
        if self._last_stamp is not None:
            stamp = max(stamp, self._last_stamp + 1)
        self._last_stamp = stamp
        return stamp

    def _offset_at(self, device_ns: int) -> int:
        if self._latest is None:
            raise ConfigurationError("DeviceClock.to_host before any arrival; call observe() first")
        before, after = self._former or self._latest, self._latest
        if device_ns <= before.device_ns:
            return before.offset_ns
        if device_ns >= after.device_ns:
            return after.offset_ns
        span = after.device_ns - before.device_ns
        change = after.offset_ns - before.offset_ns
        return before.offset_ns + change * (device_ns - before.device_ns) // span


class _Anchor(NamedTuple):
    """Host time minus device time [ns] at a device time [ns]."""

    device_ns: int
    offset_ns: int
