"""``SURFACE.yaml`` and ``GEOMETRY.yaml``: what is measured, and where the probe sits."""

from __future__ import annotations

from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import yaml

from omsm_ros.core.machine.kinematics import Geometry
from omsm_ros.core.machine.surface_height import Surface
from omsm_ros.core.surface.nominal import surface_from_description
from omsm_ros.errors import ConfigurationError, FileError, SurfaceError
from omsm_ros.storage.files import save_text


def read_text(path: Path, limit: int, error: type[FileError], what: str) -> str:
    try:
        size = path.stat().st_size
        if size > limit:
            raise error(f"{what} {str(path)!r} has {size} bytes, at most {limit} are accepted")
        return path.read_text(encoding="utf-8")
    except FileNotFoundError as err:
        raise error(f"no {what} at {str(path)!r}; check the path") from err
    except (OSError, UnicodeDecodeError) as err:
        raise error(f"{what} {str(path)!r} cannot be read as text: {err}") from err


MAX_YAML_BYTES = 100_000


# ----------------------------------------------------------- surface, geometry, summary


def load_surface(path: Path | str) -> Surface:
    """Read ``SURFACE.yaml``: ``shape`` and its parameters in metres."""
    description = _read_mapping(path, "surface", SurfaceError)
    try:
        return surface_from_description(description)
    except SurfaceError as err:
        raise SurfaceError(f"{str(path)!r}: {err}") from err


def load_geometry(path: Path | str) -> Geometry:
    """Read ``GEOMETRY.yaml``: where the probe sits and looks, in metres and slopes."""
    values = _read_mapping(path, "geometry", FileError)
    names = [field.name for field in fields(Geometry)]
    for name, value in values.items():
        if name not in names:
            raise FileError(f"{str(path)!r}: {name!r} is unknown, expected one of {names}")
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise FileError(f"{str(path)!r}: {name} is {value!r}, expected a number")
    try:
        return Geometry(**values)
    except ConfigurationError as err:
        raise FileError(f"{str(path)!r}: {err}") from err


def save_geometry(path: Path | str, geometry: Geometry) -> None:
    """Write ``GEOMETRY.yaml``."""
    save_text(path, yaml.safe_dump(asdict(geometry), sort_keys=False))


def _read_mapping(path: Path | str, what: str, error: type[FileError]) -> dict[str, Any]:
    path = Path(path)
    text = read_text(path, MAX_YAML_BYTES, error, what)
    try:
        content = yaml.safe_load(text)
    except (yaml.YAMLError, RecursionError) as err:
        raise error(f"{str(path)!r} is not YAML: {err}".replace("\n", " ")) from err
    if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
        raise error(f"{str(path)!r} holds {content!r:.80}, expected names and values of a {what}")
    return content
