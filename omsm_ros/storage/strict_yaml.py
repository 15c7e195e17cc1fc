"""YAML of plain values only: null, bool, int, float, str, list and map.

YAML has much that no description of a surface needs and that a reader should not meet: aliases
that unfold to gigabytes, tags that name Python objects, dates, and ``no`` as a truth value.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any, NoReturn, TypeVar

import yaml

from omsm_ros.errors import OmsmError
from omsm_ros.quantities import shown
from omsm_ros.storage.strict_json import bounded_integer, finite_float

MAX_DEPTH = 8
_LINES = "write 'name: value' lines, and quotes around a text with any of [ ] { } , : #"
_Number = TypeVar("_Number")


class _PlainLoader(yaml.SafeLoader):
    """Knows the scalars of JSON; refuses aliases, anchors, tags and names that stand twice."""

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012 - replaces that of its base
    _depth = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        event = self.peek_event()
        if isinstance(event, yaml.AliasEvent) or event.anchor is not None:
            self._refuse(event, "aliases and anchors are not accepted; write the value out")
        if getattr(event, "tag", None) not in (None, "!"):
            self._refuse(event, f"the tag {shown(event.tag)} is not accepted; leave it out")
        self._depth += 1
        if self._depth > MAX_DEPTH:
            self._refuse(event, f"nested deeper than {MAX_DEPTH} levels")
        node: yaml.Node | None = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        met: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode) or key.tag != _tag("str"):
                self._refuse(key, f"the name {shown(key.value)} is no text")
            if key.value in met:
                self._refuse(key, f"the name {shown(key.value)} stands twice")
            met.add(key.value)
        return super().construct_mapping(node, deep)

    def _refuse(self, where: yaml.Event | yaml.Node, why: str) -> NoReturn:
        raise yaml.constructor.ConstructorError(None, None, why, where.start_mark)

    def construct_bounded_int(self, node: yaml.ScalarNode) -> int:
        return self._number(node, bounded_integer)

    def construct_finite_float(self, node: yaml.ScalarNode) -> float:
        return self._number(node, finite_float)

    def _number(self, node: yaml.ScalarNode, read: Callable[[str], _Number]) -> _Number:
        try:
            return read(node.value)
        except ValueError as err:
            self._refuse(node, str(err))


def _tag(kind: str) -> str:
    return f"tag:yaml.org,2002:{kind}"


# The core schema of YAML 1.2, less octal and hexadecimal integers, infinity and not-a-number.
for _kind, _pattern, _first in (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?[0-9]+", list("-+0123456789")),
    ("float", r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?", list("-+.0123456789")),
):
    _PlainLoader.add_implicit_resolver(_tag(_kind), re.compile(rf"^(?:{_pattern})$"), _first)
_PlainLoader.add_constructor(_tag("int"), _PlainLoader.construct_bounded_int)
_PlainLoader.add_constructor(_tag("float"), _PlainLoader.construct_finite_float)


def mapping_of(text: str, error: type[OmsmError], what: str) -> dict[str, Any]:
    """Return the names and values of a YAML text; raise ``error``, which calls the text ``what``.

    The values are of the types None, bool, int, float, str, list and dict.
    """
    try:
        loader = _PlainLoader(text)
        try:
            content = loader.get_single_data()
        finally:
            loader.dispose()
    except (yaml.YAMLError, RecursionError, ValueError) as err:
        raise error(f"{what} is not plain YAML: {_said(err)}; {_LINES}") from err
    if not isinstance(content, dict):
        raise error(f"{what} holds {shown(content)}, expected 'name: value' lines")
    return content


def begins_as_mapping(text: bytes) -> bool:
    """Whether a YAML text of any kind begins with a name and its value; the rest is not read."""
    begin = yaml.StreamStartEvent, yaml.DocumentStartEvent
    try:
        events = yaml.parse(text, yaml.SafeLoader)
        first = next((event for event in events if not isinstance(event, begin)), None)
    except yaml.YAMLError:
        return False
    return isinstance(first, yaml.MappingStartEvent)


def _said(err: Exception) -> str:
    mark = getattr(err, "problem_mark", None)
    place = f"line {mark.line + 1}: " if mark is not None else ""
    return place + " ".join(str(getattr(err, "problem", None) or err).split())[:200]
