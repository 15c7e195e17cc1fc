"""Every way into the offline commands, each with a strategy of what may come through it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from hostile import bag_inputs, inputs, maps, shop, trees
from hostile.arguments import SETTINGS, arguments
from hostile.judge import Case
from hypothesis import strategies as st

from omsm_ros.io.files import SUMMARY

Cases = st.SearchStrategy[Callable[[], Case]]
Strategy = Callable[[Path, Any], Cases]

_CORRECT = ("correct", "scan.mcap", "--calibration", "cal.json", "--out", "out", "--no-report")
_ON_SURFACE = ("--nominal", "surface.yaml")
_ON_MIRROR = (*_ON_SURFACE, "--unit", "mm", "--out", "out")


def _with(commands: list[tuple[str, ...]], files: st.SearchStrategy[tuple[str, bytes]]) -> Cases:
    """One of the commands with a file, whose name stands where the command has ``{}``."""
    return st.builds(
        lambda words, file: lambda: _case(words, *file), st.sampled_from(commands), files
    )


def _named(name: str, texts: st.SearchStrategy[bytes]) -> st.SearchStrategy[tuple[str, bytes]]:
    return texts.map(lambda text: (name, text))


def _good(place: Path, names: tuple[str, ...]) -> Mapping[str, bytes]:
    return {name: (place / name).read_bytes() for name in names}


def through_arguments(place: Path, blocks: Any) -> Cases:
    return arguments().map(lambda case: lambda: case)


# Calibrations, models.


def through_calibrations(place: Path, blocks: Any) -> Cases:
    content = json.loads((place / "cal.json").read_text())
    content["covariance"] = [1e-30 if k % 8 == 0 else 0.0 for k in range(49)]
    content["certificate"] |= {"residual": {"noise_m": 1e-8}, "static_gain": {"polarity": 1}}
    correct = ("correct", "scan.mcap", "--calibration", "{}", "--out", "out", "--no-report")
    commands = [
        ("predict", "motion.csv", "--calibration", "{}"),
        correct,
        (*correct, "--override"),
        ("compare", "cal.json", "{}"),
        ("compare", "{}", "{}", "cal.json"),
        ("verify", "scan.mcap", "--calibration", "{}"),
        ("calset", "cal.json@x=0", "{}@x=0.01", "--out", "new.json"),
        ("spectrum", "scan.mcap", "--calibration", "{}", "--out", "out", "--no-report"),
        ("history", "--catalogue", "new.sqlite", "--add", "{}"),
    ]
    return _with(commands, _named("bad.json", inputs.calibration_texts(content)))


def through_sets(place: Path, blocks: Any) -> Cases:
    content = json.loads((place / "set.json").read_text())
    commands = [
        ("predict", "motion.csv", "--calibration", "{}"),
        ("correct", "scan.mcap", "--calibration", "{}", "--out", "out", "--no-report"),
    ]
    return _with(commands, _named("bad.json", trees.changed_calibrations(content)))


def through_models(place: Path, blocks: Any) -> Cases:
    words = ("validate", "{}", "motion.csv", "--input", "time_s", "--output", "z_m")
    texts = inputs.model_texts(json.loads((place / "model.json").read_text()))
    return _with([(*words, "--out", "run.csv")], _named("bad.json", texts))


# Descriptions and settings.

_DESCRIBED: tuple[tuple[tuple[dict[str, Any], ...], list[tuple[str, ...]]], ...] = (
    (
        trees.SURFACES,
        [
            ("surface", "show", "{}", "--radius", "0.002"),
            ("form", "good.xyz", "--nominal", "{}", "--unit", "mm", "--out", "out"),
            (*_CORRECT, "--nominal", "{}"),
            ("compensate", "good.csv", "--nominal", "{}", "--low-pass", "4e-3", "--out", "out",
             "--fit", "piston,tip,tilt"),
        ],
    ),
    (
        (trees.SOURCES,),
        [(*_CORRECT, "--sources", "{}"), (*_CORRECT, *_ON_SURFACE, "--sources", "{}")],
    ),
    (
        (trees.LIMITS,),
        [
            ("predict", "motion.csv", "--calibration", "cal.json", "--limits", "{}"),
            ("surface", "show", "surface.yaml", "--radius", "0.002", "--limits", "{}"),
        ],
    ),
    ((trees.GEOMETRY,), [(*_CORRECT, "--geometry", "{}")]),
    ((trees.COLUMNS,), [("import", "log.csv", "--map", "{}", "--out", "new.mcap")]),
)  # fmt: skip


def through_yaml(place: Path, blocks: Any) -> Cases:
    texts = _named("bad.yaml", inputs.YAML_TEXTS)
    return _with([words for _, commands in _DESCRIBED for words in commands], texts)


def through_descriptions(place: Path, blocks: Any) -> Cases:
    return st.sampled_from(_DESCRIBED).flatmap(
        lambda kind: _with(kind[1], _named("bad.yaml", trees.changed_texts(*kind[0])))
    )


def through_settings(place: Path, blocks: Any) -> Cases:
    words = ("identify", "steps.mcap", "--out", "new.json", "--order", "2", "--duration", "2.5")
    return SETTINGS.map(lambda text: lambda: Case((*words, "--settings", text, "--json")))


# Tables, maps.


def through_csv(place: Path, blocks: Any) -> Cases:
    commands = [
        ("predict", "{}", "--calibration", "cal.json"),
        ("predict", "{}", "--calibration", "cal.json"),
        ("identify", "{}", "--input", "time_s", "--output", "z_m", "--period", "1e-3",
         "--order", "2", "--out", "new.json"),
        (*_CORRECT, "--geometry", "arm.yaml", "--pitch", "{}"),
    ]  # fmt: skip
    return _with(commands, _named("bad.csv", inputs.motion_texts()))


def through_tables(place: Path, blocks: Any) -> Cases:
    words = ("import", "{}", "--map", "map.yaml", "--out", "new.mcap")
    return _with([words], maps.damaged_tables(_good(place, maps.TABLES)))


_RECORD = ("--input", "time_s", "--output", "z_m")
_SHOP_TABLES = {
    "motion.csv": [
        ("predict", "{}", "--calibration", "cal.json"),
        ("validate", "model.json", "{}", *_RECORD),
        ("identify", "{}", *_RECORD, "--period", "1e-3", "--order", "1", "--out", "new.json"),
    ],
    "pitch.csv": [(*_CORRECT, "--geometry", "arm.yaml", "--pitch", "{}")],
    "log.csv": [("import", "{}", "--map", "map.yaml", "--out", "new.mcap")],
    "good.csv": [
        ("export", "{}", "--out", "e.ply"),
        ("form", "{}", *_ON_SURFACE, "--out", "out", "--fit", "piston,tip,tilt"),
        ("difference", "good.csv", "{}", "--out", "out"),
    ],
    "good.xyz": [("export", "{}", "--unit", "mm", "--out", "e.csv")],
}


def through_shop_tables(place: Path, blocks: Any) -> Cases:
    """Tables and texts of points as other programs and careless hands write them."""

    def of(name: str) -> Cases:
        mark = None if name.endswith("xyz") else ","
        good = (place / name).read_bytes()
        return _with(_SHOP_TABLES[name], _named("bad.csv", shop.texts(good, mark)))

    return st.sampled_from(sorted(_SHOP_TABLES)).flatmap(of)


_ON_MAPS = [
    ("export", "{}", "--unit", "mm", "--out", "e.xyz"),
    ("export", "{}", "--unit", "mm", "--out", "e.x3p"),
    ("export", "{}", "--unit", "mm", "--out", "e.dat"),
    ("form", "{}", *_ON_MIRROR),
    ("form", "{}", *_ON_MIRROR, "--fit", "piston,tip,tilt"),
    ("compensate", "{}", *_ON_MIRROR, "--low-pass", "4e-3"),
    ("difference", "good.xyz", "{}", "--unit", "mm", "--out", "out"),
]


def through_maps(place: Path, blocks: Any) -> Cases:
    return _with(_ON_MAPS, maps.damaged_maps(_good(place, maps.FORMATS)))


# A second of a scan is an arc, which does not tell how the part is tilted.
_ON_ARC = (*_ON_SURFACE, "--fit", "piston", "--out", "out")
_ON_RESULTS = [
    ("form", "bad", *_ON_ARC),
    ("compensate", "bad", *_ON_ARC, "--low-pass", "2e-3"),
    ("difference", "result", "bad", "--out", "out"),
    ("export", "bad", "--out", "e.csv"),
    ("history", "--catalogue", "new.sqlite", "--add", "bad"),
    ("report", "bad", "--calibration", "cal.json", *_ON_SURFACE),
]


def through_results(place: Path, blocks: Any) -> Cases:
    """Files of a result folder of ours, damaged."""
    files = ("cloud.ply", "systematic.npz", "summary.json")
    good = {name: (place / "result" / name).read_bytes() for name in files}
    return st.builds(
        lambda words, change: (
            lambda: Case(
                (*words, "--json"),
                {f"bad/{n}": raw for n, raw in {**good, **dict([change])}.items()},
            )
        ),
        st.sampled_from(_ON_RESULTS),
        st.sampled_from(files).flatmap(
            lambda name: st.tuples(
                st.just(name),
                st.one_of(
                    inputs.damaged(good[name]),
                    maps.renumbered(good[name], 4000),
                    *([maps.repacked(good[name])] if name.endswith(".npz") else []),
                    *([trees.changed_texts(json.loads(good[name]))] if name == SUMMARY else []),
                ),
            )
        ),
    )


def through_catalogues(place: Path, blocks: Any) -> Cases:
    good = (place / "catalogue.sqlite").read_bytes()
    commands = [
        ("history", "--catalogue", "{}"),
        ("history", "--catalogue", "{}", "--add", "cal.json"),
    ]
    return _with(commands, _named("bad.sqlite", inputs.damaged(good)))


# Bags.

_ON_BAGS = [
    ("inspect", "{}"),
    ("inspect", "{}", "--repair"),
    ("correct", "{}", "--calibration", "cal.json", "--out", "out", "--no-report"),
    ("correct", "{}", "--calibration", "cal.json", "--out", "out", "--no-report", "--by-stamps"),
    ("correct", "{}", "--calibration", "cal.json", "--out", "out", "--no-report", "--override"),
    ("correct", "{}", "--calibration", "cal.json", "--out", "out", "--no-report", "--fit", "auto",
     "--nominal", "surface.yaml", "--tolerance", "1e-6"),
    ("predict", "{}", "--calibration", "cal.json"),
    ("verify", "{}", "--calibration", "cal.json"),
    ("identify", "{}", "--out", "new.json", "--order", "2"),
    ("align", "{}", "--calibration", "cal.json", "--radius", "0.1", "--out", "g.yaml"),
    ("spectrum", "{}", "--out", "out", "--no-report"),
    ("spectrum", "{}", "scan.mcap", "--calibration", "cal.json", "--out", "out", "--no-report"),
    ("selfcal", "scan.mcap", "{}", "--out", "new.json"),
]  # fmt: skip


def through_messages(place: Path, blocks: Any) -> Cases:
    return _through_bags(place, bag_inputs.hostile_bags(blocks))


def through_streams(place: Path, blocks: Any) -> Cases:
    """Bags that are wrong from end to end."""
    return _through_bags(place, shop.streams(blocks))


def _through_bags(place: Path, bags: st.SearchStrategy[Any]) -> Cases:
    return st.builds(
        lambda words, how: (
            lambda: Case(
                (*(w.replace("{}", bag_inputs.write_bag(place, how)) for w in words), "--json")
            )
        ),
        st.sampled_from(_ON_BAGS),
        bags,
    )


def through_bag_files(place: Path, blocks: Any) -> Cases:
    names = st.sampled_from(["bad.mcap"] * 6 + ["bad.db3", "bad.bin"])
    raw = bag_inputs.damaged_files((place / "scan.mcap").read_bytes())
    return _with(_ON_BAGS, st.tuples(names, raw))


def _without_unit(words: tuple[str, ...]) -> tuple[str, ...]:
    at = words.index("--unit")
    return words[:at] + words[at + 2 :]


def right_cases(place: Path) -> Iterator[Case]:
    """Each command that the doors use on files that are written here, with right ones."""
    for wholes, commands in _DESCRIBED:
        for number, words in enumerate(commands):
            yield _case(words, "bad.yaml", json.dumps(wholes[-1 - number % len(wholes)]).encode())
    for words in _ON_MAPS:
        if words[0] != "difference":  # whose unit is of the other file
            words = _without_unit(words)
        yield _case(words, "bad.dat", (place / "good.dat").read_bytes())
    for name in maps.FORMATS:
        words = ("export", name, "--unit", "mm", "--out", "e.xyz", "--json")
        yield Case(_without_unit(words) if name in maps.SAY_METRES else words)
    for name in maps.TABLES[:2]:
        yield Case(("import", name, "--map", "map.yaml", "--out", f"{name}.mcap", "--json"))
    for words in (words for words in _ON_RESULTS if words[0] != "difference"):  # of an arc: none
        yield Case((*(word.replace("bad", "result") for word in words), "--json"))


def _case(words: tuple[str, ...], name: str, content: bytes) -> Case:
    return Case((*(word.replace("{}", name) for word in words), "--json"), {name: content})


DOORS: dict[Strategy, int] = {
    through_arguments: 8,
    through_calibrations: 4,
    through_sets: 2,
    through_models: 1,
    through_yaml: 2,
    through_descriptions: 6,
    through_settings: 1,
    through_csv: 1,
    through_tables: 2,
    through_shop_tables: 3,
    through_maps: 6,
    through_results: 3,
    through_catalogues: 1,
    through_messages: 4,
    through_streams: 3,
    through_bag_files: 3,
}
"""Doors, and the share of the cases that each is given."""
