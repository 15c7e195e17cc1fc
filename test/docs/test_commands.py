"""Check that every command in the documents parses; test_run_pages runs them."""

import argparse
import re
import shlex
from functools import cache
from pathlib import Path

import pytest

import omsm_ros
from omsm_ros.cli.words import WORDS

from .pages import parser

ROOT = Path(omsm_ros.__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
BLOCKS = re.compile(r"^ *```\w*\n(.*?)^ *```", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"`([^`\n]+)`")


def commands(text, word):
    """Yield command lines of ``word`` in blocks and in the text, without remarks after #."""
    blocks = [b.replace("\\\n", " ") for b in BLOCKS.findall(text)]
    lines = [line.strip() for block in blocks for line in block.splitlines()]
    lines += [line.strip() for line in INLINE.findall(BLOCKS.sub("", text))]
    for line in lines:
        for part in re.split(r"&&|\|\||\s#|>", line):
            if part.strip().startswith(f"{word} "):
                yield part.strip()


@cache
def options(word):
    """Return the options of a command and of its subcommands."""
    found, waiting = set(), [_parser(word)]
    while waiting:
        for action in waiting.pop()._actions:
            found |= set(action.option_strings)
            if isinstance(action, argparse._SubParsersAction):
                waiting += action.choices.values()
    return found


def _parser(word):
    (commands,) = [a for a in parser()._actions if hasattr(a.choices, "get")]
    return commands.choices[word]


def misunderstood(text):
    for line in commands(text, "omsm"):
        own, _, passed_on = line.partition(" -- ")
        word, *rest = own.split()[1:]
        if word.startswith("-") or word in ("COMMAND", "…"):
            continue
        if word not in WORDS:
            yield f"{line!r}: no command {word!r}"
            continue
        given = {re.split(r"[=\\|,]", r)[0] for r in rest if r.startswith("--")}
        unknown = given - options(word)
        given = {r for r in passed_on.split() if r.startswith("--")}
        unknown |= given - options("correct")
        if unknown:
            yield f"{line!r}: {sorted(unknown)}"


def unknown_to_ros(text):
    setup = (ROOT / "setup.py").read_text(encoding="utf-8")
    nodes = re.search(r"NODES = \((.*?)\)", setup, re.DOTALL)[1]
    known = {*re.findall(r'"(\w+)"', nodes), "replay", "cell"}
    for line in commands(text, "ros2"):
        kind, *rest = [*shlex.split(line, comments=True)[1:], "", ""]
        if kind == "run" and rest[0] == "omsm_ros" and rest[1].islower() and rest[1] not in known:
            yield f"{line!r}: no node {rest[1]!r}"
        if kind == "launch" and rest[0] == "omsm_ros":
            file = ROOT / "launch" / rest[1]
            arguments = {r.partition(":=")[0] for r in rest[2:] if ":=" in r}
            code = file.read_text(encoding="utf-8") if file.is_file() else ""
            declared = set(re.findall(r'^    "(\w+)": \(', code, re.MULTILINE))
            yield from (f"{line!r}: {a!r}" for a in sorted(arguments - declared))


def unknown_to_make(text):
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    goals = set(re.findall(r"^(\w+):(?!=)", makefile, re.MULTILINE))
    for line in commands(text, "make"):
        goal = re.match(r"make ([a-z]\w*)", line)
        if goal and goal[1] not in goals:
            yield f"{line!r}: no goal {goal[1]!r}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_every_command_on_a_page_is_one(page):
    text = page.read_text(encoding="utf-8")
    wrong = [*misunderstood(text), *unknown_to_ros(text), *unknown_to_make(text)]
    assert not wrong


@pytest.mark.parametrize(
    "text",
    [
        "```\nomsm corect scan.mcap\n```",
        "see `omsm correct SCAN --nominl FILE`",
        "```sh\nomsm correct a \\\n    --cal cal.json\n```",
        "```\nomsm batch a --calibration c --out d -- --nominel e\n```",
        "```text\nros2 launch omsm_ros cell.launch.py config:=my_cell/\n```",
        "```text\nros2 run omsm_ros conductor\n```",
        "`make tests`",
    ],
)
def test_a_command_that_is_none_is_found_out(text):
    assert [*misunderstood(text), *unknown_to_ros(text), *unknown_to_make(text)]
