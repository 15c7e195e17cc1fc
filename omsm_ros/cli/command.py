"""The parts of a command: arguments, an action that returns facts, and how they are printed."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from omsm_ros.cli.arguments import Arguments
from omsm_ros.core.calibration.certificate import REJECTED
from omsm_ros.errors import one_line, printable

if TYPE_CHECKING:
    from omsm_ros.core.calibration.calibration import Calibration

Facts: TypeAlias = dict[str, Any]
Rows: TypeAlias = list[tuple[str, str]]
LIMIT = "{value:{unit}} of {allowed:{unit}}"
"""Template of a limit of a motion."""


@dataclass(frozen=True)
class CliCommand:
    """One command of ``omsm``; its task and its line of help are in ``words``.

    declare: adds its arguments;  act: runs it and returns facts in SI units for ``--json``
    show: prints the facts as text, and returns rows of names and texts to print after that
    refusal: returns why the command failed although it returned facts; empty if it did not
    """

    name: str
    declare: Callable[[Arguments], None]
    act: Callable[[argparse.Namespace], Facts]
    show: Callable[[Facts], Rows | None]
    refusal: Callable[[Facts], str] = lambda facts: ""


def output_path_for(out: Path, verdict: str) -> Path:
    """Return where to write a result: a rejected one must not replace a good one."""
    return out.parent / f"{out.stem}.rejected.json" if verdict == REJECTED else out


def kept(out: Path, calibration: Calibration) -> Path:
    """Write a calibration to ``out``, a rejected one under another name; return where."""
    # Imported on demand, because most commands write none.
    from omsm_ros.io.calibration_file import save_calibration

    path = output_path_for(out, calibration.certificate.verdict or "")
    save_calibration(path, calibration)
    return path


def rejected(facts: Facts) -> str:
    """Return why a calibration or model was rejected, by its facts; empty if it was not."""
    if facts["verdict"] != REJECTED:
        return ""
    kept = facts.get("calibration") or facts["model"]
    return f"rejected: {'; '.join(facts['reasons'])}; written for analysis to {kept!r}"


def say(*words: str) -> None:
    """Print one line; control characters in it, which may come from outside, are escaped."""
    print(printable(" ".join(words)))


def warn(text: str) -> None:
    """Print one line to stderr; it is lost if stderr is closed."""
    try:
        print("omsm:", one_line(text), file=sys.stderr, flush=True)
    except OSError:  # stderr is closed; the exit status still reports the error
        os.dup2(null_device(), sys.stderr.fileno())


def null_device() -> int:
    """Return the open file that takes what nobody reads."""
    return os.open(os.devnull, os.O_WRONLY)


def say_lines(text: str) -> None:
    """Print a text of several lines."""
    for line in text.split("\n"):
        say(line)


def written(files: Iterable[str], folder: str = "") -> tuple[str, str]:
    """Return the table row that names the files written, in ``folder`` or as paths."""
    names = ", ".join(files)
    return "written", f"{names} in {folder}" if folder else names


def table(rows: Rows) -> None:
    """Print names and values in two columns; nothing without rows."""
    width = max((len(name) for name, _ in rows), default=0)
    for name, value in rows:
        say(f"{name:<{width}}  {value}")
