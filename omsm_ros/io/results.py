"""Writes and reads the files of a measurement: clouds, summaries, forms and systematic errors."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.correction.source_kinds import FORMER_NAMES
from omsm_ros.core.correction.surface_points import CLOUD_FIELDS, SurfacePoints, pack_points
from omsm_ros.core.correction.systematic import ScanFields
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import FileError
from omsm_ros.io.files import (
    CLOUD,
    SUMMARY,
    atomic_file,
    explained_errors,
    open_regular,
    read_result,
    save_bytes,
)
from omsm_ros.io.json_and_yaml import (
    CONFORMITY,
    FIGURE,
    NUMBER_OR_NULL,
    TEXT,
    TEXTS,
    each,
    group,
    or_none,
    ranged,
    rows,
)
from omsm_ros.quantities import COUNTER, POSITION, SAMPLE_PERIOD, SIGNAL, STAMP

_PLY_TYPES = {"<f4": "float", "<f8": "double", "<u4": "uint"}
_PLY_HEADER_BYTES = 512
_PLY_DTYPE = np.dtype(list(CLOUD_FIELDS))
# More than the pixels of a figure; the numbers of a summary come from all points.
MOST_DRAWN = 2**19


class PlyWriter:
    """Writes points into a binary ``cloud.ply`` with the fields of the contract.

    Memory does not depend on the number of points: the header is written last, into its reserved
    space. An exception leaves no file.
    """

    def __init__(self, path: Path | str, comment: str = "") -> None:
        self._file = atomic_file(path)
        # A line break in the comment would add header lines.
        self._comment = " ".join(comment.split())[:200]
        self.points = 0

    def __enter__(self) -> PlyWriter:
        self._stream = self._file.__enter__()
        self._stream.write(self._header())
        return self

    def write(self, points: SurfacePoints) -> NDArray[np.void]:
        """Append points, and return them as :meth:`CloudFile.read` would (n,)."""
        packed = pack_points(points, _PLY_DTYPE)
        self._stream.write(packed.data)
        self.points += len(packed)
        return packed

    def _header(self) -> bytes:
        lines = _header_lines(self.points)
        lines.insert(2, f"comment {self._comment}".encode("ascii", "replace"))
        text = b"\n".join(lines) + b"\n"
        padding = _PLY_HEADER_BYTES - len(text) - len("comment \nend_header\n")
        return text + b"comment " + b" " * padding + b"\nend_header\n"

    def __exit__(self, kind: Any, *rest: Any) -> None:
        if kind is None:
            self._stream.seek(0)
            self._stream.write(self._header())
        self._file.__exit__(kind, *rest)


def _header_lines(points: int) -> list[bytes]:
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {points}"]
    lines += [f"property {_PLY_TYPES[kind]} {name}" for name, kind in CLOUD_FIELDS]
    return [line.encode("ascii") for line in lines]


class CloudFile:
    """Reads our ``cloud.ply`` in portions; memory does not depend on its length.

    points: their number. Raises FileError if it is no cloud of ours or is incomplete.
    """

    def __init__(self, path: Path | str) -> None:
        self._path = Path(path)
        with self._opened() as stream:
            head = stream.read(_PLY_HEADER_BYTES)
            try:
                held = stream.seek(0, io.SEEK_END) - _PLY_HEADER_BYTES
            except OSError as err:  # files of the kernel, as in /proc
                raise FileError(f"{str(path)!r} has no length; give a file on a disk") from err
        self.points = max(held, 0) // _PLY_DTYPE.itemsize
        lines = [line for line in head.splitlines() if not line.startswith((b"comment", b"end_"))]
        if lines != _header_lines(self.points) or held != self.points * _PLY_DTYPE.itemsize:
            raise FileError(
                f"{str(path)!r} is not a cloud of omsm_ros, or was cut short; correct the scan "
                "again"
            )

    def _opened(self) -> IO[bytes]:
        return open_regular(self._path, FileError, "cloud")

    def portions(self, size: int = 500_000) -> Iterator[NDArray[np.void]]:
        """Yield all points in order, ``size`` at a time, as structured arrays of the contract.

        Raises FileError for coordinates that are not finite, or beyond the size of any machine.
        """
        with self._opened() as stream:
            stream.seek(_PLY_HEADER_BYTES)
            while raw := stream.read(size * _PLY_DTYPE.itemsize):
                rows = np.frombuffer(raw, _PLY_DTYPE)
                for name in ("x", "y", "height"):
                    what = f"cloud {str(self._path)!r}: {name}"
                    POSITION.checked_all(rows[name], FileError, what)
                yield rows

    def read(self, most: int | None = None) -> NDArray[np.void]:
        """Return all points, or each k-th so that there are at most ``most``."""
        every = 1 if most is None else max(-(-self.points // most), 1)
        parts = [part[::every].copy() for part in self.portions(every * 100_000)]
        return np.concatenate([np.empty(0, _PLY_DTYPE), *parts])


def with_added_variance(
    path: Path, variance: Callable[[int, int], FloatArray]
) -> Iterator[NDArray[np.void]]:
    """Add a variance to the uncertainty of each point of our cloud, and yield the points.

    variance: returns that of ``(first, count)`` points, (n,) [m²]
    """
    first = 0
    with path.open("r+b") as stream:
        for before in CloudFile(path).portions():
            rows = before.copy()
            spread = before["uncertainty"].astype(np.float64)
            rows["uncertainty"] = np.sqrt(spread**2 + variance(first, len(rows)))
            stream.seek(_PLY_HEADER_BYTES + first * _PLY_DTYPE.itemsize)
            stream.write(rows.tobytes())
            first += len(rows)
            yield rows


# The parts of ``summary.json`` that pages and tables use.

_ANY = {"type": "object"}
_COUNT, _NUMBER = ranged(COUNTER), ranged(SIGNAL)
_ERROR = group({"rms": NUMBER_OR_NULL, "peak_to_valley": NUMBER_OR_NULL})
_DEVIATION = group({"peak_to_valley": NUMBER_OR_NULL, "rms_area_weighted": NUMBER_OR_NULL})
_STREAM = group({"received": _COUNT, "corrected": _COUNT, "counted": each(_COUNT)}, pending=_COUNT)
_SOURCE = {
    "source": TEXT, "says": TEXT, "kind": TEXT, "status": TEXT, "unit": TEXT,
    "reason": TEXT, "standard_uncertainty": NUMBER_OR_NULL, "height": NUMBER_OR_NULL,
}  # fmt: skip
_LIMIT = {
    "name": TEXT, "unit": TEXT, "value": NUMBER_OR_NULL, "allowed": NUMBER_OR_NULL,
    "speed_factor": _NUMBER,
}  # fmt: skip
_VERDICT = {
    "code": {"enum": ["verified", "not_verified", "contradicted", "too_uncertain", "invalid"]},
    "text": TEXT,
    "reasons": rows({"text": TEXT}),
}
_VALUE = group({"value": _NUMBER, "standard_uncertainty": NUMBER_OR_NULL})
_OPEN = rows({"reason": TEXT, "peak_to_valley": NUMBER_OR_NULL})
_FORM = group(
    {},
    bag=TEXT,
    calibration=TEXT,
    sample_period=ranged(SAMPLE_PERIOD),
    samples=each(_STREAM),
    warnings=TEXTS,
    settings=_ANY,
    versions=_ANY,
    files=_ANY,
    admission=or_none(_ANY),
    conditions=group(
        {},
        recorded_ns=or_none(ranged(STAMP)),
        calibration_age=NUMBER_OR_NULL,
        temperature=or_none(_ANY),
    ),
    prediction=or_none(
        group({}, limits=rows(_LIMIT), not_evaluated=TEXTS, speed_factor=NUMBER_OR_NULL)
    ),
    dynamic_error_before=or_none(_ERROR),
    dynamic_error_after=or_none(_ERROR),
    deviation=or_none(group({}, raw=or_none(_DEVIATION), corrected=or_none(_DEVIATION))),
    uncertainty=group({}, median=NUMBER_OR_NULL, largest=NUMBER_OR_NULL),
    budget=or_none(group({}, sources=rows(_SOURCE))),
    verdict=or_none(group(_VERDICT, add=or_none(group({"text": TEXT, "reached": NUMBER_OR_NULL})))),
    figures=or_none(group({}, peak_to_valley=_VALUE, rms=_VALUE, removed=TEXTS)),
    conformity=or_none(group(CONFORMITY)),
    form=or_none(group({}, deviation=each(FIGURE), open=_OPEN)),
)


def read_summary(path: Path) -> dict[str, Any]:
    """Return the content of ``summary.json``: lengths [m], times [s], stamps [ns].

    Files of schema 1 have former names of sources. Raises FileError if it is missing, too large,
    no JSON, or has values of other types than ``omsm correct`` writes.
    """
    summary = read_result(path, "summary", _FORM)
    for source in (summary.get("budget") or {}).get("sources", []):
        source["source"] = FORMER_NAMES.get(source["source"], source["source"])
    return summary


def summary_of_points(path: Path) -> dict[str, Any] | None:
    """Return the summary of a result folder, or of the cloud in it, None if it has none."""
    file = (path if path.is_dir() else path.parent) / SUMMARY
    is_result = path.is_dir() or path.name == CLOUD
    return read_summary(file) if is_result and file.is_file() else None


# The parts of ``form.json`` and ``curves.json`` that pages use.

_SIGNAL_NUMBER = ranged(SIGNAL)
_SQUARE = {"type": "number", "minimum": 0, "maximum": SIGNAL.high}
_ARRAY = {"type": "array"}
_REPEATED = "register the part again"

_REMOVED = group(
    {},
    fitted=TEXTS,
    notes=TEXTS,
    not_evaluated=TEXTS,
    held=each(TEXT),
    not_determined=each(TEXT),
    pose_uncertainty=each(each(_SIGNAL_NUMBER)),
)
_TERM = {"n": {"type": "integer"}, "m": {"type": "integer"}, **FIGURE["properties"]}
_FORM_SCHEMA = group(
    {"zernike": rows(_TERM)},
    deviation=each(FIGURE),
    pose=each(FIGURE),
    removed=_REMOVED,
    open=_OPEN,
    conformity=or_none(group(CONFORMITY)),
)
_COLUMNS = ("position", "value", "uncertainty")
_CURVE = group(dict.fromkeys(_COLUMNS, _ARRAY))
_DENSITY = group(
    {
        "radial": _CURVE,
        "azimuthal": _CURVE,
        "mean_square": _SQUARE,
        "mean_square_in_band": _SQUARE,
        "band": {"type": "array", "items": _SIGNAL_NUMBER, "minItems": 2, "maxItems": 2},
    },
    areal=group(dict.fromkeys(("x", "y", "value"), _ARRAY)),
)
_CURVES = group({}, profiles=each(_CURVE), psd=or_none(_DENSITY))


def read_form(path: Path) -> dict[str, Any]:
    """Return the content of ``form.json``: lengths [m], angles [rad].

    Raises FileError if it is missing, too large, no JSON, or has values of other types than a
    registration writes.
    """
    form, what = read_result(path, "form", _FORM_SCHEMA), f"form {str(path)!r}"
    removed = form.get("removed", {})
    for source, shares in removed.get("pose_uncertainty", {}).items():
        for name in removed.get("fitted", ()):
            if name not in shares:
                raise FileError(
                    f"{what}: pose_uncertainty.{source} lacks {name}, which was fitted; {_REPEATED}"
                )
    return form


def read_curves(path: Path) -> dict[str, Any]:
    """Return ``curves.json``: profiles [m], densities [m⁴]; FileError as :func:`read_form`."""
    curves, what = read_result(path, "curves", _CURVES), f"curves {str(path)!r}"
    density = curves.get("psd") or {}
    parts = {n: density[n] for n in ("radial", "azimuthal") if n in density}
    for name, curve in (curves.get("profiles", {}) | parts).items():
        lengths = {len(_numbers(curve[column], f"{what}: {name}", 1)) for column in _COLUMNS}
        if len(lengths) > 1:
            raise FileError(f"{what}: {name} has columns of {sorted(lengths)} values; {_REPEATED}")
    if areal := density.get("areal"):
        x, y = (_numbers(areal[axis], f"{what}: areal.{axis}", 1) for axis in "xy")
        shape = _numbers(areal["value"], f"{what}: areal.value", 2).shape
        if shape != (len(y), len(x)):
            raise FileError(
                f"{what}: areal.value has {shape[0]} × {shape[1]} values at {len(y)} × {len(x)} "
                f"frequencies; {_REPEATED}"
            )
    return curves


def _numbers(values: object, what: str, axes: int) -> FloatArray:
    wrong = TypeError, ValueError
    with explained_errors(f"{what} is no row of numbers", _REPEATED, caught=wrong):
        found = np.array(values, np.float64)
    if found.ndim != axes or not found.size or not np.all(np.isfinite(found)):
        raise FileError(
            f"{what} has shape {found.shape!r} or values that are not finite; {_REPEATED}"
        )
    return found


# ``systematic.npz`` has the effect of the systematic errors of a scan on its points.

# A hundred fields of ten thousand points are four megabytes.
MAX_BYTES = 100_000_000
_NAMES = ("names", "fields", "every")


def save_fields(path: Path | str, fields: ScanFields) -> None:
    """Write ``systematic.npz``."""
    content = io.BytesIO()
    np.savez(
        content,
        names=np.array(fields.names, dtype=np.str_),
        fields=fields.fields.astype(np.float32),
        every=np.int64(fields.every),
        bounds=np.array(fields.bounds, dtype=np.str_),
        aligned=np.array(fields.aligned, dtype=np.str_),
    )
    save_bytes(path, content.getvalue())


def _today(names: Iterable[object]) -> tuple[str, ...]:
    return tuple(FORMER_NAMES.get(str(name), str(name)) for name in names)


def load_fields(path: Path | str) -> ScanFields:
    """Read ``systematic.npz``; FileError if it is something else."""
    what = f"fields {str(path)!r}"
    with open_regular(Path(path), FileError, "fields") as stream:
        raw = stream.read(MAX_BYTES + 1)
    if len(raw) > MAX_BYTES:
        raise FileError(f"{what} have more than {MAX_BYTES} bytes; correct the scan again")
    # numpy raises many kinds, and refuses pickles by default; a signalling NaN is refused below.
    with explained_errors(f"{what} are damaged", "correct the scan again", caught=Exception):
        with np.load(io.BytesIO(raw)) as content, np.errstate(invalid="ignore"):
            names, fields, every = (np.asarray(content[name]) for name in _NAMES)
            # Without a statement, each field may be an upper bound.
            bounds = content["bounds"] if "bounds" in content else np.unique(names)
            aligned = content.get("aligned", ())
            if np.iscomplexobj(fields) or every.ndim:
                raise ValueError("a field is complex, or its spacing is no single number")
            values = fields.astype(np.float64)
        found = ScanFields(_today(names), values, int(every), _today(bounds), _today(aligned))
    shape = found.fields.shape
    if len(shape) != 2 or shape[0] != len(names) or found.every < 1:
        raise FileError(f"{what} have shape {shape!r} for {len(names)} names; correct it again")
    if not np.all(np.isfinite(found.fields)):
        raise FileError(f"{what} hold values that are not finite; correct the scan again")
    return found
