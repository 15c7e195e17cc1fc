"""What every command is: arguments, an action that returns facts, and a way to print them."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from omsm_ros.core.calibration.certificate import REJECTED
from omsm_ros.errors import printable
from omsm_ros.pipelines.progress import Progress, no_progress

Facts: TypeAlias = "dict[str, Any]"


@dataclass(frozen=True)
class CliCommand:
    """One word after ``omsm``; its place in the list and its line of help are in ``words``.

    declare: adds its arguments;  act: does it and returns facts in SI for ``--json``
    show: prints the facts for people
    refusal: why the command failed although it returned facts; empty if it did not
    """

    name: str
    declare: Callable[[argparse.ArgumentParser], None]
    act: Callable[[argparse.Namespace], Facts]
    show: Callable[[Facts], None]
    refusal: Callable[[Facts], str] = lambda facts: ""


@contextmanager
def progress_bar(title: str, quiet: bool, unit: str = " messages") -> Iterator[Progress]:
    """Show a bar on stderr that counts messages or ``unit``; none for programs and in pipes."""
    if quiet or not sys.stderr.isatty():
        yield no_progress
        return
    # Here, because most commands run for programs, and nobody would see it.
    from tqdm import tqdm

    with tqdm(desc=title, unit=unit, leave=False) as bar:

        def advance(done: int, total: int) -> None:
            bar.total = total or None
            bar.update(done - bar.n)

        yield advance


def output_path_for(out: Path, verdict: str) -> Path:
    """Return where to write a result: a rejected one never takes the place of a good one."""
    return out.parent / f"{out.stem}.rejected.json" if verdict == REJECTED else out


def rejected(facts: Facts) -> str:
    """Return why a calibration or model was rejected, by its facts; empty if it was not."""
    if facts["verdict"] != REJECTED:
        return ""
    kept = facts.get("calibration") or facts["model"]
    return f"rejected: {'; '.join(facts['reasons'])}; kept for study in {kept!r}"


# Where commands print for people: names and texts in a line may come from outside.


def say(*words: str) -> None:
    """Print one line; what in it would steer a terminal, or end the line, is written out."""
    print(printable(" ".join(words)))


def say_lines(text: str) -> None:
    """Print a text of ours that has several lines."""
    for line in text.split("\n"):
        say(line)


def written(files: Iterable[str], folder: str = "") -> tuple[str, str]:
    """Return the row of a table that says what was written: names and their folder, or paths."""
    names = ", ".join(files)
    return "written", f"{names} in {folder}" if folder else names


def table(rows: list[tuple[str, str]]) -> None:
    """Print names and values in two columns; nothing where there are none."""
    width = max((len(name) for name, _ in rows), default=0)
    for name, value in rows:
        say(f"{name:<{width}}  {value}")


# The option that names the catalogue where what was calibrated or measured is written down.

ADDRESS = "OMSM_CATALOGUE"
"""Environment variable: the catalogue of this shop, where none is named."""


def declare_catalogue(sub: argparse.ArgumentParser) -> None:
    """Add ``--catalogue`` to a command that makes something worth remembering."""
    sub.add_argument(
        "--catalogue",
        default=os.environ.get(ADDRESS, ""),
        metavar="FILE|URL",
        help=f"write it down there, too; default: ${ADDRESS}",
    )
