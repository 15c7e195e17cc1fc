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
from omsm_ros.io.json_and_yaml import NUMBER, check_form, form
from omsm_ros.io.tables.text_table import load_columns
from omsm_ros.quantities import PITCH, POSITION, SAMPLE_PERIOD, TIME

if TYPE_CHECKING:  # commands other than those of the twin do not load it
    from omsm_ros.twin.disturbances import Disturbances

MAX_YAML_BYTES = 100_000
# More than the lines or harmonics of any machine; each costs time at each sample.
_MOST_ITEMS = 100
_NAMED: Mapping[str, Any] = {"type": "object"}

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
    content = load_object(path, what, MAX_YAML_BYTES, _schema_of(kind, _MOST_ITEMS), yaml=True)
    return _made(kind, content, f"{what} {str(path)!r}", FileError)  # type: ignore[no-any-return]


def _schema_of(hint: Any, most: int) -> Mapping[str, Any]:
    """Return the JSON schema of a field's type; ``most``: items of a list."""
    kind = _present(hint)
    if is_dataclass(kind):
        own, hints = [each for each in fields(kind) if each.init], get_type_hints(kind)
        needed = [f.name for f in own if f.default is MISSING and f.default_factory is MISSING]
        return form({each.name: _schema_of(hints[each.name], most) for each in own}, needed)
    if get_origin(kind) is tuple:
        return {"type": "array", "items": _schema_of(get_args(kind)[0], most), "maxItems": most}
    if get_origin(kind) is Literal:
        return {"enum": list(get_args(kind))}
    return {float: NUMBER, int: {"type": "integer"}}.get(kind, _NAMED)


def _made(
    hint: Any, content: Any, what: str, error: type[FileError], folder: Path | None = None
) -> Any:
    """Return the record, list or number of ``content``, which follows the schema of its type."""
    kind = _present(hint)
    if kind is Surface:
        if "aperture" in content:
            raise SurfaceError("surface.nested_aperture")
        return surface_of(content, what, folder)
    if is_dataclass(kind):
        make: Any = kind
        hints = get_type_hints(kind)
        values = {n: _made(hints[n], v, f"{what}: {n}", error, folder) for n, v in content.items()}
        with named_errors(error, what):
            return make(**values)
    if get_origin(kind) is tuple:
        each = get_args(kind)[0]
        return tuple(_made(each, v, f"{what}[{k}]", error, folder) for k, v in enumerate(content))
    return kind(content) if kind in (int, float) else content


def _present(hint: Any) -> Any:
    if get_origin(hint) in (types.UnionType, Union):
        return next(kind for kind in get_args(hint) if kind is not types.NoneType)
    return hint


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
MOST_SHAPES, MOST_FRAMES, _MOST_TERMS = 50, 3, 1000
_GRID = "grid"
# Value of a parameter that is fitted, where none is stated [m], [1]; the estimate does not keep it.
_START = 0.1


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
    common = {n: v for n in ("shape", "pose", "aperture") if (v := values.pop(n, None)) is not None}
    known = sorted([*SHAPES, *([_GRID] if folder is not None else [])])
    schema = {"shape": {"enum": known}, "pose": _schema_of(Pose, 0), "aperture": {}}
    check_form(common, form(schema, ("shape",)), SurfaceError, what)
    shape = common["shape"]
    named = f"{what}: {shape}"
    if shape == _GRID:
        surface = _grid(values, named, folder or Path())
    else:
        check_form(values, _schema_of(SHAPES[shape], _MOST_TERMS), SurfaceError, named)
        surface = _made(SHAPES[shape], values, named, SurfaceError, folder)
    if "pose" in common:
        pose = _made(Pose, common["pose"], f"{what}: pose", SurfaceError)
        surface = PosedSurface(surface, pose)
    if "aperture" not in common:
        return surface
    return BoundedSurface(surface, Aperture.parse(str(common["aperture"])))


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
