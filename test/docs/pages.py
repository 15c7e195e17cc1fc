"""What pages show: blocks of commands, commands within the text, and what stands for what in them.

Sybil takes the blocks out of a page too, but neither commands within the text, nor lines of a block
one by one, nor a shell that they share; with it this file would be longer.
"""

import re
import textwrap
from dataclasses import dataclass
from pathlib import Path

import omsm_ros
from omsm_ros.cli.command_line import parser_of
from omsm_ros.cli.words import WORDS
from omsm_ros.errors import OmsmError

ROOT = Path(omsm_ros.__file__).resolve().parent.parent
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "docs" / "howto").glob("*.md")),
]
BLOCKS = re.compile(r"^ *```(\w*)\n(.*?)^ *```", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"`([^`]+)`")
PROGRAMS = (
    *("omsm", "ros2", "make", "git", "cd", "rosdep", "colcon", "pip", "export", "dask", "."),
    *("python -m", "mkdir", "cp", "printf", "cat"),
)
_COMMAND = re.compile(rf"(?:{'|'.join(re.escape(p) for p in PROGRAMS)}) ")


@dataclass(frozen=True)
class Shown:
    """One command, or block of them, on a page; ``text`` is as it stands there."""

    page: str
    line: int
    text: str
    block: bool

    def __str__(self):
        return f"{self.page}:{self.line}"


def shown_on(path):
    """Blocks that hold commands, and commands in the text, from top to bottom."""
    text, page = path.read_text(encoding="utf-8"), path.relative_to(ROOT).as_posix()
    found = []
    for match in BLOCKS.finditer(text):
        block = textwrap.dedent(match[2]).replace("\\\n", " ")
        if match[1] in ("", "sh", "text") and _COMMAND.match(block):
            found.append(Shown(page, text.count("\n", 0, match.start()) + 1, block, True))
    rest = BLOCKS.sub(lambda match: "\n" * match[0].count("\n"), text)
    for match in INLINE.finditer(rest):
        command = " ".join(match[1].replace("\\|", "|").split())
        if _COMMAND.match(command):
            found.append(Shown(page, rest.count("\n", 0, match.start()) + 1, command, False))
    return sorted(found, key=lambda shown: shown.line)


def lines_of(shown):
    """The commands of a block, one a line, without remarks; what a here-document holds is none."""
    held = None
    for line in shown.text.splitlines():
        if held is None and line.strip():
            yield re.split(r"\s#\s", line)[0].strip()
            begun = re.search(r"<<'(\w+)'", line)
            held = begun and begun[1]
        elif line.strip() == held:
            held = None


# What a command's form in capitals stands for; by command where that differs.
STANDS_FOR = {
    "BAG": "scan.mcap", "SCAN": "scan.mcap", "MOTION": "scan.mcap", "FOLDER": "recordings",
    "CW": "CW.mcap", "CCW": "CCW.mcap", "CLOUD": "result/cloud.ply",
    "POINTS": "result/cloud.ply", "CAL.json": "cal.json", "STEP.json": "cal.json",
    "OLD.json": "cal1.json", "NEW.json": "cal2.json", "MORE.json": "cal3.json",
    "SURFACE.yaml": "mirror.yaml", "RECORD.csv": "record.csv", "MODEL.json": "model.json",
    "SOURCES.yaml": "machine.yaml", "R": "0.001", "W": "0.0003", "NAME": "twin",
    "FILE.png": "made.png", "FROM": "310", "TO": "330", "R,X,Y": "0.0009,0,0",
    "OPTION": "--no-report", "chirp|circles|vibration|mirror": "circles",
}  # fmt: skip
IN_COMMAND = {
    "identify": {"BAG": "steps.mcap"},
    "verify": {"BAG": "chirp.mcap"},
    "align": {"BAG": "sphere.mcap", "R": "0.05"},
    "import": {"FILE": "steps.csv", "MAP.yaml": "map.yaml"},
    "inspect": {"BAG": "scan.mcap"},
    "report": {"DIR": "result"},
    "difference": {"A": "result", "B": "old_result"},
    "selfcal": {"A": "scan.mcap", "B": "fast.mcap"},
    "latency": {"S": "5e-6", "TEXT": "'external trigger'"},
    "compare": {"FILE": "cal1.json"},
}
_ENDINGS = {"DIR": "made", "BAG": "made.mcap", "FILE": "made.xyz", "GEO.yaml": "made.yaml"}


def filled_in(command):
    """A command with names of files where it shows what stands for them; optional parts given."""
    word = command.split()[1]
    scans = iter(("scan.mcap", "fast.mcap", "fast.mcap"))
    names = STANDS_FOR | IN_COMMAND.get(word, {})
    words = []
    for token in re.sub(r"\.\.\.|[\[\]…]", " ", command).split():
        if words and words[-1] == "--out" and token.isupper():
            words.append(_ENDINGS[token])
        elif words and words[-1] == "--out" and token[0].isupper():
            words.append("made" + Path(token).suffix)
        elif token == "SCAN" and word in ("selfcal", "spectrum"):
            words.append(next(scans))
        else:
            head, at, place = token.partition("@")
            words.append(names.get(head, head) + at + place)
    return " ".join(words)


def is_name(command):
    """Whether code in the text names a command or an option of it, and is nothing to be typed."""
    program, word, *rest = command.split()
    if program == "ros2":
        return len(rest) <= 1 and command != "ros2 lifecycle nodes"
    if program != "omsm" or word not in WORDS:
        return False
    try:
        parser_of([word]).parse_args(filled_in(command).split(" > ")[0].split()[1:])
    except OmsmError:
        options = [r for r in rest if r.startswith("--")]
        return len(rest) <= 3 and len(options) <= 1
    return False
