"""``GEOMETRY.yaml``, ``LIMITS.yaml``, ``PITCH.csv``: the probe's place, the machine's limits."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import MISSING, asdict, fields
from pathlib import Path
from typing import Any, TypeVar

import yaml

from omsm_ros.core.machine.kinematics import Geometry
from omsm_ros.core.machine.limits import MachineLimits
from omsm_ros.core.machine.pitch_curve import PitchCurve
from omsm_ros.errors import ConfigurationError, FileError
from omsm_ros.quantities import PITCH, POSITION
from omsm_ros.storage import strict_yaml
from omsm_ros.storage.files import read_text, save_text
from omsm_ros.storage.schemas import NUMBER, check_form, form
from omsm_ros.storage.table_file import load_columns

MAX_YAML_BYTES = 100_000

_T = TypeVar("_T")


def load_geometry(path: Path | str) -> Geometry:
    """Read ``GEOMETRY.yaml``: where the probe sits and looks, in metres and slopes."""
    values = _read_mapping(path, "geometry")
    return _made(Geometry, values, f"geometry {str(path)!r}")


def load_limits(path: Path | str) -> MachineLimits:
    """Read ``LIMITS.yaml``: what servo, probe, spindle and axes can do, units in the names."""
    values = _read_mapping(path, "limits")
    return _made(MachineLimits, values, f"limits {str(path)!r}")


def load_pitch(path: Path | str) -> PitchCurve:
    """Read ``PITCH.csv``: columns ``z_m,pitch_rad``, as an autocollimator along Z measures it."""
    z, angle = load_columns(path, ("z_m", "pitch_rad"))
    what = f"pitch {str(path)!r}"
    POSITION.checked_all(z, FileError, f"{what}: z_m")
    PITCH.checked_all(angle, FileError, f"{what}: pitch_rad")
    try:
        return PitchCurve(z, angle)
    except ConfigurationError as err:
        raise FileError(f"{what}: {err}") from err


def save_geometry(path: Path | str, geometry: Geometry) -> None:
    """Write ``GEOMETRY.yaml``."""
    save_text(path, yaml.safe_dump(asdict(geometry), sort_keys=False))


def _made(kind: Callable[..., _T], values: Mapping[str, Any], what: str) -> _T:
    """Return a record of numbers made of ``values``, which must have its fields' names."""
    parameters = fields(kind)  # type: ignore[arg-type]
    required = [field.name for field in parameters if field.default is MISSING]
    check_form(values, form({p.name: NUMBER for p in parameters}, required), FileError, what)
    try:
        return kind(**values)
    except ConfigurationError as err:
        raise FileError(f"{what}: {err}") from err


def _read_mapping(path: Path | str, what: str) -> dict[str, Any]:
    text = read_text(path, MAX_YAML_BYTES, FileError, what)
    return strict_yaml.mapping_of(text, FileError, f"{what} {str(path)!r}")
