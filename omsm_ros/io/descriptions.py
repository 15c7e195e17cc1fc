"""Reads descriptions of machine, part and twin: geometry, limits, sources, surface and others.

The schema of a description is derived from the fields of the record that is made of it.
"""

from __future__ import annotations

import types
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, asdict, fields, is_dataclass
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
import yaml

from omsm_ros.core.correction.machine_sources import NOTHING_STATED, MachineSources, StatedSource
from omsm_ros.core.correction.source_kinds import FORMER_NAMES, KINDS
from omsm_ros.core.kinematics.kinematics import Geometry, PitchCurve, Surface
from omsm_ros.core.kinematics.limits import MachineLimits
from omsm_ros.core.kinematics.trajectories import MultisinePlan
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.surface.aperture import Aperture, BoundedSurface
from omsm_ros.core.surface.height_grid import GridSurface, as_grid
from omsm_ros.core.surface.nominal import SHAPES
from omsm_ros.core.surface.posed import Pose, PosedSurface
from omsm_ros.errors import ConfigurationError, DataError, FileError, SurfaceError, named_errors
from omsm_ros.io.files import load_object, read_text, save_text
from omsm_ros.io.json_and_yaml import NUMBER, as_number, check_form, form
from omsm_ros.io.tables.text_table import load_columns
from omsm_ros.quantities import PITCH, POSITION, SAMPLE_PERIOD, TIME, shown

if TYPE_CHECKING:  # commands other than those of the twin do not load it
    from omsm_ros.twin.disturbances import Disturbances

MAX_YAML_BYTES = 100_000
# More than the lines or harmonics of any machine; each costs time at each sample.
_MOST_ITEMS = 100

_T = TypeVar("_T")


def load_geometry(path: Path | str | None) -> Geometry:
    """Read ``GEOMETRY.yaml``: place and direction of the probe [m], [1]; zeros without a file."""
    return _load(Geometry, path, "geometry")


def load_limits(path: Path | str | None) -> MachineLimits:
    """Read ``LIMITS.yaml``: limits of servo, probe and axes; the usual ones without a file."""
    return _load(MachineLimits, path, "limits")


def load_disturbances(path: Path | str | None) -> Disturbances:
    """Read ``DISTURBANCES.yaml``, the errors of the twin, none without a file.

    A record that is left out is switched off.
    """
    from omsm_ros.twin.disturbances import Disturbances

    return _load(Disturbances, path, "disturbances")


def _load(kind: type[_T], path: Path | str | None, what: str) -> _T:
    """Read a record of numbers, and of records of them; FileError for another name or value."""
    if path is None:
        return kind()
    content = load_object(path, what, MAX_YAML_BYTES, _schema_of(kind), yaml=True)
    with named_errors(FileError, f"{what} {str(path)!r}", ConfigurationError):
        return _made(kind, content)  # type: ignore[no-any-return]


def _schema_of(kind: Any) -> Mapping[str, Any]:
    """Return the JSON schema of a field's type: record, row of records, number, any or none."""
    kind = _present(kind)
    if is_dataclass(kind):
        hints = get_type_hints(kind)
        return form({f.name: _schema_of(hints[f.name]) for f in fields(kind)}, _required(kind))
    if get_origin(kind) is tuple:
        items = _schema_of(get_args(kind)[0])
        return {"type": "array", "items": items, "maxItems": _MOST_ITEMS}
    return _INTEGER if kind is int else NUMBER


def _required(kind: Any) -> list[str]:
    known = (each for each in fields(kind) if each.init)
    return [f.name for f in known if f.default is MISSING and f.default_factory is MISSING]


def _made(kind: Any, content: Any) -> Any:
    kind = _present(kind)
    if is_dataclass(kind):
        make: Any = kind
        hints = get_type_hints(kind)
        return make(**{name: _made(hints[name], value) for name, value in content.items()})
    if get_origin(kind) is tuple:
        return tuple(_made(get_args(kind)[0], item) for item in content)
    return int(content) if kind is int else content  # a number as it is written, for messages


def load_pitch(path: Path | str) -> PitchCurve:
    """Read ``PITCH.csv``: columns ``z_m,pitch_rad``, as an autocollimator along Z measures it."""
    z, angle = load_columns(path, ("z_m", "pitch_rad"))
    what = f"pitch {str(path)!r}"
    POSITION.checked_all(z, FileError, f"{what}: z_m")
    PITCH.checked_all(angle, FileError, f"{what}: pitch_rad")
    with named_errors(FileError, what, ConfigurationError):
        return PitchCurve(z, angle)


def save_geometry(path: Path | str, geometry: Geometry) -> None:
    """Write ``GEOMETRY.yaml``."""
    save_text(path, yaml.safe_dump(asdict(geometry), sort_keys=False))


def load_motion(path: Path | str) -> tuple[FloatArray, float]:
    """Read a planned motion, columns ``time_s`` and ``z_m`` of a CSV: z [m] and its period [s].

    Raises FileError for a table without these columns, or uneven times.
    """
    time, z = load_columns(path, ("time_s", "z_m"))
    what = f"motion {str(path)!r}"
    TIME.checked_all(time, FileError, f"{what}: time_s")
    POSITION.checked_all(z, FileError, f"{what}: z_m")
    steps = np.diff(time)
    period = SAMPLE_PERIOD.checked(float(np.mean(steps)), FileError, f"{what}: step of time_s")
    if np.ptp(steps) > 0.01 * period:
        raise FileError(
            f"{what}: time_s runs in steps of {steps.min():g} to {steps.max():g} s, "
            "expected even steps; sample the motion evenly"
        )
    return z, period


# A multisine as ``omsm plan multisine`` writes it: the arguments of the plan.
MULTISINE_SCHEMA = "omsm-multisine/1"
_WHOLE = {"type": "integer", "minimum": 1, "maximum": 100_000}
_MULTISINE = {
    "schema": {"const": MULTISINE_SCHEMA},
    "sample_period": {"type": "number", "minimum": 1e-6, "maximum": 10.0},
    **dict.fromkeys(("period", "periods", "realisations", "seed"), _WHOLE),
    "lines": {"type": "array", "items": _WHOLE, "minItems": 2, "maxItems": 10_000},
    "amplitudes": {"type": "array", "items": NUMBER, "minItems": 2, "maxItems": 10_000},
}
_MOST_MULTISINE_SAMPLES = 1_000_000


def load_multisine(path: Path | str) -> MultisinePlan:
    """Read ``multisine.json``; raise FileError if it is malformed or longer than a recording."""
    what = f"multisine {str(path)!r}"
    schema = form(_MULTISINE, tuple(_MULTISINE))
    content = load_object(path, "multisine", 10 * MAX_YAML_BYTES, schema)
    del content["schema"]
    plan = MultisinePlan(**content | {k: tuple(content[k]) for k in ("lines", "amplitudes")})
    rising = bool(np.all(np.diff(plan.lines) > 0)) and plan.lines[-1] < plan.period / 2
    evaluated = min(plan.periods, plan.realisations) > 1
    known = len(plan.lines) == len(plan.amplitudes) and rising and evaluated
    if not known or plan.samples > _MOST_MULTISINE_SAMPLES:
        raise FileError(f"{what} is no plan that can be evaluated; plan it again")
    return plan


# ``SOURCES.yaml`` states the sources of uncertainty of the machine:
#
# schema: omsm-sources/1
# sources:
#   - {source: tilt, value: 5.0e-6, unit: rad, how: declared, reason: dial gauge at the rim}
#   - {source: spindle_axial, per_turn: 2, value: 8.0e-9, unit: m, distribution: arcsine,
#      how: evaluated, reason: ball and capacitive sensor, date: 2026-11-29}

SCHEMA = "omsm-sources/1"
_MOST_SOURCES = 200
_TEXT = {"type": "string"}
_OWN = {"source": _TEXT, "value": NUMBER, "unit": _TEXT, "how": _TEXT, "reason": _TEXT}
_PARAMETERS = {key: NUMBER for kind in KINDS.values() for key in kind.parameters}
# How a source was evaluated; a size that it found is for people.
_EVALUATION = {"found": NUMBER, "uncertainty": NUMBER, "recording": _TEXT, "date": _TEXT,
               "command": _TEXT}  # fmt: skip
_ITEM = form({**_OWN, "distribution": _TEXT, **_PARAMETERS, **_EVALUATION}, tuple(_OWN))
_FORM = form(
    {
        "schema": {"const": SCHEMA},
        "sources": {"type": "array", "items": _ITEM, "maxItems": _MOST_SOURCES},
    },
    ("schema", "sources"),
)


def load_sources(path: Path | str | None) -> MachineSources:
    """Read ``SOURCES.yaml``, nothing without a file; FileError names the source and the error."""
    if path is None:
        return NOTHING_STATED
    content = load_object(path, "sources", MAX_YAML_BYTES, _FORM, yaml=True)
    with named_errors(FileError, f"sources {str(path)!r}", ConfigurationError):
        return MachineSources(tuple(_stated(item) for item in content["sources"]))


def add_sources(path: Path, found: Sequence[Mapping[str, object]]) -> None:
    """Add evaluated sources to ``SOURCES.yaml``, which is made if it does not exist.

    Each replaces the entries of the same source and ``per_turn``; comments before the list remain.
    """
    head, kept = "", []
    if path.exists():
        load_sources(path)
        text = read_text(path, MAX_YAML_BYTES, FileError, "sources")
        head = "".join(takewhile(lambda line: line[0] in "#\n", text.splitlines(keepends=True)))
        kept = load_object(path, "sources", MAX_YAML_BYTES, yaml=True)["sources"]
    new = {(item["source"], item.get("per_turn")) for item in found}
    kept = [item for item in kept if (item["source"], item.get("per_turn")) not in new]
    lines = [
        yaml.safe_dump(dict(item), default_flow_style=True, sort_keys=False, allow_unicode=True,
                       width=10_000).strip()
        for item in (*kept, *found)
    ]  # fmt: skip
    listed = "".join(f"  - {line}\n" for line in lines)
    save_text(path, f"{head}schema: {SCHEMA}\nsources:\n{listed}")


def _stated(item: Mapping[str, Any]) -> StatedSource:
    own = {name: item[name] for name in (*_OWN, "distribution") if name in item}
    unit = own.pop("unit")
    own["source"] = FORMER_NAMES.get(own["source"], own["source"])
    stated = StatedSource(
        **own,
        parameters={k: v for k, v in item.items() if k in _PARAMETERS},
        evaluation=" ".join(item[k] for k in ("recording", "date", "command") if k in item),
    )
    expected = KINDS[stated.source].quantity.unit or "1" if stated.source in KINDS else "m"
    if unit != expected:
        raise ConfigurationError(f"{stated.source} is stated in {unit!r}, expected {expected!r}")
    return stated


# ``SURFACE.yaml`` has ``shape`` and the parameters of that shape under the names of its fields, in
# metres and radians, and a ``pose`` if the part is not at the origin of the machine. The schema is
# derived from the fields of the shape's record.

# Each shape is evaluated at each point; in a turned frame by Newton's method, some five times, and
# in two nested frames twenty-five times.
MOST_SHAPES, MOST_FRAMES = 50, 3
_GRID = "grid"
_INTEGER: Mapping[str, Any] = {"type": "integer"}
# Value of a parameter that is fitted, where none is stated [m], [1]; the estimate does not keep it.
_START = 0.1
_LIST: Mapping[str, Any] = {"type": "array", "maxItems": 1000}


def load_surface(path: Path | str, fitted: Sequence[str] = ()) -> Surface:
    """Read ``SURFACE.yaml``, or take the name of a shape; SurfaceError if it is malformed.

    fitted: parameters that are estimated from points, and need not be stated
    """
    if str(path) in SHAPES:
        return surface_of(_with_starts({"shape": str(path)}, fitted), f"surface {str(path)!r}")
    what = f"surface {str(path)!r}"
    description = load_object(path, "surface", MAX_YAML_BYTES, error=SurfaceError, yaml=True)
    shapes, frames = _extent(description)
    if shapes > MOST_SHAPES or frames > MOST_FRAMES:
        raise SurfaceError(
            f"{what} has {shapes} shapes and {frames} turned frames within one another, expected "
            f"at most {MOST_SHAPES} and {MOST_FRAMES}; describe it by a grid"
        )
    return surface_of(_with_starts(description, fitted), what, Path(path).parent)


def _with_starts(description: Mapping[str, Any], fitted: Sequence[str]) -> Mapping[str, Any]:
    """Return the description with values for the parameters that are fitted and not stated."""
    kind = SHAPES.get(str(description.get("shape")))
    own: list[str] = [each.name for each in fields(kind)] if is_dataclass(kind) else []
    starts = {name: _START for name in fitted if name in own and name not in description}
    return {**description, **starts}


def _extent(content: Any) -> tuple[int, int]:
    named = content if isinstance(content, dict) else {}
    inside = named.values() if named else content if isinstance(content, list) else ()
    known = [_extent(part) for part in inside]
    shapes = sum(count for count, _ in known) + ("shape" in named)
    turned = ("pose" in named) + ("parent" in named)
    return shapes, turned + max((depth for _, depth in known), default=0)


def surface_of(description: Mapping[str, Any], what: str, folder: Path | None = None) -> Surface:
    """Return the surface of a description, which error texts call ``what``.

    folder: of the files that it names; None = it may name no files
    """
    values = dict(description)
    shape, pose = values.pop("shape", None), values.pop("pose", None)
    aperture = values.pop("aperture", None)
    named = {"shape": shape} if shape is not None else {}
    known = sorted([*SHAPES, *([_GRID] if folder is not None else [])])
    check_form(named, form({"shape": {"enum": known}}, ("shape",)), SurfaceError, what)
    if shape == _GRID:
        surface = _grid(values, f"{what}: {shape}", folder or Path())
    else:
        surface = _record(SHAPES[shape], values, f"{what}: {shape}", folder)
    if pose is not None:
        surface = PosedSurface(surface, _value(Pose, pose, f"{what}: pose", folder))
    if aperture is None:
        return surface
    return BoundedSurface(surface, Aperture.parse(str(aperture)))


def _grid(values: Mapping[str, Any], what: str, folder: Path) -> Surface:
    # Imported here, because readers of maps take longer to load than a scan takes to correct.
    from omsm_ros.io.maps.read_map import read_points
    from omsm_ros.units import units_of

    schema = form({"file": {"type": "string"}, "unit": {"type": "string"}}, ("file",))
    check_form(values, schema, SurfaceError, what)
    with named_errors(SurfaceError, what):
        units = units_of(values["unit"]) if "unit" in values else None
        grid = as_grid(read_points(folder / values["file"], units))
        if grid is None:
            raise DataError(
                "its points are no evenly spaced rows and columns; make such a map of them with "
                "'omsm export --spacing'"
            )
        return GridSurface(grid)


def _record(kind: Any, values: Mapping[str, Any], what: str, folder: Path | None) -> Any:
    known = [each for each in fields(kind) if each.init]
    hints = get_type_hints(kind)
    schema = form({each.name: _schema(hints[each.name]) for each in known}, _required(kind))
    check_form(values, schema, SurfaceError, what)
    made = {n: _value(hints[n], v, f"{what}: {n}", folder) for n, v in values.items()}
    with named_errors(SurfaceError, what):
        return kind(**made)


def _schema(hint: Any) -> Mapping[str, Any]:
    if _choices(hint):
        return {"enum": list(_choices(hint))}
    if get_origin(hint) is tuple:
        return _LIST
    return {int: _INTEGER, float: NUMBER}.get(_present(hint), {})


def _value(hint: Any, value: Any, what: str, folder: Path | None) -> Any:
    if value is None and _present(hint) is not hint:
        return None
    kind = _present(hint)
    if get_origin(kind) is tuple:
        each = get_args(kind)[0]
        return tuple(_value(each, v, f"{what}[{k}]", folder) for k, v in enumerate(value))
    if kind is float:
        if not isinstance(value, int | float) or isinstance(value, bool):
            raise SurfaceError(f"{what} is {shown(value)}, expected a number{as_number(value)}")
        return float(value)
    if kind is Surface or is_dataclass(kind):
        if not isinstance(value, dict):
            raise SurfaceError(f"{what} is {shown(value)}, expected names and values")
        if kind is Surface:
            if "aperture" in value:
                raise SurfaceError("surface.nested_aperture")
            return surface_of(value, what, folder)
        return _record(kind, value, what, folder)
    return value


def _present(hint: Any) -> Any:
    if get_origin(hint) in (types.UnionType, Union):
        return next(kind for kind in get_args(hint) if kind is not types.NoneType)
    return hint


def _choices(hint: Any) -> tuple[Any, ...]:
    return get_args(hint) if get_origin(hint) is Literal else ()
