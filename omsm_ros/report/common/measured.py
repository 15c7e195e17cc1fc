"""A value and its standard uncertainty as text, as the GUM wants them written."""

from __future__ import annotations

import math

from omsm_ros.report.common.tables import NOTHING, quantity

_NARROW_SPACE = "\N{NARROW NO-BREAK SPACE}"
_PREFIXES = {-9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M"}
# A value far smaller than its uncertainty, or far larger, gets no absurd row of digits.
_MOST_DECIMALS = 9
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def number(value: object) -> float | None:
    """``value`` if it is a finite number, None if it is anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if math.isfinite(value) else None


def measured(value: object, uncertainty: object, unit: str = "", digits: int = 4) -> str:
    """``339.7 µs ± 1.1 µs``: two digits of the standard uncertainty, the value to the same place.

    Without an uncertainty the value alone, to ``digits``; without a unit no prefix either.
    """
    known, spread = number(value), number(uncertainty)
    if known is None:
        return NOTHING
    if not spread or spread < 0:
        return quantity(known, unit, digits) if unit else plain(known, digits)
    # Rounded first: an uncertainty of 0.996 is one of 1.0.
    spread = float(f"{spread:.1e}")
    exponent = _exponent(max(abs(known), spread)) if unit else 0
    decimals = min(max(1 - math.floor(math.log10(spread)) + exponent, 0), _MOST_DECIMALS)
    tail = f"{_NARROW_SPACE}{_PREFIXES[exponent]}{unit}" if unit else ""
    both = (f"{part / 10.0**exponent:.{decimals}f}{tail}" for part in (known, spread))
    return " ± ".join(both).replace("-", "−")


def plain(value: object, digits: int = 3) -> str:
    """A number without a unit; a dash for anything else."""
    known = number(value)
    if known is None:
        return NOTHING
    if known == 0:
        return "0"
    if 1e-3 <= abs(known) < 10**digits:
        return f"{known:#.{digits}g}".rstrip(".").replace("-", "−")
    mantissa, _, power = f"{known:.{digits - 1}e}".partition("e")
    return f"{mantissa} · 10{raised(int(power))}".replace("-", "−")


def raised(power: int) -> str:
    """A power as a superscript."""
    return str(power).translate(_SUPERSCRIPTS)


def probability(value: object) -> str:
    """A p-value: three digits, or that it is smaller than one could care for."""
    known = number(value)
    if known is None:
        return NOTHING
    return "< 0.0001" if known < 1e-4 else f"{known:.3g}"


def _exponent(value: float) -> int:
    return min(max(3 * (math.floor(math.log10(value)) // 3), min(_PREFIXES)), max(_PREFIXES))
