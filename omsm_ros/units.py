"""Named conversion factors; everything inside the package is SI.

Multiply to enter SI (``5 * MICROMETRE_M``), divide to leave it for a reader
(``height / NANOMETRE_M``).
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from omsm_ros.errors import DataError, FileError
from omsm_ros.quantities import shown

MILLIMETRE_M = 1e-3
MICROMETRE_M = 1e-6
NANOMETRE_M = 1e-9
MILLISECOND_S = 1e-3
MICROSECOND_S = 1e-6
NANOSECOND_S = 1e-9
NANOSECONDS_PER_S = 1_000_000_000
DAY_S = 86_400.0
RPM_RAD_S = 2 * math.pi / 60
RPM_HZ = 1 / 60
PPM = 1e-6
DEGREE_RAD = math.pi / 180


# Units of another program's columns: which a map may name, and which a file shows by itself.

_INCH_M = 0.0254
_LENGTHS = {
    "m": 1.0,
    "mm": MILLIMETRE_M,
    "um": MICROMETRE_M,
    "µm": MICROMETRE_M,
    "nm": NANOMETRE_M,
    "inch": _INCH_M,
}
_ANGLES = {"rad": 1.0, "mrad": 1e-3, "deg": DEGREE_RAD, "turn": 2 * np.pi}
_TIMES = {
    "s": 1.0,
    "ms": MILLISECOND_S,
    "us": MICROSECOND_S,
    "µs": MICROSECOND_S,
    "ns": NANOSECOND_S,
}
DATE = "date"
"""The unit of instants that are no numbers in the file: dates in text, stamps of messages."""

SINCE_1970 = {
    "unix": 1.0,
    "unix_ms": MILLISECOND_S,
    "unix_us": MICROSECOND_S,
    "unix_ns": NANOSECOND_S,
}
"""Units of times since 1970, and what one of them is in seconds."""

UNITS: Mapping[str, Mapping[str, float]] = MappingProxyType(
    {
        **dict.fromkeys(("x", "y", "z", "distance"), _LENGTHS),
        **dict.fromkeys(("b", "c"), _ANGLES),
        "intensity": {"1": 1.0, "%": 0.01},
        "time": {**_TIMES, **SINCE_1970, DATE: 1.0},
        "trigger": {"1": 1.0},
    }
)
"""Units that a column of each channel may be in, and what one of them is in SI."""

COUNT = "count"
"""The unit of a raw reading: a column in it says what one count is in SI."""

# What else files call units; with a Greek mu, too.
_ALSO_LENGTHS = {
    "μm": MICROMETRE_M,
    "micron": MICROMETRE_M,
    "microns": MICROMETRE_M,
    "in": _INCH_M,
    "cm": 0.01,
    "pm": 1e-12,
    "Å": 1e-10,
    "mil": _INCH_M / 1000,
}
_ALSO_ANGLES = {
    "°": DEGREE_RAD,
    "degree": DEGREE_RAD,
    "degrees": DEGREE_RAD,
    "rev": 2 * np.pi,
    "revs": 2 * np.pi,
    "turns": 2 * np.pi,
    "gon": np.pi / 200,
    "µrad": 1e-6,
    "urad": 1e-6,
    "arcmin": DEGREE_RAD / 60,
    "arcsec": DEGREE_RAD / 3600,
}
_ALSO_TIMES = {"sec": 1.0, "msec": MILLISECOND_S, "μs": MICROSECOND_S, "min": 60.0, "h": 3600.0}
_UNRELATED_UNITS = (
    *("V", "mV", "µV", "uV", "A", "mA", "N", "Pa", "bar", "g", "K", "°C", "°F", "Hz", "kHz", "rpm"),
    *("count", "counts", "digit", "digits", "LSB", "raw"),
)
_STATED_UNITS = {
    channel: {
        **units,
        **(_ALSO_LENGTHS if "mm" in units else {}),
        **(_ALSO_ANGLES if "deg" in units else {}),
        **(_ALSO_TIMES if "ms" in units else {}),
    }
    for channel, units in UNITS.items()
}
WORDS = frozenset[str]().union(*_STATED_UNITS.values(), _UNRELATED_UNITS) - {"1"}
"""What a file may call a unit, of whatever it is; log[1] is a place."""

_TIME_NAME = re.compile(r"(?:t|time|zeit)\s*(?:[_/]|[\[(]|\s)\s*(\w+)\s*[\])]?", re.IGNORECASE)

# One turn in each unit that it may be counted in.
_TURNS = {"deg": 360.0, "rad": 2 * np.pi, "mrad": 2000 * np.pi, "turn": 1.0}
# A reading falls short of a whole turn by its own step at most.
_TURN_TOLERANCE = 0.9


def contradicts_unit(stated: str, unit: str, channel: str) -> bool:
    """Return whether ``stated``, a file's own word, is another unit than ``unit`` of the map.

    A word that is no unit says nothing, and a raw ``count`` is what the map says it is.
    """
    known = unit in UNITS[channel] and stated in WORDS
    return known and _STATED_UNITS[channel].get(stated) != UNITS[channel][unit]


def seconds_of(name: str) -> float | None:
    """Return what one of a column of time is in seconds, as its ``name`` says; None where none.

    As "time_s", "t [ms]", "Time (us)", "t/s"; one that does not say its unit says nothing.
    """
    found = _TIME_NAME.fullmatch(name.strip())
    return None if found is None else {**_TIMES, **_ALSO_TIMES}.get(found[1])


def check_share(values: NDArray[np.float64], unit: str) -> None:
    """Raise DataError where ``values`` (n,), shares of the full intensity, are mostly above 1."""
    finite = values[np.isfinite(values)]
    middle = float(np.median(finite)) if len(finite) else 0.0
    if unit and middle > 1:
        better = "'%'" if unit == "1" else "count, and count: what one is of the full intensity"
        raise DataError(
            f"intensity is {middle:.4g} of 1 at its median, more than all; write unit: {better}"
        )


def check_turns(values: NDArray[np.float64], unit: str, axis: str) -> None:
    """Raise DataError where an axis begins its turns anew after those of another unit.

    values: (n,) in ``unit``, in order. One that turns one way, stays within a turn of some unit,
    and falls back by it is counted in that unit: 359.3, 0.1, 0.8 are no radians.
    """
    finite = values[np.isfinite(values)]
    steps = np.diff(finite)
    if unit not in _TURNS or len(steps) < 2:
        return
    step, extent = float(np.median(steps)), float(np.ptp(finite))
    back = float(np.max(-np.sign(step) * steps))
    fits = [u for u, turn in _TURNS.items() if _TURN_TOLERANCE * turn < back and extent <= turn]
    if fits and unit not in fits and 0 < 10 * abs(step) < back:
        raise DataError(
            f"{axis} falls back by {back:.6g} while it turns, as one counted in {fits[0]} does, "
            f"the map says {unit}; correct the map, or write unit: {COUNT} and {COUNT}: what one "
            "is in radians"
        )


# Units of length as files and people write them.

_METRES = {
    ("m", "meter", "meters", "metre", "metres"): 1.0,
    ("cm", "centimeters", "centimetres"): 1e-2,
    ("mm", "millimeter", "millimeters", "millimetre", "millimetres"): 1e-3,
    ("um", "µm", "μm", "micron", "microns", "micrometer", "micrometers", "micrometres"): 1e-6,
    ("nm", "nanometer", "nanometers", "nanometre", "nanometres"): 1e-9,
    ("pm", "picometers", "picometres"): 1e-12,
    ("in", "inch", "inches"): 0.0254,
    ("Å", "å", "angstrom", "angstroms"): 1e-10,
}
# Of two ways to write one factor.
_ALIKE = 1e-9
NOT_USED = "its format says in which units it is: --unit was not used"
METRES = {name: factor for names, factor in _METRES.items() for name in names}
"""Metres in one of each unit."""


@dataclass(frozen=True, slots=True)
class LengthUnits:
    """What the numbers of a file count in: metres in one of them.

    lateral: of x and y;  height: of heights and their uncertainties
    where_unsaid: True if given for several files, of those that do not say
    """

    lateral: float
    height: float
    where_unsaid: bool = field(default=False, compare=False)


def metres_in(name: str) -> float | None:
    """Return the unit called ``name`` [m]; None if no such unit of length is known."""
    return METRES.get(name, METRES.get(name.lower()))


def units_of(text: str) -> LengthUnits:
    """Return the units named as ``mm`` or, with another one for the heights, ``mm,nm``.

    Raises FileError for anything else.
    """
    factors = [metres_in(part.strip()) for part in text.split(",")]
    if not 1 <= len(factors) <= 2 or None in factors:
        raise FileError(
            f"unit {shown(text)} is not known; give one of m, mm, µm, nm, in, or two as 'mm,nm' "
            "where the heights have another one"
        )
    return LengthUnits(factors[0] or 0.0, factors[-1] or 0.0)


def needed(units: LengthUnits | None, what: str) -> LengthUnits:
    """Return ``units``; raise FileError, which calls the file ``what``, if nobody named them."""
    if units is None:
        raise FileError(
            f"{what} does not say in which unit its numbers are; state it, as --unit mm "
            "(in a surface's file as unit: mm), or mm,nm where the heights have another one"
        )
    return units


def refuse_other(units: LengthUnits | None, stated: LengthUnits, what: str) -> None:
    """Raise FileError, which calls the file ``what``, where it states other units than were given.

    One of the two is wrong by a factor, and nobody but the reader can tell which.
    """
    if units is None or units.where_unsaid:
        return
    for name, given, own in (
        ("x and y", units.lateral, stated.lateral),
        ("heights", units.height, stated.height),
    ):
        if abs(given - own) > _ALIKE * own:
            raise FileError(
                f"{what} says that its {name} are in {_called(own)}, and --unit says "
                f"{_called(given)}; leave --unit out, or correct what the file says"
            )


def _called(metres: float) -> str:
    """Return the shortest name of a unit of so many metres."""
    names = [name for name, factor in METRES.items() if abs(factor - metres) <= _ALIKE * metres]
    return names[0] if names else f"{metres:g} m"


def name_and_unit(text: str) -> tuple[str, float | None]:
    """Take ``x [mm]``, ``X/mm``, ``x (mm)`` or ``x_mm`` apart: the name in lower case, the unit."""
    found = re.fullmatch(r"\s*(.+?)\s*[\[(/_]\s*([^\s\[\](),/_]+)\s*[\])]?\s*", text)
    unit = metres_in(found[2]) if found else None
    return (found[1].strip().lower(), unit) if found and unit else (text.strip().lower(), None)
