"""Command lines whose words are right or anything."""

from __future__ import annotations

import json

from hostile.inputs import NUMBERS, TEXTS, VALUES
from hostile.judge import Case
from hypothesis import strategies as st

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
_FLAGS = {
    "inspect": ["--repair", "--namespace", "--topics"],
    "import": ["--map", "--out"],
    "predict": ["--calibration", "--budget", "--limits"],
    "correct": [
        "--calibration", "--out", "--nominal", "--geometry", "--probe-latency", "--sources",
        "--lateral", "--settings", "--by-stamps", "--delay", "--exposure", "--polarity",
        "--override", "--counter-offset", "--stamp-tolerance", "--fit", "--aperture",
        "--tolerance", "--accuracy", "--pitch", "--namespace", "--topics",
    ],
    "form": [
        "--nominal", "--out", "--calibration", "--unit", "--fit", "--aperture", "--s-filter",
        "--l-filter",
    ],
    "compensate": ["--nominal", "--low-pass", "--out", "--unit", "--fit", "--aperture"],
    "difference": [
        "--out", "--fit", "--nominal", "--register", "--uncertainty", "--drift", "--unit",
        "--spacing", "--correlation-length",
    ],
    "surface": ["--radius", "--feed", "--rpm", "--limits", "--probe-angle"],
    "export": ["--out", "--unit", "--spacing"],
    "spectrum": [
        "--calibration", "--out", "--nominal", "--settings", "--polarity", "--no-report",
        "--override",
    ],
    "calset": ["--out"],
    "history": ["--machine", "--add", "--catalogue"],
    "reversal": ["--calibration", "--out"],
    "align": ["--calibration", "--radius", "--geometry", "--out"],
    "plan": [
        "--out", "--sample-period", "--step", "--count", "--dwell", "--rise", "--half-range",
        "--second-step",
    ],
    "verify": ["--calibration"],
    "compare": [],
    "validate": ["--input", "--output", "--out"],
    "selfcal": [
        "--calibration", "--out", "--harmonics", "--clocking", "--polarity", "--static-gain",
        "--gain-uncertainty", "--settings",
    ],
    "latency": ["--delay", "--uncertainty", "--reason", "--out"],
}  # fmt: skip
_FIRST = {
    "plan": ("steps",), "compare": ("cal.json", "cal.json"), "latency": ("cal.json",),
    "validate": ("model.json", "motion.csv"), "reversal": ("scan.mcap", "scan.mcap"),
    "selfcal": ("scan.mcap", "scan.mcap"), "difference": ("good.xyz", "good.ply"),
    "surface": ("show", "surface.yaml"), "form": ("good.xyz",), "compensate": ("good.xyz",),
    "export": ("good.xyz",), "import": ("log.csv",), "history": (),
    "calset": ("cal.json@x=0.0", "cal.json@x=0.01"),
}  # fmt: skip
_SWITCHES = {"--by-stamps", "--override", "--repair", "--no-report"}
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
}
_FILES = {
    "--calibration", "--nominal", "--geometry", "--limits", "--sources", "--pitch", "--map",
    "--add",
}  # fmt: skip
_FREEDOMS = st.sampled_from(
    ["auto", "piston", "piston,tip,tilt", "x,y,clocking,power", "power,power", ",", "all", "x,"]
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
    "--catalogue": st.sampled_from([
        "catalogue.sqlite", "pipe", "folder", "cal.json", "nosuch://host/db", "sqlite://",
        "postgresql://", "://", "n" * 5000, "a\0b", "/dev/full", "sqlite:///folder/x.sqlite",
    ]),
}  # fmt: skip


@st.composite
def arguments(draw: st.DrawFn) -> Case:
    """A command line whose words are right or anything."""
    command = draw(st.sampled_from(sorted(_FLAGS)))
    words = [command]
    for good in _FIRST.get(command, ("scan.mcap",)):
        words.append(draw(st.one_of(st.just(good), PATHS)))
    flags = _FLAGS[command]
    needed = [flag for flag in flags if flag in _NEEDED.get(command, _GOOD)]
    others = draw(st.lists(st.sampled_from(flags or ["--json"]), max_size=3))
    for flag in dict.fromkeys([*needed, *others]):
        words.append(flag)
        if flag not in _SWITCHES and flag != "--json":
            usual = flag in needed and draw(st.integers(0, 3))
            words.append(_usual(command, flag) if usual else draw(_value_of(flag)))
    if draw(st.integers(0, 9)) == 0:
        words.insert(draw(st.integers(0, len(words))), draw(TEXTS))
    if command == "correct":
        words.append("--no-report")
    return Case((*words, "--json"))


def _usual(command: str, flag: str) -> str:
    if flag == "--out" and command == "export":
        return "e.xyz"
    return _GOOD[flag]


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


def _value_of(flag: str) -> st.SearchStrategy[str]:
    if flag in _OTHERS:
        return _OTHERS[flag]
    if flag in _FILES:
        return PATHS if flag != "--sources" else st.one_of(PATHS, SETTINGS)
    if flag == "--settings":
        return SETTINGS
    return st.one_of(NUMBERS.map(str), NUMBERS.map(repr), TEXTS)
