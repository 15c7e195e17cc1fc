"""A page from its template: text from outside escaped, numbers set as in print."""

from __future__ import annotations

import re
from base64 import b64encode
from collections.abc import Iterable

import jinja2

from omsm_ros.errors import ConfigurationError

_SPACE = "\N{NARROW NO-BREAK SPACE}"
# A sign, not a hyphen: not behind a letter or a digit, so neither 1e-9 nor a date.
_MINUS = re.compile(r"(?<![\w.\-])-(?=\d)")
_UNITS = r"(?:[nµmkM]?(?:m|s|Hz|rad|g|N/m|N·s/m)(?:/s²?)?|ppm|%|°|rpm|·)"
# "12.5 nm", "254 000"
_JOINED = re.compile(rf"(?<=\d) (?=(?:{_UNITS}|\d{{3}})(?![\w/]))")


def fill(template: str, **content: object) -> str:
    """Return the template of that name with ``content`` in it; raise for a name left open."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("omsm_ros.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=lambda value: typeset(value) if type(value) is str else value,
    )
    return environment.get_template(template).render(**content)


def check_places(figures: Iterable[str], places: Iterable[str]) -> None:
    """Raise ConfigurationError for a figure whose name is none of ``places`` on a page."""
    unknown = sorted(set(figures) - set(places))
    if unknown:
        raise ConfigurationError(
            f"figures {unknown!r} have no place on the page, expected one of {[*places]}"
        )


def picture(png: bytes) -> str:
    """Return a PNG file as text for the address of an image."""
    return b64encode(png).decode()


def typeset(text: str) -> str:
    """Return ``text`` with narrow spaces that do not break before units, and true minus signs."""
    return _JOINED.sub(_SPACE, _MINUS.sub("−", text))
