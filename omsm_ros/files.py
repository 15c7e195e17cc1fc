"""Calibration, cloud, surface and summary files; a file appears only when it is whole."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, fields
from pathlib import Path
from types import TracebackType
from typing import IO, Any

import jsonschema
import numpy as np
import yaml
from numpy.typing import NDArray

from omsm_ros.core.calibration import SCHEMA, Calibration, content_id
from omsm_ros.core.cloud import CLOUD_FIELDS, pack_points
from omsm_ros.core.kinematics import Geometry
from omsm_ros.core.records import FloatArray, SurfacePoints
from omsm_ros.core.surface import Surface, surface_from_description
from omsm_ros.errors import CalibrationError, ConfigurationError, FileError, SurfaceError

CLOUD, SUMMARY, REPORT = "cloud.ply", "summary.json", "report.html"
"""The files of a measurement."""

MAX_CALIBRATION_BYTES = 4_000_000
MAX_MOTION_BYTES = 200_000_000
MAX_YAML_BYTES = 100_000

_COEFFICIENTS = {"type": "array", "items": {"type": "number"}, "minItems": 1, "maxItems": 64}
_CALIBRATION_SCHEMA = {
    "type": "object",
    "additionalProperties": False,
    "properties": {
        "schema": {"const": SCHEMA},
        "id": {"type": "string", "pattern": "^[0-9a-f]{64}$"},
        "numerator": _COEFFICIENTS,
        "denominator": _COEFFICIENTS,
        "delay": {"type": "number", "minimum": 0},
        "static_gain": {"type": "number"},
        "sample_period": {"type": "number", "exclusiveMinimum": 0},
        "valid_up_to": {"type": "number", "exclusiveMinimum": 0},
        "covariance": {"type": "array", "items": {"type": "number"}, "maxItems": 16384},
        "settings": {"type": "object"},
        "certificate": {"type": "object"},
    },
}
_CALIBRATION_SCHEMA["required"] = list(_CALIBRATION_SCHEMA["properties"])  # type: ignore[call-overload]


@contextmanager
def whole_file(path: Path | str, mode: str = "wb") -> Iterator[IO[Any]]:
    """Open ``path`` for writing under a temporary name; rename it when all went well.

    FileError if it cannot be written there.
    """
    target = Path(path)
    part = target.with_name(f".{target.name}.part")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        stream = part.open(mode)
    except OSError as err:
        raise FileError(f"cannot write {str(target)!r}: {err.strerror or err}") from err
    try:
        with stream:
            yield stream
        os.replace(part, target)
    finally:
        part.unlink(missing_ok=True)


def _read_text(path: Path, limit: int, error: type[FileError], what: str) -> str:
    try:
        size = path.stat().st_size
        if size > limit:
            raise error(f"{what} {str(path)!r} has {size} bytes, at most {limit} are accepted")
        return path.read_text(encoding="utf-8")
    except FileNotFoundError as err:
        raise error(f"no {what} at {str(path)!r}; check the path") from err
    except (OSError, UnicodeDecodeError) as err:
        raise error(f"{what} {str(path)!r} cannot be read as text: {err}") from err


# --------------------------------------------------------------------------- calibration


def save_calibration(path: Path | str, calibration: Calibration) -> None:
    """Write ``CAL.json`` (schema "omsm-calibration/1")."""
    with whole_file(path, "w") as stream:
        json.dump({"id": calibration.id, **calibration.content()}, stream, indent=1)
        stream.write("\n")


def load_calibration(path: Path | str) -> Calibration:
    """Read ``CAL.json``; CalibrationError if it is malformed, altered or unstable."""
    path = Path(path)
    text = _read_text(path, MAX_CALIBRATION_BYTES, CalibrationError, "calibration")
    try:
        content = json.loads(text, parse_constant=_no_constant)
        jsonschema.validate(content, _CALIBRATION_SCHEMA)
    except jsonschema.ValidationError as err:
        raise CalibrationError(
            f"{str(path)!r} is not a calibration: {err.json_path}: {err.message[:200]}"
        ) from err
    except (ValueError, RecursionError) as err:
        raise CalibrationError(
            f"{str(path)!r} is not a calibration: not JSON ({err}); make one with 'omsm identify'"
        ) from err
    stored = content.pop("id")
    if stored != content_id(content):
        raise CalibrationError(
            f"{str(path)!r} was altered after it was made: id {stored!r} does not match its "
            f"content {content_id(content)!r}; identify it again"
        )
    try:
        return Calibration.from_content(content)
    except CalibrationError as err:
        raise CalibrationError(f"{str(path)!r}: {err}") from err


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is not a JSON number")


# --------------------------------------------------------------------------------- cloud


_PLY_TYPES = {"<f4": "float", "<f8": "double", "<u4": "uint"}
_PLY_HEADER_BYTES = 512
_PLY_DTYPE = np.dtype(list(CLOUD_FIELDS))


class PlyWriter:
    """Streams points into a binary ``cloud.ply`` of the contract's fields.

    Memory does not depend on the number of points: the header is written last, into the
    room kept for it. Leaving by an exception leaves no file.
    """

    def __init__(self, path: Path | str, comment: str = "") -> None:
        self._file = whole_file(path)
        # A line break in a comment would end it and forge header lines.
        self._comment = " ".join(comment.split())[:200]
        self.points = 0

    def __enter__(self) -> PlyWriter:
        self._stream = self._file.__enter__()
        self._stream.write(self._header())
        return self

    def write(self, points: SurfacePoints) -> None:
        """Append points."""
        packed = pack_points(points).astype(_PLY_DTYPE)
        self._stream.write(packed.tobytes())
        self.points += len(packed)

    def _header(self) -> bytes:
        lines = ["ply", "format binary_little_endian 1.0", f"comment {self._comment}"]
        lines += [f"element vertex {self.points}"]
        lines += [f"property {_PLY_TYPES[kind]} {name}" for name, kind in CLOUD_FIELDS]
        text = "\n".join(lines) + "\n"
        padding = _PLY_HEADER_BYTES - len(text) - len("comment \nend_header\n")
        return f"{text}comment {' ' * padding}\nend_header\n".encode("ascii", "replace")

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self._stream.seek(0)
            self._stream.write(self._header())
        self._file.__exit__(kind, error, trace)


class CloudFile:
    """Our own ``cloud.ply``, read in portions: memory does not depend on its length.

    points: how many it holds. Raises FileError if it is no cloud of ours, or was cut short.
    """

    def __init__(self, path: Path | str) -> None:
        self._path = Path(path)
        with self._path.open("rb") as stream:
            head, mark, _ = stream.read(_PLY_HEADER_BYTES).partition(b"end_header\n")
        if not head.startswith(b"ply\n") or not mark:
            raise FileError(f"{str(path)!r} is not a PLY file of ours")
        vertices = [line for line in head.splitlines() if line.startswith(b"element vertex")]
        self.points = int(vertices[0].split()[2]) if vertices else -1
        if self._path.stat().st_size != _PLY_HEADER_BYTES + self.points * _PLY_DTYPE.itemsize:
            raise FileError(f"{str(path)!r} is not one of our clouds, or was cut short")

    def portions(self, size: int = 500_000) -> Iterator[NDArray[np.void]]:
        """Yield all points in order, ``size`` at a time, as structured arrays of the contract."""
        with self._path.open("rb") as stream:
            stream.seek(_PLY_HEADER_BYTES)
            while raw := stream.read(size * _PLY_DTYPE.itemsize):
                yield np.frombuffer(raw, _PLY_DTYPE)

    def read(self, most: int | None = None) -> NDArray[np.void]:
        """All points, or evenly every k-th so that there are no more than ``most``."""
        every = 1 if most is None else max(-(-self.points // most), 1)
        parts = [part[::every].copy() for part in self.portions(every * 100_000)]
        return np.concatenate([np.empty(0, _PLY_DTYPE), *parts])


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
    text = _read_text(path, MAX_YAML_BYTES, error, what)
    try:
        content = yaml.safe_load(text)
    except (yaml.YAMLError, RecursionError) as err:
        raise error(f"{str(path)!r} is not YAML: {err}".replace("\n", " ")) from err
    if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
        raise error(f"{str(path)!r} holds {content!r:.80}, expected names and values of a {what}")
    return content


def load_motion(path: Path | str) -> tuple[FloatArray, float]:
    """Read a planned motion, CSV ``time_s,z_m`` as 'omsm plan' writes it: z [m] and its period [s].

    Raises FileError for anything but two columns of numbers at even times.
    """
    path = Path(path)
    text = _read_text(path, MAX_MOTION_BYTES, FileError, "motion")
    try:
        table = np.loadtxt(text.splitlines(), delimiter=",", skiprows=1, ndmin=2)
    except ValueError as err:
        raise FileError(f"{str(path)!r} is not a table of time_s,z_m: {err}") from err
    if table.shape[0] < 2 or table.shape[1] != 2 or not np.all(np.isfinite(table)):
        raise FileError(
            f"{str(path)!r} holds {table.shape!r} values, expected two columns time_s,z_m"
        )
    steps = np.diff(table[:, 0])
    period = float(np.mean(steps))
    if not period > 0 or np.ptp(steps) > 0.01 * period:
        raise FileError(
            f"{str(path)!r}: time runs in steps of {steps.min()!r} to {steps.max()!r} s, "
            "expected even steps"
        )
    return np.asarray(table[:, 1], np.float64), period


def save_text(path: Path | str, text: str) -> None:
    """Write a text file."""
    with whole_file(path, "w") as stream:
        stream.write(text)


def save_json(path: Path | str, content: Mapping[str, object]) -> None:
    """Write a JSON object for people and programs."""
    with whole_file(path, "w") as stream:
        json.dump(content, stream, indent=1, allow_nan=False)
        stream.write("\n")
