"""A folder of results: put in place together, all of one run or none of it; and read again."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from omsm_ros.errors import FileError
from omsm_ros.storage import strict_json
from omsm_ros.storage.files import (
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
    beside,
    make_folder,
    read_text,
    said,
)

FORM_FILES = (DEVIATION, CURVES, REPORT, FORM)
MEASUREMENT_FILES = (CLOUD, SYSTEMATIC, *FORM_FILES, SUMMARY)
EXPERIMENT_FILES = (*MEASUREMENT_FILES, EXPERIMENT)

# Results that have a name in common. An experiment may hold a measurement, that its form.
_RESULTS = {
    EXPERIMENT: EXPERIMENT_FILES,
    SUMMARY: MEASUREMENT_FILES,
    FORM: FORM_FILES,
    SPECTRUM: (REPORT, SPECTRUM),
    DIFFERENCE: (REPORT, DIFFERENCE),
}
# A summary of ours has tens of kilobytes.
MAX_RESULT_BYTES = 10_000_000


@contextmanager
def result_folder(path: Path | str, names: Sequence[str]) -> Iterator[Path]:
    """Yield an empty private folder; put its files into ``path`` at once when all went well.

    names: of the files that make a result; those of an earlier run go. The last of them says
        that the result is whole: it is taken away first and comes last, so that nobody ever
        sees it beside files of another run. Other files in ``path`` stay; one that this run
        makes beside its result replaces only that of an earlier run.

    FileError if it cannot be written there, or where the result of another command is that has
    files of these names; then, as after any exception, ``path`` is unchanged.
    """
    target = Path(os.path.abspath(path))
    staged: Path | None = None
    try:
        try:
            make_folder(target.parent)
            if target.exists() and not target.is_dir():
                raise NotADirectoryError(None, "it is a file; give a folder")
            _refuse_foreign(target, names)
            staged = beside(target)
            staged.mkdir()
        except (OSError, ValueError) as err:
            raise _refusal(path, err) from err
        yield staged
        try:
            _put_in_place(staged, target, names)
        except (OSError, ValueError) as err:
            raise _refusal(path, err) from err
    finally:
        if staged is not None:
            shutil.rmtree(staged, ignore_errors=True)


def _refusal(path: Path | str, err: Exception) -> FileError:
    if isinstance(err, FileError):
        return err
    return FileError(
        f"cannot write results into {str(path)!r}: {said(err)}; check the folder, its rights and "
        "its room"
    )


def _put_in_place(staged: Path, target: Path, names: Sequence[str]) -> None:
    if not target.exists():
        try:
            staged.rename(target)
        except OSError:
            if not target.is_dir():
                raise
        else:
            return
        # Another writer came first: what follows replaces its files.
    again = (target / names[-1]).is_file()
    for part in staged.iterdir():
        if (target / part.name).is_dir():
            raise IsADirectoryError(None, f"{part.name!r} there is a folder; remove it")
        if part.name not in names and (target / part.name).exists() and not again:
            raise FileExistsError(
                None, f"{part.name!r} is there and no result; give another folder"
            )
    lock = os.open(target, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)  # one writer after the other
        _refuse_foreign(target, names)
        for name in reversed(names):
            (target / name).unlink(missing_ok=True)
        for part in sorted(staged.iterdir(), key=lambda part: part.name == names[-1]):
            part.replace(target / part.name)
    finally:
        os.close(lock)


def _refuse_foreign(target: Path, names: Sequence[str]) -> None:
    """Raise FileError where the folder holds another command's result with files of these names."""
    found = next((mark for mark in _RESULTS if (target / mark).is_file()), names[-1])
    if found != names[-1] and not set(names).isdisjoint(_RESULTS[found]):
        raise FileError(
            f"{str(target)!r} holds the result of another command ({found}), whose files would "
            "be mixed with these; give another folder"
        )


def read_result(path: Path, what: str) -> dict[str, Any]:
    """Return the object in a JSON file of results, such as ``summary.json``, called ``what``.

    FileError where it is not there, too large, or no JSON object.
    """
    text = read_text(path, MAX_RESULT_BYTES, FileError, what)
    return strict_json.object_of(text, FileError, f"{what} {str(path)!r}")
