"""Conversion factors and the table of units; inside the package everything is SI.

Multiply to enter SI (``5 * MICROMETRE_M``), divide to leave it (``height / NANOMETRE_M``).
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import NamedTuple

from omsm_ros.errors import FileError
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


class _Unit(NamedTuple):
    """One unit: its SI value, its names in a column map, and further names that files use.

    The first name is the one that messages use. The micro sign has two code points.
    """

    si: float
    names: str
    others: str = ""


_LENGTHS = (
    _Unit(1.0, "m", "meter meters metre metres"),
    _Unit(MILLIMETRE_M, "mm", "millimeter millimeters millimetre millimetres"),
    _Unit(MICROMETRE_M, "um µm", "μm micron microns micrometer micrometers micrometre micrometres"),
    _Unit(NANOMETRE_M, "nm", "nanometer nanometers nanometre nanometres"),
    _Unit(0.0254, "inch", "in inches"),
    _Unit(1e-2, "", "cm centimeters centimetres"),
    _Unit(MICROMETRE_M, "", "âµm"),  # µm in UTF-8, read as Latin-1 and in lower case
    _Unit(2.54e-5, "", "mil"),
    _Unit(1e-10, "", "Å å angstrom angstroms"),
    _Unit(1e-12, "", "pm picometers picometres"),
)
_ANGLES = (
    _Unit(1.0, "rad"),
    _Unit(1e-3, "mrad"),
    _Unit(DEGREE_RAD, "deg", "° degree degrees"),
    _Unit(2 * math.pi, "turn", "turns rev revs"),
    _Unit(math.pi / 200, "", "gon"),
    _Unit(1e-6, "", "µrad urad"),
    _Unit(DEGREE_RAD / 60, "", "arcmin"),
    _Unit(DEGREE_RAD / 3600, "", "arcsec"),
)
_TIMES = (
    _Unit(1.0, "s", "sec"),
    _Unit(MILLISECOND_S, "ms", "msec"),
    _Unit(MICROSECOND_S, "us µs", "μs"),
    _Unit(NANOSECOND_S, "ns"),
    _Unit(60.0, "", "min"),
    _Unit(3600.0, "", "h"),
)
_SHARES = (_Unit(1.0, "1"), _Unit(0.01, "%"))
# Names of units that no channel has.
_OTHER_QUANTITIES = (
    "V mV µV uV A mA N Pa bar g K °C °F Hz kHz rpm count counts digit digits LSB raw"
)

DATE = "date"
"""The unit of instants that a file does not give as numbers: dates in text, message stamps."""

COUNT = "count"
"""The unit of a raw reading: the column map states the SI value of one count."""

SINCE_1970 = {
    "unix": 1.0,
    "unix_ms": MILLISECOND_S,
    "unix_us": MICROSECOND_S,
    "unix_ns": NANOSECOND_S,
}
"""Units of times since 1970, with the seconds in one of them."""


def _by_name(units: tuple[_Unit, ...], others: bool) -> dict[str, float]:
    """Return the SI value of each unit by name, with the further names if ``others``."""
    return {
        name: unit.si
        for unit in units
        for name in (unit.names + " " * others + unit.others * others).split()
    }


def _channels(others: bool) -> dict[str, dict[str, float]]:
    length, angle, time, share = (
        _by_name(units, others) for units in (_LENGTHS, _ANGLES, _TIMES, _SHARES)
    )
    return {
        **dict.fromkeys(("x", "y", "z", "distance"), length),
        **dict.fromkeys(("b", "c"), angle),
        "intensity": share,
        "time": {**time, **SINCE_1970, DATE: 1.0},
        "trigger": {"1": 1.0},
    }


UNITS: Mapping[str, Mapping[str, float]] = MappingProxyType(_channels(others=False))
"""Units that a column map may name for each channel, with their SI value."""

_IN_FILES = _channels(others=True)
WORDS = frozenset[str]().union(*_IN_FILES.values(), _OTHER_QUANTITIES.split()) - {"1"}
"""All names of units that may stand in a file; 1 is left out, because log[1] is an index."""

METRES = _by_name(_LENGTHS, others=True)
"""Metres in one of each unit of length."""

_TIME_NAME = re.compile(r"(?:t|time|zeit)\s*(?:[_/]|[\[(]|\s)\s*(\w+)\s*[\])]?", re.IGNORECASE)


def contradicts_unit(stated: str, unit: str, channel: str) -> bool:
    """Return whether ``stated``, a word in the file, is another unit than ``unit`` of the map.

    A word that is no unit, and a map that says ``count``, contradict nothing.
    """
    known = unit in UNITS[channel] and stated in WORDS
    return known and _IN_FILES[channel].get(stated) != UNITS[channel][unit]


def seconds_of(name: str) -> float | None:
    """Return the seconds in the unit that the ``name`` of a time column states, else None.

    Examples: "time_s", "t [ms]", "Time (us)", "t/s".
    """
    found = _TIME_NAME.fullmatch(name.strip())
    return None if found is None else _by_name(_TIMES, others=True).get(found[1])


# Relative difference of two decimal notations of one factor.
_ROUNDING = 1e-9
NOT_USED = "its format says in which units it is: --unit was not used"


@dataclass(frozen=True, slots=True)
class LengthUnits:
    """Units of length of a file, as metres in one of them.

    lateral: of x and y;  height: of heights and their uncertainties
    where_unsaid: True if given for several files, for those that state no unit
    """

    lateral: float
    height: float
    where_unsaid: bool = field(default=False, compare=False)


def metres_in(name: str) -> float | None:
    """Return the metres in the unit called ``name``; None if no such unit of length is known."""
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
    """Return ``units``; raise FileError, which calls the file ``what``, if they are None."""
    if units is None:
        raise FileError(
            f"{what} does not say in which unit its numbers are; state it, as --unit mm "
            "(in a surface's file as unit: mm), or mm,nm where the heights have another one"
        )
    return units


def refuse_other(units: LengthUnits | None, stated: LengthUnits, what: str) -> None:
    """Raise FileError, which calls the file ``what``, if it states other units than given."""
    if units is None or units.where_unsaid:
        return
    for name, given, own in (
        ("x and y", units.lateral, stated.lateral),
        ("heights", units.height, stated.height),
    ):
        if abs(given - own) > _ROUNDING * own:
            raise FileError(
                f"{what} says that its {name} are in {_called(own)}, and --unit says "
                f"{_called(given)}; leave --unit out, or correct what the file says"
            )


def _called(metres: float) -> str:
    """Return the name of the unit of length that is ``metres`` long."""
    names = (name for name, si in METRES.items() if abs(si - metres) <= _ROUNDING * metres)
    return next(names, f"{metres:g} m")


def name_and_unit(text: str) -> tuple[str, float | None]:
    """Return name in lower case and unit [m] of ``x [mm]``, ``X/mm``, ``x_mm`` or ``x mm``."""
    found = re.fullmatch(
        r"\s*(.+?)(?:\s*[\[(/_]|\s(?:in\s)?)\s*([^\s\[\](),/_]+)\s*[\])]?\s*", text
    )
    unit = metres_in(found[2]) if found else None
    return (found[1].strip().lower(), unit) if found and unit else (text.strip().lower(), None)
