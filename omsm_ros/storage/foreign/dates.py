"""When is it that a text calls 2026-11-21T14:03:05.125+01:00?"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.units import NANOSECONDS_PER_S

EXPECTED = "expected a date after ISO 8601, as 2026-11-21T14:03:05.125+01:00"

_DATE = re.compile(
    r"(\d{4}-\d\d-\d\d)[T ](\d\d:\d\d(?::\d\d)?)(?:[.,](\d{1,9}))?\s*"
    r"(Z|[+-](?:0\d|1[0-4])(?::?[0-5]\d)?)?"
)
# What 64 bits of nanoseconds hold; a later one would be another date.
_FIRST_DAY, _LAST_DAY = "1700-01-01", "2261-12-31"


def seconds_since_1970(texts: Sequence[str], zone: str) -> FloatArray:
    """Return the instants (n,) that ``texts`` name, to a quarter of a microsecond.

    zone: of those that state none; empty = they must

    Raises ValueError, which names the remedy, for a text that is no such date, or has no zone.
    """
    days, shifts = [], []
    for text in texts:
        found = _DATE.fullmatch(text.strip().strip('"'))
        if found is None:
            raise ValueError(EXPECTED)
        day, clock, fraction, stated = found.groups()
        if not (stated or zone):
            raise ValueError("the date has no time zone; write it into the map, as zone: '+01:00'")
        if stated and zone:
            raise ValueError("the date states its time zone; leave zone out of the map")
        if not _FIRST_DAY <= day <= _LAST_DAY:
            raise ValueError(f"expected a date from {_FIRST_DAY} to {_LAST_DAY}")
        days.append(f"{day}T{clock}" + (f".{fraction}" if fraction else ""))
        shifts.append(shift_of(stated or zone))
    since = np.array(days, "datetime64[ns]").astype(np.int64)
    return np.asarray(since / NANOSECONDS_PER_S - np.array(shifts))


def shift_of(zone: str) -> float:
    """Return how far a zone is ahead of UTC [s]: of "Z", "+01", "+01:00" or "+0100"."""
    if zone == "Z":
        return 0.0
    hours, minutes = int(zone[1:3]), int(zone[3:].lstrip(":") or 0)
    return (1.0 if zone[0] == "+" else -1.0) * (hours * 3600.0 + minutes * 60.0)
