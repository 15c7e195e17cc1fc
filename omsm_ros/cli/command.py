"""What every command is: arguments, an action that returns facts, and a way to print them."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from omsm_ros.core.dynamics.calibration import REJECTED
from omsm_ros.jobs.progress import Progress, no_progress

Facts: TypeAlias = "dict[str, Any]"


@dataclass(frozen=True)
class Command:
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


def kept_at(out: Path, verdict: str) -> Path:
    """Return where to write a result: a rejected one never takes the place of a good one."""
    return out.parent / f"{out.stem}.rejected.json" if verdict == REJECTED else out


def rejected(facts: Facts) -> str:
    """Return why a calibration or model was rejected, by its facts; empty if it was not."""
    if facts["verdict"] != REJECTED:
        return ""
    kept = facts.get("calibration") or facts["model"]
    return f"rejected: {'; '.join(facts['reasons'])}; kept for study in {kept!r}"
