"""Commands on the pages of the manual, in blocks and in the text, with file names filled in.

Sybil extracts blocks, too, but no commands in the text, and its blocks do not share a shell.
"""

import functools
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
    """One command, or a block of commands, on a page; ``text`` is as printed."""

    page: str
    line: int
    text: str
    block: bool

    def __str__(self):
        return f"{self.page}:{self.line}"


def shown_on(path):
    """Return blocks with commands, and commands in the text, from top to bottom."""
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
    """Yield the commands of a block without remarks and without the content of here-documents."""
    held = None
    for line in shown.text.splitlines():
        if held is None and line.strip():
            yield re.split(r"\s#\s", line)[0].strip()
            begun = re.search(r"<<'(\w+)'", line)
            held = begun and begun[1]
        elif line.strip() == held:
            held = None


# File or value for each placeholder in capitals; by command where that differs.
STANDS_FOR = {
    "BAG": "scan.mcap", "SCAN": "scan.mcap", "MOTION": "scan.mcap", "FOLDER": "recordings",
    "CW": "CW.mcap", "CCW": "CCW.mcap", "CLOUD": "result/cloud.ply",
    "POINTS": "result/cloud.ply", "CAL.json": "cal.json", "STEP.json": "cal.json",
    "OLD.json": "cal1.json", "NEW.json": "cal2.json", "MORE.json": "cal3.json",
    "SURFACE.yaml": "mirror.yaml", "RECORD.csv": "record.csv", "MODEL.json": "model.json",
    "SOURCES.yaml": "machine.yaml", "R": "0.001", "W": "0.0003", "NAME": "twin",
    "FILE.png": "made.png", "FROM": "310", "TO": "330", "R,X,Y": "0.0009,0,0",
    "OPTION": "--no-report", "mirror|steps|chirp|circles|vibration": "steps",
    "APERTURE": "0.0009", "S.yaml": "mirror.yaml", "M.yaml": "machine.yaml", "U": "20e-9",
}  # fmt: skip
IN_COMMAND = {
    "demo": {"NAME": "steps"},
    "spectrum": {"S": "0.001", "M": "1.8e-6"},
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
    """Return a command with its placeholders filled in and its optional parts included."""
    word = command.split()[1]
    scans = iter(("scan.mcap", "fast.mcap", "fast.mcap"))
    names = STANDS_FOR | IN_COMMAND.get(word, {})
    words = []
    for token in re.sub(r"\.\.\.|[\[\]…]", " ", command).split():
        if words and words[-1] == "--out" and token.isupper():
            words.append(_ENDINGS[token])
        elif words and words[-1] == "--out" and token[0].isupper():
            words.append("made" + Path(token).suffix)
        elif token == "SCAN" and word in ("selfcal", "spectrum", "adjust"):
            words.append(next(scans))
        else:
            head, at, place = token.partition("@")
            words.append(names.get(head, head) + at + place)
    return " ".join(words)


@functools.cache
def parser():
    """Return the parser of all commands."""
    return parser_of(WORDS)


def is_name(command):
    """Return whether code in the text only names a command or an option, and is not to be run."""
    program, word, *rest = command.split()
    if program == "ros2":
        return len(rest) <= 1 and command != "ros2 lifecycle nodes"
    if program != "omsm" or word not in WORDS:
        return False
    try:
        parser().parse_args(filled_in(command).split(" > ")[0].split()[1:])
    except OmsmError:
        options = [r for r in rest if r.startswith("--")]
        return len(rest) <= 3 and len(options) <= 1
    return False
