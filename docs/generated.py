"""Pages of the reference, generated from the code: commands, parameters, messages, quantities."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

import yaml

from omsm_ros import quantities
from omsm_ros.cli.command_line import parser_of
from omsm_ros.cli.words import WORDS

ROOT = Path(__file__).resolve().parent.parent


def write(folder: Path) -> None:
    """Write every generated page into ``folder``; unchanged files are not touched."""
    folder.mkdir(exist_ok=True)
    pages = {
        "commands": commands(),
        "parameters": parameters(),
        "messages": messages(),
        "quantities": ranges(),
    }
    for name, text in pages.items():
        path = folder / f"{name}.md"
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def commands() -> str:
    """Return a section for each word after ``omsm``, with its arguments."""
    parser = parser_of(WORDS)
    (words,) = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    lines = ["# Options of the commands", ""]
    lines += ["Exit status: 0 done, 2 bad input, 70 internal error.", ""]
    for name, sub in words.choices.items():
        said = (sub.description or "").strip()
        lines += [f"## omsm {name}", "", f"{said[:1].upper()}{said[1:]}.", ""]
        lines += ["```text", sub.format_usage().strip(), "```", ""]
        lines += _examples(name)
        rows = [
            _argument(a) for a in sub._actions if a.dest != "help" and a.help != argparse.SUPPRESS
        ]
        lines += ["| argument | meaning |", "|---|---|", *rows, ""]
        if sub.epilog:
            lines += [sub.epilog, ""]
    return "\n".join(lines) + "\n"


def _examples(name: str) -> list[str]:
    """Return the calls of a command that the page of commands lists, one a line."""
    page = (ROOT / "docs" / "commands.md").read_text(encoding="utf-8")
    calls = re.findall(rf"^\| `(omsm {name}\b[^`]*)`", page, re.MULTILINE)
    return ["```text", *(call.replace("\\|", "|") for call in calls), "```", ""]


# Arguments whose names say enough on the command line.
_NAMED = {
    "CAL.json": "calibration", "OLD.json": "calibration", "NEW.json": "calibration",
    "SURFACE.yaml": "nominal surface", "MODEL.json": "model", "bag": "recording", "FILE": "table",
    "clockwise": "recording", "counterclockwise": "recording", "shell": "bash, zsh or tcsh",
}  # fmt: skip


def _argument(action: argparse.Action) -> str:
    names = ", ".join(f"`{option}`" for option in action.option_strings)
    shown = action.metavar if isinstance(action.metavar, tuple) else [action.metavar]
    placeholder = " ".join(filter(None, shown))
    name = names or f"`{placeholder or action.dest}`"
    if names and placeholder:
        name += f" `{placeholder}`"
    written = "--out" in action.option_strings
    text = action.help or (
        "file or folder to write" if written else _NAMED[placeholder or action.dest]
    )
    text = " ".join(text.split())
    notes = []
    if action.choices is not None and action.option_strings:
        notes.append(f"one of {', '.join(f'`{c}`' for c in action.choices)}")
    usual = action.default
    if action.option_strings and usual not in (None, "", False, argparse.SUPPRESS) and usual:
        parts = usual if isinstance(usual, list | tuple) else [usual]
        values = (f"{part:.6g}" if isinstance(part, float) else str(part) for part in parts)
        notes.append(f"default `{','.join(values)}`")
    return f"| {_cell(name)} | {_cell('; '.join([text, *notes]))} |"


def parameters() -> str:
    """Return the parameters of each node, as its file in ``config/`` explains them."""
    lines = [
        "# Parameters of the nodes",
        "",
        "Each file in `config/` has every parameter of a node.",
    ]
    for path in sorted((ROOT / "config").glob("*.yaml")):
        text = path.read_text(encoding="utf-8")
        content = yaml.safe_load(text)
        if not any(isinstance(v, dict) and "ros__parameters" in v for v in content.values()):
            continue
        lines += ["", f"## {path.stem}", "", "```yaml", text.rstrip(), "```"]
    return "\n".join(lines) + "\n"


def messages() -> str:
    """Return the definitions of the messages and services of ``omsm_msgs``."""
    lines = [
        "# Messages and services",
        "",
        "Messages are in `omsm_msgs/msg`, services in `omsm_msgs/srv`.",
    ]
    for path in sorted((ROOT / "msg_defs").glob("*/*.*")):
        if path.suffix in (".msg", ".srv"):
            text = path.read_text(encoding="utf-8").rstrip()
            lines += ["", f"## {path.stem}", "", "```text", text, "```"]
    return "\n".join(lines) + "\n"


def ranges() -> str:
    """Return the table of quantities from outside, each with its unit and range."""
    lines = [
        "# Quantities",
        "",
        "Values from outside (messages, files, arguments) are checked against this table. "
        "A value out of its range is refused:",
        "",
        "```text",
        "omsm: argument --accuracy: allowed error is 20.0 m, expected a number from 1e-15 to "
        "1 m; give it in metres, k = 2",
        "```",
        "",
        "| quantity | unit | plausible range | remedy |",
        "|---|---|---|---|",
    ]
    known = {q for q in vars(quantities).values() if isinstance(q, quantities.Quantity)}
    for one in sorted(known, key=lambda q: (q.name, q.unit, q.low, q.high)):
        cells = (one.name, one.unit or "1", one.range_text, one.remedy)
        lines.append(f"| {' | '.join(_cell(c) for c in cells)} |")
    return "\n".join(lines) + "\n"


def _cell(text: str) -> str:
    return re.sub(r"\s+", " ", text).replace("|", "\\|")
