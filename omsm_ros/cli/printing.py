"""Where commands print for people: names and texts in a line may come from outside."""

from __future__ import annotations

from collections.abc import Iterable

from omsm_ros.errors import printable


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
