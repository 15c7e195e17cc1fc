"""Sentences for the codes of errors and findings.

The core states what it found as a code and values. A sentence for people is made here, from the
template of that code, in the words of its audience: an option of the command line, a parameter of
a node, or an argument of a Python function.

A template is a string in the syntax of :meth:`str.format`. After the colon stands either a format
of Python or how :mod:`omsm_ros.readable` writes the number:

| field | written as |
|---|---|
| ``{noise:m}``, ``{lag:s}``, ``{rate:Hz/4}`` | quantity with SI prefix, to 3 or 4 digits |
| ``{value:{unit}}`` | the same in the unit that another value names |
| ``{share:%}`` | percent |
| ``{p:chance}``, ``{p:probability}`` | ``p = 0.02``, ``0.02`` |
| ``{n:count}`` | number of things, ``290 011`` |
| ``{lost:counts}`` | mapping of counts, ``3 not ok, 1 duplicate`` |
| ``{factor:plain/2}`` | number without unit, to 2 digits |
| ``{names:list}`` | items separated by commas |
| ``{names:and}``, ``{names:or}`` | items joined by "and", "or" |
| ``{name:figure}``, ``{term:zernike}`` | figure of form by its field, Zernike term ``(n, m)`` |
| ``{source:words}`` | name with spaces instead of underscores |
| ``{opt.dwell}`` | ``--dwell``, ``parameter 'dwell'`` or ``'dwell'``, for the audience |

To add a message, add its code and template to the catalogue of its room in this package.
"""

import importlib
import pkgutil
import string
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

from omsm_ros import readable

COMMAND, NODE, PYTHON = "command", "node", "python"
_audience = PYTHON

_UNITS = {"m", "s", "Hz", "rad", "m/s", "m/s²", "m/s³", "ppm", "K", "°C", "rpm", "kg", "samples/s"}


@contextmanager
def written_for(audience: str) -> Iterator[None]:
    """Write sentences for ``audience`` (COMMAND, NODE or PYTHON) in the whole process meanwhile."""
    global _audience
    before, _audience = _audience, audience
    try:
        yield
    finally:
        _audience = before


def sentence(code: str, values: Mapping[str, Any]) -> str:
    """Return the sentence for ``code`` with ``values``; a code without a template is a text."""
    template = templates().get(code)
    if template is None:
        return code
    return text_from(template, {**values, "opt": _Options()})


def text_from(template: str, values: object) -> str:
    """Return a template filled with the entries of a mapping, or the attributes of a record."""
    return str(_Formatter().vformat(template, (), values))  # type: ignore[arg-type]


def rows_from(values: object, rows: Mapping[str, str]) -> list[tuple[str, str]]:
    """Return the rows of a table, name → template, with their templates filled."""
    return [(name, text_from(template, values)) for name, template in rows.items()]


@lru_cache(maxsize=1)
def templates() -> Mapping[str, str]:
    """Return the templates of all rooms by code.

    Raises ValueError if two rooms use one code.
    """
    found: dict[str, str] = {}
    for room in pkgutil.iter_modules(__path__):
        written = importlib.import_module(f"{__name__}.{room.name}").TEMPLATES
        mapping = catalogue(written) if isinstance(written, str) else written
        if twice := found.keys() & mapping.keys():
            raise ValueError(f"messages: codes {sorted(twice)} stand in two rooms")
        found |= mapping
    return found


def catalogue(text: str) -> dict[str, str]:
    """Return the templates by code of lines ``code: template``.

    An indented line continues the template before it; lines that begin with # are comments.
    """
    found: dict[str, str] = {}
    code = ""
    for line in text.splitlines():
        if line.startswith(" "):
            found[code] += f" {line.strip()}"
        elif line and not line.startswith("#"):
            code, _, found[code] = line.partition(": ")
    return found


class _Options:
    """Write the name of an option for the audience: ``opt.dwell`` → ``--dwell``."""

    def __getattr__(self, name: str) -> str:
        if _audience == COMMAND:
            return "--" + name.replace("_", "-")
        return f"parameter {name!r}" if _audience == NODE else repr(name)


_WITH_DIGITS: dict[str, Callable[..., str]] = {"%": readable.percent, "plain": readable.plain}
_WRITERS: dict[str, Callable[[Any], str]] = {
    "chance": readable.p_value_text,
    "probability": readable.probability,
    "count": readable.count,
    "counts": readable.counts_text,
    "list": lambda items: ", ".join(map(str, items)) or "none",
    "and": lambda items: " and ".join(map(str, items)),
    "or": lambda items: " or ".join(map(str, items)),
    "words": lambda name: str(name).replace("_", " "),
    "figure": readable.figure,
    "zernike": lambda term: readable.zernike(*term),
}


class _Formatter(string.Formatter):
    """Format numbers as :mod:`omsm_ros.readable` writes them where the format names a unit."""

    def get_value(self, key: int | str, args: Sequence[Any], kwargs: Any) -> Any:
        return kwargs[key] if isinstance(kwargs, Mapping) else getattr(kwargs, str(key))

    def format_field(self, value: Any, format_spec: str) -> str:
        kind, _, digits = (
            format_spec.rpartition("/") if "/" in format_spec else (format_spec, "", "")
        )
        if format_spec in _UNITS:
            kind, digits = format_spec, ""
        more = (int(digits),) if digits else ()
        if kind in _UNITS:
            return readable.quantity(value, kind, *more)
        if kind in _WITH_DIGITS:
            return _WITH_DIGITS[kind](value, *more)
        if kind in _WRITERS:
            return _WRITERS[kind](value)
        return str(super().format_field(value, format_spec))
