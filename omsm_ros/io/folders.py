"""Writes and reads folders of results, and keeps private folders and exclusive files."""

import fcntl
import os
import shutil
import stat
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from omsm_ros.errors import ConfigurationError, FileError
from omsm_ros.io.files import (
    CLOUD,
    CURVES,
    DEVIATION,
    DIFFERENCE,
    EXPERIMENT,
    FORM,
    REPORT,
    SPECTRUM,
    SUMMARY,
    SYSTEMATIC,
    explained_errors,
    load_object,
    make_folder,
    temporary_sibling,
)

FORM_FILES = (DEVIATION, CURVES, REPORT, FORM)
MEASUREMENT_FILES = (CLOUD, SYSTEMATIC, *FORM_FILES, SUMMARY)
EXPERIMENT_FILES = (*MEASUREMENT_FILES, EXPERIMENT)

# Results with a common file name. An experiment may contain a measurement, and that a form.
_RESULTS = {
    EXPERIMENT: EXPERIMENT_FILES,
    SUMMARY: MEASUREMENT_FILES,
    FORM: FORM_FILES,
    SPECTRUM: (REPORT, SPECTRUM),
    DIFFERENCE: (REPORT, DIFFERENCE),
}
# Our summaries have tens of kilobytes.
MAX_RESULT_BYTES = 10_000_000


@contextmanager
def result_folder(path: Path | str, names: Sequence[str]) -> Iterator[Path]:
    """Yield an empty private folder; move its files into ``path`` if no exception is raised.

    names: of the files of a result; those of an earlier run are removed. The last of them marks a
        complete result: it is removed first and written last, so it is never together with files
        of another run. Other files in ``path`` stay; one that this run adds replaces only that of
        an earlier run.

    Raises FileError if ``path`` cannot be written, or has the result of another command with files
    of these names; then, as after any exception, ``path`` is unchanged.
    """
    target = Path(os.path.abspath(path))
    staged: Path | None = None
    said = f"cannot write results into {str(path)!r}"
    remedy = "check the folder, its rights and its room"
    try:
        with explained_errors(said, remedy):
            make_folder(target.parent)
            if target.exists() and not target.is_dir():
                raise NotADirectoryError(None, "it is a file; give a folder")
            _refuse_foreign(target, names)
            staged = temporary_sibling(target)
            staged.mkdir()
        yield staged
        with explained_errors(said, remedy):
            _move_into_place(staged, target, names)
    finally:
        if staged is not None:
            shutil.rmtree(staged, ignore_errors=True)


def _move_into_place(staged: Path, target: Path, names: Sequence[str]) -> None:
    if not target.exists():
        try:
            staged.rename(target)
        except OSError:
            if not target.is_dir():
                raise
        else:
            return
        # Another writer was first: its files are replaced.
    again = (target / names[-1]).is_file()
    for part in staged.iterdir():
        if (target / part.name).is_dir():
            raise IsADirectoryError(None, f"{part.name!r} there is a folder; remove it")
        if part.name not in names and (target / part.name).exists() and not again:
            raise FileExistsError(
                None, f"{part.name!r} is there and no result; give another folder"
            )
    with locked_folder(target):
        _refuse_foreign(target, names)
        for name in reversed(names):
            (target / name).unlink(missing_ok=True)
        for part in sorted(staged.iterdir(), key=lambda part: part.name == names[-1]):
            part.replace(target / part.name)


@contextmanager
def locked_folder(path: Path, wait: bool = True) -> Iterator[None]:
    """Lock a folder for one writer at a time; without ``wait`` BlockingIOError if it is locked."""
    lock = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        yield
    finally:
        os.close(lock)


def _refuse_foreign(target: Path, names: Sequence[str]) -> None:
    """Raise FileError if the folder has another command's result with files of these names."""
    found = next((mark for mark in _RESULTS if (target / mark).is_file()), names[-1])
    if found != names[-1] and not set(names).isdisjoint(_RESULTS[found]):
        raise FileError(
            f"{str(target)!r} holds the result of another command ({found}), whose files would "
            "be mixed with these; give another folder"
        )


def read_result(path: Path, what: str, schema: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return the object of a JSON file, ``what``; FileError if missing, too large or of no form."""
    return load_object(path, what, MAX_RESULT_BYTES, schema)


_MODE = 0o700


def runtime_folder(namespace: str = "") -> Path:
    """Return a private folder, such as for links to emulated ports; it is created if needed.

    It is ``$XDG_RUNTIME_DIR/omsm_ros``, or in /tmp with the user's number without that variable.

    namespace: of the cell, which has its own folder below
    Raises FileError if a link or the folder of another user is there.
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
    with explained_errors(f"cannot make folder {str(folder)!r}", "check its rights"):
        folder.mkdir(mode=_MODE, parents=True, exist_ok=True)
        found = os.lstat(folder)
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
        raise FileError(
            f"{str(folder)!r} is not a private folder of this user: others could put something "
            "else in its place; remove it, or set XDG_RUNTIME_DIR"
        )


@contextmanager
def exclusive_lock(path: Path) -> Iterator[None]:
    """Lock ``path``, which need not exist, for this process.

    The lock ends with the process. Raises ConfigurationError if another process holds it or the
    path names no file, FileError if its folder cannot be written.
    """
    if path.name in ("", ".."):
        raise ConfigurationError(f"{str(path)!r} names no file; give a name in a folder")
    lock = path.with_name(f".{path.name[-200:]}.lock")
    with explained_errors(f"cannot hold {str(path)!r}", "check its folder", caught=OSError):
        try:
            held = _locked(lock)
        except BlockingIOError as err:
            raise ConfigurationError(
                f"{str(path)!r} is in use by another process; end it, or give another name"
            ) from err
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
            # A process that ended in between has removed the file.
            if lock.exists() and os.path.samestat(os.fstat(held), os.stat(lock)):
                return held
        except BlockingIOError:
            os.close(held)
            raise
        os.close(held)
