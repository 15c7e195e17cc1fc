"""Reads regular files up to a bound; writes files and folders that appear only when complete.

Keeps private folders and exclusive files, too.
"""

import fcntl
import os
import secrets
import shutil
import stat
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import IO, Any

from omsm_ros.errors import ConfigurationError, FileError, OmsmError, shortened
from omsm_ros.io import json_and_yaml

CLOUD, SUMMARY, REPORT = "cloud.ply", "summary.json", "report.html"
SYSTEMATIC = "systematic.npz"
FORM, CURVES, DEVIATION = "form.json", "curves.json", "deviation.ply"
"""The files of a measurement."""
SPECTRUM, DIFFERENCE, EXPERIMENT = "spectrum.json", "difference.json", "experiment.json"

# Longest name in an error text [characters].
_LONGEST_NAME = 120


# Exceptions of libraries that did not expect a damaged file; their texts do not help a user.
_LIBRARY_ERRORS = (LookupError, TypeError, AttributeError, RecursionError, AssertionError)


def read_text(path: Path | str, limit: int, error: type[FileError], what: str) -> str:
    """Return the text of a regular file of at most ``limit`` bytes.

    Raises ``error``, which calls the file ``what``, for anything else.
    """
    try:
        with open_regular(path, error, what) as stream:
            raw = stream.read(limit + 1)
        if raw is None:  # some files of the kernel have no data yet
            raise BlockingIOError("there is nothing to read now")
        if len(raw) <= limit:
            return raw.decode("utf-8")
    except (OSError, UnicodeDecodeError) as err:
        raise error(
            f"{what} {str(path)!r} cannot be read as text: {exception_text(err)}; give a "
            f"{what}, which is a text in UTF-8"
        ) from err
    raise error(
        f"{what} {str(path)!r} has more than {limit} bytes, the most that is accepted; "
        "check the path"
    )


def load_object(
    path: Path | str,
    what: str,
    limit: int,
    schema: Mapping[str, Any] | None = None,
    error: type[FileError] = FileError,
    yaml: bool = False,
) -> dict[str, Any]:
    """Return the object in a JSON file, or in a YAML file if ``yaml``.

    Raises ``error``, which calls the file ``what``, if it is missing, has more than ``limit``
    bytes, or does not follow ``schema``.
    """
    text = read_text(path, limit, error, what)
    read = json_and_yaml.mapping_of if yaml else json_and_yaml.object_of
    content = read(text, error, f"{what} {str(path)!r}")
    if schema is not None:
        json_and_yaml.check_form(content, schema, error, f"{what} {str(path)!r}")
    return content


@contextmanager
def explained_errors(
    what: str,
    remedy: str,
    error: type[OmsmError] = FileError,
    caught: type[Exception] | tuple[type[Exception], ...] = (OSError, ValueError),
) -> Iterator[None]:
    """Raise ``error``, "what: why; remedy", for an exception ``caught`` within."""
    try:
        yield
    except error:
        raise
    except caught as err:
        raise error(f"{what}: {exception_text(err)}; {remedy}") from err


def library_errors(
    what: str, remedy: str, error: type[FileError] = FileError
) -> AbstractContextManager[None]:
    """Raise ``error`` for any of the many exceptions that libraries raise on a damaged file."""
    return explained_errors(f"{what} cannot be read", remedy, error, Exception)


def open_regular(path: Path | str, error: type[FileError], what: str) -> IO[bytes]:
    """Open a regular file for reading; raise ``error`` for a folder, device, pipe, or none."""
    try:
        # Without O_NONBLOCK, opening a pipe waits for a writer.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError as err:
        raise error(f"no {what} at {str(path)!r}; check the path") from err
    except (OSError, ValueError) as err:
        raise error(
            f"{what} {str(path)!r} cannot be read: {exception_text(err)}; check the path"
        ) from err
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise error(
            f"{what} {str(path)!r} cannot be read: it is no regular file but a folder, a device "
            "or a pipe; give a file"
        )
    return os.fdopen(descriptor, "rb")


def resolved_within(path: Path, folders: str, error: type[OmsmError], what: str) -> Path:
    """Return ``path`` resolved; ``error`` unless it lies below one of ``folders``.

    folders: separated by ":", as in PATH; "~" is the home folder, "." the working directory;
        empty = anywhere
    what: is read there: "calibration" or "bag"; the parameter ``<what>_folders`` names the folders
    """
    try:
        resolved = path.expanduser().resolve()
        allowed = [Path(each).expanduser().resolve() for each in folders.split(":") if each]
    except (OSError, ValueError, RuntimeError) as err:
        raise error(f"no {what} at {str(path)[:200]!r}; check the path") from err
    if allowed and not any(resolved.is_relative_to(folder) for folder in allowed):
        raise error(
            f"{str(path)[:200]!r} lies outside the folders that a {what} is read from, "
            f"{folders!r}; put it there, or start with another {what}_folders"
        )
    return resolved


def exception_text(err: Exception) -> str:
    """Return the text of an exception on one line, without the path."""
    if isinstance(err, MemoryError):
        return "it needs more memory than there is"
    if isinstance(err, _LIBRARY_ERRORS):
        return "its content is inconsistent"
    text = err.strerror if isinstance(err, OSError) and err.strerror else str(err)
    return " ".join(text.split())[:200].rstrip(".") or type(err).__name__


@contextmanager
def atomic_file(path: Path | str, mode: str = "wb") -> Iterator[IO[Any]]:
    """Open ``path`` for writing under a temporary name; rename it if no exception is raised.

    The temporary name is random, and no existing file or link is opened. Raises FileError if it
    cannot be written.
    """
    target = Path(path)
    part: Path | None = None
    try:
        make_folder(target.parent)
        if target.exists() and not target.is_file():  # replacing /dev/null would break the machine
            raise FileExistsError(None, "it is a folder, a device or a pipe")
        part = temporary_sibling(target)
        new = os.O_EXCL | os.O_NOFOLLOW
        with open(part, mode, opener=lambda name, how: os.open(name, how | new, 0o666)) as stream:
            yield stream
        os.replace(part, target)
    except (OSError, ValueError) as err:
        if isinstance(err, ValueError) and part is not None:
            raise
        raise FileError(
            f"cannot write {str(target)!r}: {exception_text(err)}; check the folder, its rights "
            "and its room"
        ) from err
    finally:
        if part is not None:
            part.unlink(missing_ok=True)


def make_folder(path: Path) -> None:
    """Make a folder and its parents; NotADirectoryError names a file in their place."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as err:
        for above in (path, *path.parents):
            if os.path.lexists(above):
                name = shortened(repr(str(above)), _LONGEST_NAME)
                raise NotADirectoryError(None, f"{name} is in the way, no folder") from err
        raise


def temporary_sibling(target: Path) -> Path:
    """Return a random name in the folder of ``target``."""
    # Not derived from the target's name, which may already have the greatest length.
    return target.with_name(f".{secrets.token_hex(8)}.part")


def save_bytes(path: Path | str, content: bytes) -> None:
    """Write a file."""
    with atomic_file(path) as stream:
        stream.write(content)


def save_text(path: Path | str, text: str) -> None:
    """Write a text file."""
    save_bytes(path, text.encode("utf-8", "replace"))


def save_json(path: Path | str, content: Mapping[str, object]) -> None:
    """Write an indented JSON object; ValueError for NaN and infinity."""
    save_text(path, json_and_yaml.text_of(content, indent=1) + "\n")


# Folders of results.

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
