"""The tables and numbers of a page as a reader sees them, taken from its HTML alone."""

from __future__ import annotations

import re
from html.parser import HTMLParser

_PREFIXES = {"n": 1e-9, "µ": 1e-6, "m": 1e-3, "k": 1e3, "M": 1e6}
_UNITS = ("m", "s", "Hz", "rad", "rpm", "%", "ppm", "d", "K", "°C", "m/s", "g", "rad/s")
_POWERS = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
_NUMBER = re.compile(r"([+-]?[\d ]*\.?\d+)(?: · 10([⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+))?(?: (\S+))?")


class PageTables(HTMLParser):
    """``tables``: title, columns and rows of each;  ``headlines``: value and detail by name."""

    def __init__(self, html):
        super().__init__()
        self.tables, self.headlines, self.items = [], {}, []
        self._title, self._text, self._row, self._named = "", None, None, ""
        self.feed(html)
        self.close()

    def table(self, title):
        """The rows of the only table of that title, by their first cell."""
        (found,) = (t for t in self.tables if t["title"] == title)
        assert len({len(row) for row in found["rows"]}) == 1, title
        if found["columns"]:
            assert len(found["columns"]) == len(found["rows"][0]), title
        return {row[0]: row[1:] for row in found["rows"]}

    def handle_starttag(self, tag, attrs):
        if tag == "table":
            self.tables.append({"title": self._title, "columns": [], "rows": []})
            self._title = ""
        if tag == "tr":
            self._row = []
        if tag in ("td", "th", "h2", "h3", "dt", "dd", "li"):
            self._text = ""

    def handle_data(self, data):
        if self._text is not None:
            self._text += data

    def handle_endtag(self, tag):
        text, kept = " ".join((self._text or "").replace("\u202f", " ").split()), True
        if tag in ("td", "th"):
            self._row.append(text)
        elif tag == "tr":
            place = self.tables[-1]
            if any(self._row) and not place["rows"] and not place["columns"] and not self._row[0]:
                place["columns"] = self._row
            else:
                place["rows"].append(self._row)
        elif tag in ("h2", "h3"):
            self._title = text
        elif tag == "dt":
            self._named = text
            self.headlines[text] = []
        elif tag == "dd" and self._named:
            self.headlines[self._named].append(text)
        elif tag == "li":
            self.items.append(text)
        else:
            kept = False
        if kept:
            self._text = None


def value_of(text):
    """The number that a cell says, in SI; None for a dash."""
    if text in ("–", "none"):
        return None if text == "–" else 0.0
    found = _NUMBER.fullmatch(text.replace("−", "-"))
    assert found, text
    number, power, unit = found.groups()
    value = float(number.replace(" ", "")) * 10.0 ** int((power or "0").translate(_POWERS))
    if unit is None:
        return value
    if unit in _UNITS:
        return value * {"%": 0.01}.get(unit, 1.0)
    assert unit[1:] in _UNITS, text
    return value * _PREFIXES[unit[0]]


def says(text, value, digits=3, largest=0.0):
    """Return whether a cell contains ``value``, with the ``digits`` of itself or of ``largest``."""
    if text.startswith("< "):
        return 0 < value < value_of(text[2:])
    reported = value_of(text)
    if reported is None or value is None:
        return reported is value
    # Allow half a unit in the last place, and rounding of binary fractions.
    return (
        abs(reported - value) <= 0.5001 * 10.0 ** (1 - digits) * max(abs(value), largest) + 1e-300
    )
