"""Numbers as people read them: SI prefixes, units, rounding, uncertainties.

Every text for people (messages, verdicts, tables of the command line, pages) takes its numbers
from here. Plain characters throughout, so that a terminal shows and a search finds them; pages
replace them by typographic ones (:mod:`omsm_ros.report.page_parts`). A number that the
reader is to type back stays in the unit of its field instead.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from datetime import datetime, timezone

from omsm_ros.units import DAY_S, NANOSECONDS_PER_S

NOTHING = "–"
# Nothing smaller than nano: lengths below it are read as 0.31 nm.
_PREFIXES = {-9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M"}
_WITHOUT_PREFIX = {"", "%", "°", "°C", "K", "d", "ppm", "kg", "rpm"}
# A value far smaller than its uncertainty, or far larger, gets no absurd row of digits.
_MOST_DECIMALS = 9
# 0.000319 nm can be read; with more zeros it is 3.19 · 10⁻⁵ nm.
_MOST_ZEROS = 4
_FIGURES = {
    "robust_peak_to_valley": "PV of 99.5 %",
    "peak_to_valley": "PV",
    "iso10110": "ISO 10110",
    "_best_fit": ", best fit of the pose",
}
_ZERNIKE_NAMES = {
    (2, 0): "power",
    (2, 2): "astigmatism",
    (2, -2): "oblique astigmatism",
    (3, 1): "coma in x",
    (3, -1): "coma in y",
    (3, 3): "trefoil",
    (3, -3): "oblique trefoil",
    (4, 0): "spherical aberration",
}
_LEAST_PROBABILITY = 1e-4
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def counts_text(counts: Mapping[str, int]) -> str:
    """Return counts in words, those of none left out: ``3 not ok, 1 duplicate``."""
    words = [f"{n} {name.replace('_', ' ')}" for name, n in counts.items() if n]
    return ", ".join(words) or "none"


def number(value: object) -> float | None:
    """Return ``value`` as float if it is a finite number, None if it is anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if math.isfinite(value) else None


def quantity(value: object, unit: str, digits: int = 3, signed: bool = False) -> str:
    """Return a number with an SI prefix, rounded to ``digits``: ``83.1 nm``.

    value: in ``unit``, which has no prefix of its own; what is no number gives a dash
    signed: a plus before what is positive
    """
    known = number(value)
    if known is None:
        return NOTHING
    # Rounded first: 999.96 becomes 1.00 k, not 1000.
    rounded = _rounded(known, digits)
    exponent = _exponent(rounded, unit)
    tail = f" {_PREFIXES[exponent]}{unit}" if unit else ""
    sign = "+" if signed and rounded > 0 else ""
    return f"{sign}{_fixed(rounded, digits, exponent)}{tail}"


def measured(value: object, uncertainty: object, unit: str = "", digits: int = 4) -> str:
    """Return a value and its standard uncertainty as the GUM wants them: ``339.7 µs ± 1.1 µs``.

    Two digits of the uncertainty, the value to the same place. Without an uncertainty the value
    alone, to ``digits``; without a unit no prefix either.
    """
    known, spread = number(value), number(uncertainty)
    if known is None:
        return NOTHING
    if not spread or spread < 0:
        return quantity(known, unit, digits) if unit else plain(known, digits)
    # Rounded first: an uncertainty of 0.996 is one of 1.0.
    spread = _rounded(spread, 2)
    exponent = _exponent(max(abs(known), spread), unit)
    decimals = min(max(1 - math.floor(math.log10(spread)) + exponent, 0), _MOST_DECIMALS)
    tail = f" {_PREFIXES[exponent]}{unit}" if unit else ""
    # What rounds to zero has no sign: adding 0 to -0 gives 0.
    shown = (round(part / 10.0**exponent, decimals) + 0.0 for part in (known, spread))
    return " ± ".join(f"{part:.{decimals}f}{tail}" for part in shown)


def expanded(value: object, uncertainty: object, unit: str = "", signed: bool = False) -> str:
    """Return a value and its expanded uncertainty: ``10.9 nm ± 4.5 nm (k = 2)``.

    uncertainty: standard;  signed: the value may be negative. Of one that may not, and is less
    than its expanded uncertainty, the bound is all that is known: ``at most 32.0 nm (k = 2)``
    """
    known, spread = number(value), number(uncertainty)
    if known is None or not spread:
        return measured(value, None, unit, 3)
    if signed or abs(known) >= 2 * spread:
        return f"{measured(value, 2 * spread, unit)} (k = 2)"
    most = max(known, 0.0) + 2 * spread
    return f"at most {quantity(most, unit) if unit else plain(most)} (k = 2)"


def figure(name: str) -> str:
    """Return how a figure of a form is called: ``PV of 99.5 %``, ``rms of points``."""
    for field, word in _FIGURES.items():
        name = name.replace(field, word)
    return name.replace("_", " ")


def zernike(n: int, m: int) -> str:
    """Return the name of a Zernike term: ``coma in x Z(3, 1)``, ``Z(5, 1)``."""
    term = f"Z({n}, {m})"
    return f"{_ZERNIKE_NAMES[n, m]} {term}" if (n, m) in _ZERNIKE_NAMES else term


def plain(value: object, digits: int = 3) -> str:
    """Return a number without a unit, to ``digits``; a dash for anything else."""
    known = number(value)
    if known is None:
        return NOTHING
    if known == 0:
        return "0"
    if 1e-3 <= abs(known) < 10**digits:
        return f"{known:#.{digits}g}".rstrip(".")
    mantissa, _, power = f"{known:.{digits - 1}e}".partition("e")
    return f"{mantissa} · 10{superscript(int(power))}"


def percent(share: object, digits: int = 2) -> str:
    """Return a share as ``0.12 %``; a dash for no number."""
    known = number(share)
    return NOTHING if known is None else quantity(100 * known, "%", digits)


def count(value: object) -> str:
    """Return a number of things, its thousands apart: ``290 011``; a dash for no number."""
    if isinstance(value, bool) or not isinstance(value, int):
        return NOTHING
    return f"{value:,}".replace(",", " ")


def probability(value: object) -> str:
    """Return a p-value to three digits, or that it is smaller than one could care for."""
    known = number(value)
    if known is None:
        return NOTHING
    least = _LEAST_PROBABILITY
    return f"< {least:g}" if known < least else f"{known:.3g}"


def p_value_text(value: object) -> str:
    """Return a p-value for a sentence: ``p = 0.23``, ``p < 0.0001``."""
    text = probability(value)
    return f"p {text}" if text.startswith("<") else f"p = {text}"


def superscript(power: int) -> str:
    """Return a power as a superscript."""
    return str(power).translate(_SUPERSCRIPTS)


def _rounded(value: float, digits: int) -> float:
    """Return the number to so many digits; the largest of all are not rounded up to infinity."""
    rounded = float(f"{value:.{digits - 1}e}")
    return rounded if math.isfinite(rounded) else value


def _exponent(value: float, unit: str) -> int:
    """Return the power of ten of the prefix."""
    if unit in _WITHOUT_PREFIX or not value:
        return 0
    exponent = 3 * (math.floor(math.log10(abs(value))) // 3)
    # A millihertz is easily taken for a megahertz.
    least = 0 if unit == "Hz" else min(_PREFIXES)
    return min(max(exponent, least), max(_PREFIXES))


def _fixed(rounded: float, digits: int, exponent: int) -> str:
    if not rounded:
        return "0"
    magnitude = math.floor(math.log10(abs(rounded)))
    if magnitude < exponent - _MOST_ZEROS:
        return plain(rounded / 10.0**exponent, digits)
    decimals = max(digits - 1 - (magnitude - exponent), 0)
    return f"{rounded / 10.0**exponent:.{decimals}f}"


def days(seconds: object) -> str:
    """Return a time in days, "0.12 d"; what is no number gives a dash."""
    known = number(seconds)
    return NOTHING if known is None else quantity(known / DAY_S, "d", 2)


def date_text(when: datetime) -> str:
    """Return a date and time for a page, "2026-01-31 23:59 UTC"; ``when`` knows its time zone."""
    return when.astimezone(timezone.utc).strftime("%Y-%m-%d %H:%M UTC")


def date_text_of_stamp(stamp_ns: object) -> str:
    """Return a ROS time [ns] as :func:`moment` does; what is no number gives a dash."""
    known = number(stamp_ns)
    if known is None:
        return NOTHING
    return date_text(datetime.fromtimestamp(known / NANOSECONDS_PER_S, tz=timezone.utc))
