"""The form of a foreign object: its names and types, by JSON schema.

Ranges are in the one table of quantities: the record that is made of the object holds each against
it, or, where none is made, the schema itself does (:func:`ranged`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from omsm_ros.errors import OmsmError
from omsm_ros.quantities import SIGNAL, Quantity, shown

if TYPE_CHECKING:
    import jsonschema

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
    """Return the schema of an object; it may hold more, which nobody reads."""
    return {"type": "object", "properties": {**needed, **others}, "required": list(needed)}


def rows(needed: Mapping[str, Any]) -> dict[str, Any]:
    """Return the schema of a list of such objects."""
    return {"type": "array", "items": group(needed)}


def or_none(schema: Mapping[str, Any]) -> dict[str, Any]:
    """Return the schema of what may also be null."""
    return {**schema, "type": [schema["type"], "null"]}


# What nobody could know is written as null.
KNOWN_OR_NOT = or_none(ranged(SIGNAL))
FIGURE = group({"value": KNOWN_OR_NOT, "uncertainty": KNOWN_OR_NOT})
"""A figure with its standard uncertainty."""
CONFORMITY: Mapping[str, Any] = {
    "verdict": {"enum": ["holds", "fails", "cannot tell"]},
    "tolerance": ranged(SIGNAL),
}


def check_form(
    content: Mapping[str, Any], schema: Mapping[str, Any], error: type[OmsmError], what: str
) -> None:
    """Raise ``error``, which calls the content ``what``, unless it follows ``schema``."""
    # A tenth of a second to load, which a node that reads no file has no use for.
    import jsonschema

    found = next(jsonschema.Draft202012Validator(schema).iter_errors(content), None)
    if found is not None:
        raise error(f"{what}: {_said(found)}")


_KINDS = {
    "object": "names and values", "array": "a list", "string": "a text", "number": "a number",
    "integer": "a whole number", "boolean": "true or false", "null": "null",
}  # fmt: skip


def as_number(value: object) -> str:
    """Return how to write a number in the place of ``value``, if that is a text; else nothing."""
    text = isinstance(value, str)
    return "; write digits with a decimal point, without unit and quotes" if text else ""


def _said(found: jsonschema.ValidationError) -> str:
    place = found.json_path.removeprefix("$").removeprefix(".")
    said = f"{place} is {shown(found.instance)}" if place else ""
    wanted = found.validator_value
    match found.validator:
        case "additionalProperties":
            known = sorted(found.schema["properties"])  # type: ignore[index, call-overload]
            unknown = next(name for name in found.instance if name not in known)  # type: ignore[union-attr]
            return f"{shown(unknown)} is unknown, expected one of {known}"
        case "required":
            missing = [name for name in wanted if name not in found.instance]  # type: ignore[operator, union-attr]
            return f"{missing[0]} is required and missing; write it there"
        case "type":
            kinds = [wanted] if isinstance(wanted, str) else wanted
            hint = as_number(found.instance) if "number" in kinds else ""  # type: ignore[operator]
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
