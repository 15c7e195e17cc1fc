"""Reads regular files up to a bound, and writes files that appear only when they are complete."""

import os
import secrets
import stat
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import IO, Any

from omsm_ros.errors import FileError, OmsmError, shortened
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
