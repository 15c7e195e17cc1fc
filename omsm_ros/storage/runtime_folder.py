"""A folder of the user's own for what lives as long as a process: links to emulated ports."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from omsm_ros.errors import FileError
from omsm_ros.storage.files import said

_MODE = 0o700


def runtime_folder(namespace: str = "") -> Path:
    """Return a private folder, made if need be: ``$XDG_RUNTIME_DIR/omsm_ros`` and below.

    namespace: of the cell, a folder of its own for each
    Without that variable it lies in the system's temporary folder and carries the user's number.
    Raises FileError if somebody else's folder, or a link, stands there.
    """
    base = os.environ.get("XDG_RUNTIME_DIR", "")
    folder = (
        Path(base) / "omsm_ros" if os.path.isdir(base) else Path(f"/tmp/omsm_ros-{os.getuid()}")
    )
    _make_own(folder)
    for part in namespace.strip("/").split("/"):
        if part:
            folder /= part
            _make_own(folder)
    return folder


def _make_own(folder: Path) -> None:
    try:
        folder.mkdir(mode=_MODE, parents=True, exist_ok=True)
        found = os.lstat(folder)
    except OSError as err:
        raise FileError(
            f"cannot make folder {str(folder)!r}: {said(err)}; check its rights"
        ) from err
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
        raise FileError(
            f"{str(folder)!r} is not a private folder of this user: others could put something "
            "else in its place; remove it, or set XDG_RUNTIME_DIR"
        )
