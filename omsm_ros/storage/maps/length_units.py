"""Units of length as files and people write them."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from omsm_ros.errors import FileError
from omsm_ros.quantities import shown

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
