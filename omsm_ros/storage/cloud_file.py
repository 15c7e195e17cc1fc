"""``cloud.ply``: the corrected points, written as they come and read in portions."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import IO

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.correction.surface_points import CLOUD_FIELDS, SurfacePoints, pack_points
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.errors import FileError
from omsm_ros.quantities import POSITION
from omsm_ros.storage.files import open_regular, whole_file

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


def _header_lines(points: int) -> list[bytes]:
    """Return what the header of every cloud of ours says, but for comments."""
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {points}"]
    lines += [f"property {_PLY_TYPES[kind]} {name}" for name, kind in CLOUD_FIELDS]
    return [line.encode("ascii") for line in lines]


class CloudFile:
    """Our own ``cloud.ply``, read in portions: memory does not depend on its length.

    points: how many it holds. Raises FileError if it is no cloud of ours, or was cut short.
    """

    def __init__(self, path: Path | str) -> None:
        self._path = Path(path)
        with self._opened() as stream:
            head = stream.read(_PLY_HEADER_BYTES)
            try:
                held = stream.seek(0, io.SEEK_END) - _PLY_HEADER_BYTES
            except OSError as err:  # what the kernel writes as it is read, as in /proc
                raise FileError(f"{str(path)!r} has no length; give a file on a disk") from err
        self.points = max(held, 0) // _PLY_DTYPE.itemsize
        lines = [line for line in head.splitlines() if not line.startswith((b"comment", b"end_"))]
        if lines != _header_lines(self.points) or held != self.points * _PLY_DTYPE.itemsize:
            raise FileError(
                f"{str(path)!r} is none of our clouds, or was cut short; correct the scan again"
            )

    def _opened(self) -> IO[bytes]:
        return open_regular(self._path, FileError, "cloud")

    def portions(self, size: int = 500_000) -> Iterator[NDArray[np.void]]:
        """Yield all points in order, ``size`` at a time, as structured arrays of the contract.

        Raises FileError for coordinates that are no numbers, or further off than any machine goes.
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
        """Return all points, or evenly every k-th so that there are no more than ``most``."""
        every = 1 if most is None else max(-(-self.points // most), 1)
        parts = [part[::every].copy() for part in self.portions(every * 100_000)]
        return np.concatenate([np.empty(0, _PLY_DTYPE), *parts])


def widened(
    path: Path, variance: Callable[[int, int], FloatArray], size: int = 500_000
) -> Iterator[NDArray[np.void]]:
    """Add a variance to the uncertainty of each point of our cloud; yield the points as they are.

    variance: [m²] of so many points from the one with that number on, (n,)
    """
    first = 0
    with path.open("r+b") as stream:
        for before in CloudFile(path).portions(size):
            rows = before.copy()
            spread = before["uncertainty"].astype(np.float64)
            rows["uncertainty"] = np.sqrt(spread**2 + variance(first, len(rows)))
            stream.seek(_PLY_HEADER_BYTES + first * _PLY_DTYPE.itemsize)
            stream.write(rows.tobytes())
            first += len(rows)
            yield rows
