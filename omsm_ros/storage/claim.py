"""Two emulators do not offer one port, two calibrators keep no one file: the second is refused."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from omsm_ros.errors import ConfigurationError, FileError
from omsm_ros.storage.files import said


@contextmanager
def claimed(path: Path) -> Iterator[None]:
    """Hold ``path``, which need not exist, for this process alone.

    The system lets go of it however the process ends. Raises ConfigurationError if another one
    holds it or it names no file, FileError if its folder cannot be written.
    """
    if path.name in ("", ".."):
        raise ConfigurationError(f"{str(path)!r} names no file; give a name in a folder")
    lock = path.with_name(f".{path.name[-200:]}.lock")
    try:
        held = _locked(lock)
    except BlockingIOError as err:
        raise ConfigurationError(
            f"{str(path)!r} is in use by another process; end it, or give another name"
        ) from err
    except OSError as err:
        raise FileError(f"cannot hold {str(path)!r}: {said(err)}; check its folder") from err
    try:
        yield
    finally:
        lock.unlink(missing_ok=True)
        os.close(held)


def _locked(lock: Path) -> int:
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
    while True:
        held = os.open(lock, flags, 0o600)
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # Who ended meanwhile took the file's name away.
            if lock.exists() and os.path.samestat(os.fstat(held), os.stat(lock)):
                return held
        except BlockingIOError:
            os.close(held)
            raise
        os.close(held)
