"""Numbers in texts: SI prefixes, units, rounding, uncertainties.

All texts (messages, verdicts, tables of the command line, pages) format their numbers here. Values
that are not finite numbers give a dash. The characters are plain, for terminals and searches;
pages replace them by typographic ones (:mod:`omsm_ros.report.page_parts`). A number that the user
has to type is given in the unit of its field instead.
"""

import math
from collections.abc import Mapping, Sequence
from datetime import datetime, timezone

from omsm_ros.units import DAY_S, NANOSECONDS_PER_S

NOTHING = "–"
# The smallest prefix is nano: smaller lengths are written as 0.31 nm.
_PREFIXES = {-9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M"}
# A prefix would be squared with its unit.
_WITHOUT_PREFIX = {"", "s²", "%", "°", "°C", "K", "d", "ppm", "kg", "rpm"}
# Small numbers of these units have a power of ten.
_WITH_POWER = {"", "s²"}
# Limit for values that are far smaller or larger than their uncertainty.
_MOST_DECIMALS = 9
# Zeros after the decimal point: 0.000319 nm, but < 0.0001 nm.
_MOST_ZEROS = 4
# Without a prefix, smaller numbers are written as 3.19 · 10⁻⁵.
_LEAST_PLAIN = 1e-3
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
# Probabilities below this are written as "< 0.0001".
_LEAST_PROBABILITY = 1e-4
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def counts_text(counts: Mapping[str, int]) -> str:
    """Return the counts that are not zero as text: ``3 not ok, 1 duplicate``."""
    words = [f"{n} {name.replace('_', ' ')}" for name, n in counts.items() if n]
    return ", ".join(words) or "none"


def number(value: object) -> float | None:
    """Return ``value`` as float if it is a finite number, else None."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if math.isfinite(value) else None


def quantity(value: object, unit: str, digits: int = 3, signed: bool = False) -> str:
    """Return a number with an SI prefix, rounded to ``digits``: ``83.1 nm``, ``< 0.0001 nm``.

    value: in ``unit``, which has no prefix;  signed: write a plus before positive values
    """
    known = number(value)
    if known is None:
        return NOTHING
    # Rounded first, so that 999.96 becomes 1.00 k, not 1000.
    rounded = _rounded(known, digits)
    exponent = _exponent(rounded, unit)
    tail = f" {_PREFIXES[exponent]}{unit}" if unit else ""
    if rounded and abs(rounded) < 10.0 ** (exponent - _MOST_ZEROS):
        if unit in _WITH_POWER:
            return f"{plain(rounded, digits)}{tail}"
        least = f"{10.0**-_MOST_ZEROS:.{_MOST_ZEROS}f}{tail}"
        return f"< {least}" if rounded > 0 else f"> -{least}"
    sign = "+" if signed and rounded > 0 else ""
    return f"{sign}{_fixed(rounded, digits, exponent)}{tail}"


def column(values: Sequence[object], unit: str, digits: int = 3) -> list[str]:
    """Return the numbers of one column with equal prefix and decimals: ``11.5 nm``, ``< 0.1 nm``.

    The largest has ``digits``. A number that is zero is written as ``none``.
    """
    known = [number(value) for value in values]
    largest = max((_rounded(abs(value), digits) for value in known if value), default=0.0)
    if not largest:
        return [NOTHING if value is None else "none" for value in known]
    exponent = _exponent(largest, unit)
    decimals = max(digits - 1 - math.floor(math.log10(largest)) + exponent, 0)
    tail = f" {_PREFIXES[exponent]}{unit}" if unit else ""
    least = 10.0**-decimals

    def cell(value: float | None) -> str:
        if not value:
            return NOTHING if value is None else "none"
        shown = value / 10.0**exponent
        if abs(shown) < least / 2:
            return f"< {least:.{decimals}f}{tail}"
        return f"{shown:.{decimals}f}{tail}"

    return [cell(value) for value in known]


def measured(value: object, uncertainty: object, unit: str = "", digits: int = 4) -> str:
    """Return a value and its standard uncertainty: ``339.7 µs ± 1.1 µs``.

    The uncertainty has two digits and the value the same decimals (GUM, 7.2.6). Without an
    uncertainty the value has ``digits``; without a unit there is no prefix.
    """
    known, spread = number(value), number(uncertainty)
    if known is None:
        return NOTHING
    if not spread or spread < 0:
        return quantity(known, unit, digits) if unit else plain(known, digits)
    # Rounded first, so that 0.996 becomes 1.0.
    spread = _rounded(spread, 2)
    largest = max(abs(known), spread)
    exponent = _exponent(largest, unit)
    power = ""
    if unit in _WITH_POWER and largest < _LEAST_PLAIN:
        exponent = math.floor(math.log10(_rounded(largest, 2)))
        power = f" · 10{superscript(exponent)}"
    decimals = min(1 - math.floor(math.log10(spread)) + exponent, _MOST_DECIMALS)
    tail = power + (f" {'' if power else _PREFIXES[exponent]}{unit}" if unit else "")
    # Adding 0 removes the sign of -0.
    shown = (round(part / 10.0**exponent, decimals) + 0.0 for part in (known, spread))
    return " ± ".join(f"{part:.{max(decimals, 0)}f}{tail}" for part in shown)


def standard(value: object, uncertainty: object, unit: str = "", digits: int = 4) -> str:
    """Return a value and its standard uncertainty, if known: ``339.7 µs ± 1.1 µs (k = 1)``."""
    text = measured(value, uncertainty, unit, digits)
    return f"{text} ± unknown" if uncertainty is None else f"{text} (k = 1)"


def expanded(value: object, uncertainty: object, unit: str = "", signed: bool = False) -> str:
    """Return a value and its expanded uncertainty: ``10.9 nm ± 4.5 nm (k = 2)``.

    uncertainty: standard;  signed: the value may be negative. A value that may not, and that is
        less than its expanded uncertainty, is written as its bound: ``at most 32.0 nm (k = 2)``
    """
    known, spread = number(value), number(uncertainty)
    if known is None or not spread:
        return measured(value, None, unit, 3)
    if signed or abs(known) >= 2 * spread:
        return f"{measured(value, 2 * spread, unit)} (k = 2)"
    most = max(known, 0.0) + 2 * spread
    bound = quantity(most, unit) if unit else plain(most)
    return f"{bound} (k = 2)" if bound.startswith("<") else f"at most {bound} (k = 2)"


def figure(name: str) -> str:
    """Return the name of a figure of a form: ``PV of 99.5 %``, ``rms of points``."""
    for field, word in _FIGURES.items():
        name = name.replace(field, word)
    return name.replace("_", " ")


def zernike(n: int, m: int) -> str:
    """Return the name of a Zernike term: ``coma in x Z(3, 1)``, ``Z(5, 1)``."""
    term = f"Z({n}, {m})"
    return f"{_ZERNIKE_NAMES[n, m]} {term}" if (n, m) in _ZERNIKE_NAMES else term


def plain(value: object, digits: int = 3) -> str:
    """Return a number without a unit, to ``digits``."""
    known = number(value)
    if known is None:
        return NOTHING
    if known == 0:
        return "0"
    if _LEAST_PLAIN <= abs(known) < 10**digits:
        return f"{known:#.{digits}g}".rstrip(".")
    mantissa, _, power = f"{known:.{digits - 1}e}".partition("e")
    return f"{mantissa} · 10{superscript(int(power))}"


def percent(share: object, digits: int = 2) -> str:
    """Return a share as ``0.12 %``."""
    known = number(share)
    return NOTHING if known is None else quantity(100 * known, "%", digits)


def count(value: object) -> str:
    """Return an integer with its thousands separated: ``290 011``."""
    if isinstance(value, bool) or not isinstance(value, int):
        return NOTHING
    return f"{value:,}".replace(",", " ")


def probability(value: object) -> str:
    """Return a p-value to three digits, or ``< 0.0001``."""
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


def rounded_down(value: float, digits: int = 3) -> float:
    """Return ``value`` rounded to ``digits`` towards zero, for advice that must not be exceeded."""
    nearest = _rounded(value, digits)
    # A value that is round already is not moved by its last bit.
    if abs(nearest) <= abs(value) * (1 + 1e-9) or value == 0:
        return nearest
    return _rounded(nearest - math.copysign(_last_place(value, digits), value), digits)


def rounded_up(value: float, digits: int = 3) -> float:
    """Return ``value`` rounded to ``digits`` away from zero, for advice to reach at least."""
    down = rounded_down(value, digits)
    if abs(value) <= abs(down) * (1 + 1e-9):
        return down
    return _rounded(down + math.copysign(_last_place(value, digits), value), digits)


def _last_place(value: float, digits: int) -> float:
    return 10.0 ** (math.floor(math.log10(abs(value))) - digits + 1)


def _rounded(value: float, digits: int) -> float:
    """Return the number rounded to ``digits``, but not up to infinity."""
    rounded = float(f"{value:.{digits - 1}e}")
    return rounded if math.isfinite(rounded) else value


def _exponent(value: float, unit: str) -> int:
    """Return the power of ten of the prefix."""
    if unit in _WITHOUT_PREFIX or not value:
        # A deviation of zero stands among nanometres.
        return -9 if unit == "m" else 0
    exponent = 3 * (math.floor(math.log10(abs(value))) // 3)
    # No millihertz, which is easily read as megahertz.
    least = 0 if unit == "Hz" else min(_PREFIXES)
    return min(max(exponent, least), max(_PREFIXES))


def _fixed(rounded: float, digits: int, exponent: int) -> str:
    if not rounded:
        return "0"
    decimals = max(digits - 1 - math.floor(math.log10(abs(rounded))) + exponent, 0)
    return f"{rounded / 10.0**exponent:.{decimals}f}"


def days(seconds: object) -> str:
    """Return a time in days, ``0.12 d``."""
    known = number(seconds)
    return NOTHING if known is None else quantity(known / DAY_S, "d", 2)


def date_text(when: datetime) -> str:
    """Return date and time of ``when``, with a time zone: ``2026-01-31 23:59 UTC``."""
    return when.astimezone(timezone.utc).strftime("%Y-%m-%d %H:%M UTC")


def now_text() -> str:
    """Return the present date and time as :func:`date_text` does."""
    return date_text(datetime.now(timezone.utc))


def date_text_of_stamp(stamp_ns: object) -> str:
    """Return a ROS time [ns] as :func:`date_text` does."""
    known = number(stamp_ns)
    if known is None:
        return NOTHING
    return date_text(datetime.fromtimestamp(known / NANOSECONDS_PER_S, tz=timezone.utc))
