"""``cloud.ply``: the corrected points, written as they come and read in portions."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.correction.surface_points import CLOUD_FIELDS, SurfacePoints, pack_points
from omsm_ros.errors import FileError
from omsm_ros.storage.files import whole_file

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

    def write(self, points: SurfacePoints) -> NDArray[np.void]:
        """Append points, and return them as :meth:`CloudFile.read` would (n,)."""
        packed = pack_points(points, _PLY_DTYPE)
        self._stream.write(packed.data)
        self.points += len(packed)
        return packed

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
