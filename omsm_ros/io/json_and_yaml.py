"""Reads JSON and YAML strictly, and checks objects by JSON schema.

JSON follows RFC 8259: no NaN, no infinity, no number beyond a float's range, no repeated name, and
bounded nesting; Python's reader accepts all of these. YAML has plain values only: null, bool, int,
float, str, list and map. Aliases, which unfold to gigabytes, tags, dates, and ``no`` as a truth
value are refused.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

import yaml

from omsm_ros.errors import OmsmError
from omsm_ros.quantities import SIGNAL, Quantity, shown

if TYPE_CHECKING:
    import jsonschema

MAX_DEPTH = 32
# Each reader of JSON can represent integers of 64 bits.
_INTEGERS = range(-(2**63), 2**64)

_T = TypeVar("_T")


def value_of(text: str, error: type[OmsmError], what: str) -> Any:
    """Return the value of a JSON text; raise ``error``, which calls the text ``what``."""
    try:
        value = json.loads(
            text,
            parse_constant=_no_constant,
            parse_float=finite_float,
            parse_int=bounded_integer,
            object_pairs_hook=_unique_names,
        )
        _check_depth(value, MAX_DEPTH)
    except RecursionError as err:
        raise error(f"{what} is nested deeper than {MAX_DEPTH} levels; flatten it") from err
    except ValueError as err:
        raise error(f"{what} is not JSON: {str(err)[:200]}; give JSON (RFC 8259)") from err
    return value


def object_of(text: str, error: type[OmsmError], what: str) -> dict[str, Any]:
    """Return the object that a JSON text holds; raise ``error``, which calls the text ``what``."""
    value = value_of(text, error, what)
    if not isinstance(value, dict):
        raise error(f'{what} is {shown(value)}, expected a JSON object such as {{"name": 1}}')
    return value


def text_of(content: object, indent: int | None = None) -> str:
    """Return ``content`` as JSON; ValueError for NaN and infinity."""
    return json.dumps(content, indent=indent, allow_nan=False)


def unknown_as_null(content: _T) -> _T | None:
    """Return ``content`` with null for each NaN and infinity: an unknown number."""
    if isinstance(content, Mapping):
        return {key: unknown_as_null(value) for key, value in content.items()}  # type: ignore[return-value]
    if isinstance(content, list | tuple):
        return [unknown_as_null(value) for value in content]  # type: ignore[return-value]
    return None if isinstance(content, float) and not math.isfinite(content) else content


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is not a JSON number")


def finite_float(text: str) -> float:
    """Return the number that ``text`` writes; ValueError for one beyond the range of a float."""
    if not math.isfinite(value := float(text)):
        raise ValueError(f"{shown(text)} is beyond the range of a float")
    return value


def bounded_integer(text: str) -> int:
    """Return the integer that ``text`` writes; ValueError for one of more than 64 bits."""
    if len(text) > 20 or (value := int(text)) not in _INTEGERS:
        raise ValueError(f"the integer {shown(text)} has more than 64 bits")
    return value


def _unique_names(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"the name {shown(twice)} is repeated in one object")
    return content


def _check_depth(value: object, left: int) -> None:
    if left < 0:
        raise ValueError(f"it is nested deeper than {MAX_DEPTH} levels")
    if isinstance(value, str):
        value.encode()  # a lone surrogate cannot be written again
    elif isinstance(value, dict | list):
        for part in (*value, *value.values()) if isinstance(value, dict) else value:
            _check_depth(part, left - 1)


MAX_DEPTH_STRICT_YAML = 8
_LINES = "write 'name: value' lines, and quotes around a text with any of [ ] { } , : #"


class _PlainLoader(yaml.SafeLoader):
    """Reads the scalars of JSON; refuses aliases, anchors, tags and repeated names."""

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012 - replaces that of its base
    _depth = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        event: Any = self.peek_event()  # type: ignore[no-untyped-call]
        if isinstance(event, yaml.AliasEvent) or event.anchor is not None:
            self._refuse(event, "aliases and anchors are not accepted; write the value out")
        if getattr(event, "tag", None) not in (None, "!"):
            self._refuse(event, f"the tag {shown(event.tag)} is not accepted; leave it out")
        self._depth += 1
        if self._depth > MAX_DEPTH_STRICT_YAML:
            self._refuse(event, f"nested deeper than {MAX_DEPTH_STRICT_YAML} levels")
        node: yaml.Node | None = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        met: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode) or key.tag != _tag("str"):
                self._refuse(key, f"the name {shown(key.value)} is no text")
            if key.value in met:
                self._refuse(key, f"the name {shown(key.value)} is repeated")
            met.add(key.value)
        return super().construct_mapping(node, deep)

    def _refuse(self, where: yaml.Event | yaml.Node, why: str) -> NoReturn:
        mark: Any = where.start_mark
        raise yaml.constructor.ConstructorError(None, None, why, mark)

    def construct_number(self, node: yaml.ScalarNode) -> float:
        read = bounded_integer if node.tag == _tag("int") else finite_float
        try:
            return read(node.value)
        except ValueError as err:
            self._refuse(node, str(err))


def _tag(kind: str) -> str:
    return f"tag:yaml.org,2002:{kind}"


# The core schema of YAML 1.2 without octal and hexadecimal integers, infinity and NaN.
for _kind, _pattern, _first in (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?[0-9]+", list("-+0123456789")),
    ("float", r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?", list("-+.0123456789")),
):
    _PlainLoader.add_implicit_resolver(_tag(_kind), re.compile(rf"^(?:{_pattern})$"), _first)
_PlainLoader.add_constructor(_tag("int"), _PlainLoader.construct_number)
_PlainLoader.add_constructor(_tag("float"), _PlainLoader.construct_number)


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


def has_aliases(text: str) -> bool:
    """Return whether a YAML text has aliases or anchors; one that is no YAML has none."""
    if "&" not in text and "*" not in text:
        return False
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # much faster, if available
    try:
        return any(getattr(event, "anchor", None) is not None for event in yaml.parse(text, loader))
    except (yaml.YAMLError, ValueError):
        return False


def begins_as_mapping(text: bytes) -> bool:
    """Return whether a YAML text begins with a name and its value; the rest is not read."""
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


# Ranges are in the table of quantities: the record made of an object checks them, or, without a
# record, the schema (:func:`ranged`).

NUMBER: Mapping[str, Any] = {"type": "number"}
TEXT: Mapping[str, Any] = {"type": "string"}
TEXTS: Mapping[str, Any] = {"type": "array", "items": TEXT}


def form(properties: Mapping[str, Any], required: Sequence[str]) -> dict[str, Any]:
    """Return the schema of an object with ``properties`` and no others."""
    return {
        "type": "object",
        "properties": dict(properties),
        "additionalProperties": False,
        "required": list(required),
    }


def each(schema: Mapping[str, Any]) -> dict[str, Any]:
    """Return the schema of an object of any names whose values follow ``schema``."""
    return {"type": "object", "additionalProperties": schema}


def ranged(quantity: Quantity) -> dict[str, Any]:
    """Return the schema of a number within the range of ``quantity``, in its unit."""
    kind = "integer" if quantity.whole else "number"
    return {"type": kind, "minimum": quantity.low, "maximum": quantity.high}


def group(needed: Mapping[str, Any], **others: Any) -> dict[str, Any]:
    """Return the schema of an object, which may have further names."""
    return {"type": "object", "properties": {**needed, **others}, "required": list(needed)}


def rows(needed: Mapping[str, Any]) -> dict[str, Any]:
    """Return the schema of a list of such objects."""
    return {"type": "array", "items": group(needed)}


def or_none(schema: Mapping[str, Any]) -> dict[str, Any]:
    """Return the schema of a value that may also be null."""
    return {**schema, "type": [schema["type"], "null"]}


# An unknown figure is null.
NUMBER_OR_NULL = or_none(ranged(SIGNAL))
FIGURE = group({"value": NUMBER_OR_NULL, "uncertainty": NUMBER_OR_NULL})
"""A figure with its standard uncertainty."""
CONFORMITY: Mapping[str, Any] = {
    "verdict": {"enum": ["holds", "fails", "cannot tell"]},
    "tolerance": ranged(SIGNAL),
}


def check_form(
    content: Mapping[str, Any], schema: Mapping[str, Any], error: type[OmsmError], what: str
) -> None:
    """Raise ``error``, which calls the content ``what``, unless it follows ``schema``."""
    # It takes a tenth of a second to load, and a node that reads no file does not need it.
    import jsonschema

    found = next(jsonschema.Draft202012Validator(schema).iter_errors(content), None)
    if found is not None:
        raise error(f"{what}: {_said_of_schemas(found)}")


_KINDS = {
    "object": "names and values", "array": "a list", "string": "a text", "number": "a number",
    "integer": "a whole number", "boolean": "true or false", "null": "null",
}  # fmt: skip


def _said_of_schemas(found: jsonschema.ValidationError) -> str:
    place = found.json_path.removeprefix("$").removeprefix(".")
    said = f"{place} is {shown(found.instance)}" if place else ""
    wanted = found.validator_value
    match found.validator:
        case "additionalProperties":
            known = sorted(found.schema["properties"])  # type: ignore[index]
            unknown = next(name for name in found.instance if name not in known)  # type: ignore[union-attr]
            # "{reason: still, one minute}" is YAML for a reason and a name without a value.
            none = found.instance[unknown] is None  # type: ignore[index]
            hint = "; quote a text that contains a comma" if none else ""
            return f"{shown(unknown)} is unknown, expected one of {known}{hint}"
        case "required":
            missing = [name for name in wanted if name not in found.instance]  # type: ignore[operator, union-attr]
            return f"{missing[0]} is required and missing; write it there"
        case "type":
            kinds = [wanted] if isinstance(wanted, str) else wanted
            text = "number" in kinds and isinstance(found.instance, str)  # type: ignore[operator]
            hint = "; write digits with a decimal point, without unit and quotes" if text else ""
            return f"{said}, expected {' or '.join(_KINDS[kind] for kind in kinds)}{hint}"  # type: ignore[union-attr]
        case "minimum" | "maximum":
            low, high = (found.schema.get(name) for name in ("minimum", "maximum"))  # type: ignore[union-attr]
            if low is None or high is None:
                return f"{said}, expected at {'most' if low is None else 'least'} {wanted:g}"
            return f"{said}, expected {low:g} to {high:g}"
        case "const":
            return f"{said}, expected {wanted!r}"
        case "enum":
            return f"{said}, expected one of {wanted!r}"
        case "maxItems" | "minItems" | "maxLength" | "minLength":
            limit = "at most" if found.validator.startswith("max") else "at least"
            unit = "values" if found.validator.endswith("Items") else "characters"
            return f"{place} has {len(found.instance)} {unit}, expected {limit} {wanted}"  # type: ignore[arg-type]
    return f"{said}, expected {found.validator} {shown(wanted)}"
