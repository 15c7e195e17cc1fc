"""The words in which the ripple guard says what it saw, and what would decide."""

from __future__ import annotations

from collections.abc import Sequence

from omsm_ros.core.spectra.hypotheses import PART, SYNCHRONOUS, StudiedScan
from omsm_ros.core.spectra.line import Line
from omsm_ros.core.spectra.scan_signal import PATH, RADIUS, TIME
from omsm_ros.readable import quantity

RATE = "an accelerometer, or a scan at another sampling rate, tells"
# A line of fifty waves is one wave elsewhere at another pace; by less it may not have moved.
_SAME_PACE = 0.02


def along(coordinate: str) -> str:
    """Return in words along what a wavelength is measured."""
    return {PATH: "along the path", RADIUS: "from ring to ring"}.get(
        coordinate, f"over {coordinate}"
    )


def images(frequency: float, rate: float) -> str:
    """Return the lowest frequencies beyond ``rate`` / 2 [Hz] that fold to ``frequency``."""
    return ", ".join(hertz(f) for f in (rate - frequency, rate + frequency)) + ", …"


def hertz(frequency: float) -> str:
    """Return a frequency [Hz] in words; lines differ in their sixth digit."""
    return quantity(frequency, "Hz", 6)


def to_decide(scans: Sequence[StudiedScan], own: int, line: Line, kinds: set[str]) -> str:
    """Return what would decide between the kinds that are left."""
    scan, found = scans[own], []
    others = [s for k, s in enumerate(scans) if k != own]
    if not any(_other_pace(scan, s, line) for s in others):
        found.append("a second scan of the part at another speed or feed")
    elif PART in kinds or SYNCHRONOUS in kinds:
        found.append("a further scan at yet another speed")
    else:
        found.append("a slower scan that resolves finer texture")
    if scan.felt is None:
        found.append("an accelerometer in the bag")
    return "needs " + " or ".join(found)


def _other_pace(scan: StudiedScan, other: StudiedScan, line: Line) -> bool:
    """Return True if any coordinate of the line runs at another pace in ``other``."""
    for name in line.possible:
        if name != TIME and name in other.coordinates:
            here, there = scan.coordinates[name].pace, other.coordinates[name].pace
            if abs(here - there) > _SAME_PACE * here:
                return True
    return False
