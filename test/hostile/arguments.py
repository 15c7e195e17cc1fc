"""Command lines whose words are right or anything."""

from __future__ import annotations

import argparse
import json
import re

from hostile.inputs import NUMBERS, TEXTS, VALUES
from hostile.judge import Case
from hypothesis import strategies as st

from omsm_ros.cli.command_line import parser_of

PATHS = st.sampled_from([
    "scan.mcap", "cal.json", "surface.yaml", "geometry.yaml", "motion.csv", "missing", "pipe",
    "pipe.mcap", "folder", "folder/x", "/dev/zero", "/dev/full", "/dev/null", "zero.mcap",
    "n" * 300, "n" * 300 + ".mcap", "n" * 5000, "", ".", "..", "/", "a\0b", "\udcff", "cal.json/x",
    "/proc/self/mem", "/etc/passwd", "loop", "--", "-x", "%s%n", "good.xyz", "good.ply",
    "sources.yaml", "map.yaml", "log.csv", "set.json", "sealed",
])  # fmt: skip
# Where results may be written: nothing that belongs to the machine or to other cases.
OUTS = st.sampled_from([
    "out", "folder/x", "/dev/full", "/dev/null", "pipe", "pipe.mcap", "n" * 300, "n" * 5000, "",
    "a\0b", "\udcff", "cal.json/x", "loop/x", "out/a/b", "--", "-x", "%s%n", "e.xyz", "e.x3p",
    "e.dat", "e.h5", "e.ply", "/proc/x/y", "folder",
])  # fmt: skip
# Commands that neither run a cell nor a whole campaign.
_COMMANDS = (
    "inspect", "import", "plan", "identify", "verify", "compare", "calset", "selfcal", "reversal",
    "latency", "surface", "predict", "align", "sources", "correct", "adjust", "form", "compensate",
    "difference", "spectrum", "export", "history", "validate",
)  # fmt: skip
_PARSERS = next(
    action.choices
    for action in parser_of(_COMMANDS)._actions
    if isinstance(action, argparse._SubParsersAction)
)
_OPTIONS = {
    command: {
        action.option_strings[-1]: action
        for action in _PARSERS[command]._actions
        if action.option_strings and action.dest not in ("help", "json")
    }
    for command in _COMMANDS
}
_FIRST = {
    "plan": ("steps|multisine|scans|motion",), "sources": ("probe|still", "scan.mcap"),
    "identify": ("steps.mcap",), "adjust": ("scan.mcap", "scan.mcap"),
    "compare": ("cal.json", "cal.json"), "latency": ("cal.json",),
    "validate": ("model.json", "motion.csv"), "reversal": ("scan.mcap", "scan.mcap"),
    "selfcal": ("scan.mcap", "scan.mcap"), "difference": ("good.xyz", "good.ply"),
    "surface": ("show", "surface.yaml"), "form": ("good.xyz",), "compensate": ("good.xyz",),
    "export": ("good.xyz",), "import": ("log.csv",), "history": (),
    "calset": ("cal.json@x=0.0", "cal.json@x=0.01"),
}  # fmt: skip
_GOOD = {
    "--calibration": "cal.json",
    "--out": "out",
    "--radius": "0.003",
    "--delay": "1e-4",
    "--uncertainty": "1e-5",
    "--reason": "datasheet",
    "--nominal": "surface.yaml",
    "--low-pass": "1e-3",
    "--unit": "m",
    "--map": "map.yaml",
    "--catalogue": "catalogue.sqlite",
}
_NEEDED = {
    "export": {"--out", "--unit"},
    "difference": {"--out", "--unit"},
    "correct": {"--out", "--calibration"},
    "spectrum": {"--out"},
    "plan": {"--out"},
}
_FREEDOMS = st.sampled_from(
    ["auto", "piston", "piston,tip,tilt", "x,y,clocking,power", "power,power", ",", "all", "x,"]
)
_SETTING_NAMES = st.sampled_from(
    ["probe_noise", "pitch", "machine", "static_gain", "table_mass_kg", "lag_is_latency"]
)
SETTINGS = st.one_of(
    st.dictionaries(st.one_of(_SETTING_NAMES, TEXTS), VALUES, max_size=3).map(json.dumps),
    st.tuples(_SETTING_NAMES, NUMBERS).map(lambda pair: json.dumps(dict([pair]))),
    VALUES.map(json.dumps),
    TEXTS,
    st.just("[" * 5000),
)
_OTHERS = {
    "--fit": _FREEDOMS,
    "--register": _FREEDOMS,
    "--aperture": st.one_of(
        st.sampled_from(["0.002", "0.002,0,0", "1e-9", "0.002,1,1", "1,2", ",,", "1e300"]),
        NUMBERS.map(str),
    ),
    "--unit": st.sampled_from(["mm", "mm,nm", "m", "furlong", "mm,", ",", "mm,nm,m", "\0"]),
    "--topics": st.sampled_from(["axes=/a", "axes", "axes=", "=/a", "x=/y", "axes=/omsm/axes"]),
    "--namespace": st.sampled_from(["/cell", "cell", "/", "//", "/omsm"]),
    "--polarity": st.sampled_from(["1", "-1", "0", "2", "x"]),
    "--out": OUTS,
    "--report": OUTS,
    "--plot": OUTS,
    "--settings": SETTINGS,
    "--sources": st.one_of(PATHS, SETTINGS),
    "--origin": st.one_of(PATHS, SETTINGS),
    "--catalogue": st.sampled_from([
        "catalogue.sqlite", "pipe", "folder", "cal.json", "nosuch://host/db", "sqlite://",
        "postgresql://", "://", "n" * 5000, "a\0b", "/dev/full", "sqlite:///folder/x.sqlite",
    ]),
}  # fmt: skip


@st.composite
def arguments(draw: st.DrawFn) -> Case:
    """A command line whose words are right or anything."""
    command = draw(st.sampled_from(_COMMANDS))
    words = [command]
    for good in _FIRST.get(command, ("scan.mcap",)):
        words.append(draw(st.one_of(st.sampled_from(good.split("|")), PATHS)))
    options = _OPTIONS[command]
    needed = [flag for flag in options if flag in _NEEDED.get(command, _GOOD)]
    others = draw(st.lists(st.sampled_from(sorted(options) or ["--json"]), max_size=3))
    for flag in dict.fromkeys([*needed, *others]):
        words.append(flag)
        for _ in range(draw(_count_of(options.get(flag)))):
            usual = flag in needed and draw(st.integers(0, 3))
            words.append(_usual(command, flag) if usual else draw(_value_of(options[flag])))
    if draw(st.integers(0, 9)) == 0:
        words.insert(draw(st.integers(0, len(words))), draw(TEXTS))
    if command == "correct":
        words.append("--no-report")
    return Case((*words, "--json"))


def _count_of(option: argparse.Action | None) -> st.SearchStrategy[int]:
    """Number of values of an option: a flag has none."""
    if option is None or isinstance(option.nargs, int):
        return st.just(option.nargs if option else 0)
    return st.integers(1, 3) if option.nargs in ("+", "*") else st.just(1)


def _usual(command: str, flag: str) -> str:
    if flag == "--out" and command == "export":
        return "e.xyz"
    return _GOOD[flag]


def _value_of(option: argparse.Action) -> st.SearchStrategy[str]:
    if (flag := option.option_strings[-1]) in _OTHERS:
        return _OTHERS[flag]
    if option.choices:
        return st.one_of(st.sampled_from([*map(str, option.choices)]), TEXTS)
    if isinstance(option.metavar, str) and re.search(r"\.|^(BAG|SCAN|FILE)$", option.metavar):
        return PATHS
    return st.one_of(NUMBERS.map(str), NUMBERS.map(repr), TEXTS)
