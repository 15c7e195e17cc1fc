"""Files that appear only when they are whole, and texts read up to a bound."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from omsm_ros.errors import FileError

CLOUD, SUMMARY, REPORT = "cloud.ply", "summary.json", "report.html"
"""The files of a measurement."""


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


def save_text(path: Path | str, text: str) -> None:
    """Write a text file."""
    with whole_file(path, "w") as stream:
        stream.write(text)


def save_json(path: Path | str, content: Mapping[str, object]) -> None:
    """Write a JSON object for people and programs."""
    with whole_file(path, "w") as stream:
        json.dump(content, stream, indent=1, allow_nan=False)
        stream.write("\n")
