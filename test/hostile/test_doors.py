"""Whatever comes through a door is refused in one line that helps, or answered rightly.

A sample of each door's cases runs with all tests, always the same; ``make soak`` runs many
thousand others.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hostile import bag_inputs, inputs
from hostile.judge import Answer, Case, ask, ask_process, judge
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from omsm_ros.core.dynamics.transfer_function import TransferFunction
from omsm_ros.core.machine.kinematics import Geometry
from omsm_ros.core.sampled.model import Discrete, SampledModel
from omsm_ros.storage.calibration_file import save_calibration
from omsm_ros.storage.machine_files import save_geometry
from omsm_ros.storage.model_file import save_model
from omsm_ros.storage.recording.bag_writer import BagWriter
from omsm_ros.twin.cell import blocks_of

MODEL = SampledModel(
    hold="zero-order",
    sample_period=1e-3,
    discrete=Discrete(
        numerator=np.array([0.0, 0.3, 0.1]),
        denominator=np.array([1.0, -1.2, 0.5]),
        delay=1,
        covariance=1e-6 * np.eye(5),
    ),
    continuous=TransferFunction.from_ascending([1.3, 1e-4], [1.0, 2e-3, 1e-6]),
    covariance=None,
    valid_from=1.0,
    valid_up_to=100.0,
    working_point=(0.0, 0.0),
    certificate={"verdict": "accepted"},
)
CASES = int(os.environ.get("OMSM_HOSTILE_CASES", "12000"))
BLOCKS = 12


@pytest.fixture(scope="module")
def place(tmp_path_factory, small_scan_blocks, step_test, true_calibration) -> Path:
    """A folder with one good file of each kind, and some that are none."""
    folder = tmp_path_factory.mktemp("hostile")
    for name, blocks in (("scan", small_scan_blocks[:BLOCKS]), ("steps", blocks_of(step_test))):
        with BagWriter(folder / f"{name}.mcap", bag_inputs.TOPICS) as bag:
            for axes, distance in blocks:
                bag.write_axes(axes)
                bag.write_distance(distance)
    save_calibration(folder / "cal.json", true_calibration)
    save_geometry(folder / "geometry.yaml", Geometry(centre_x=1e-6))
    save_model(folder / "model.json", MODEL)
    (folder / "surface.yaml").write_text("shape: sphere\nradius: -0.1\n")
    (folder / "motion.csv").write_text(
        "\n".join(["time_s,z_m", *(f"{k / 1000},{k % 100 * 1e-7}" for k in range(600))])
    )
    (folder / "folder").mkdir()
    for name in ("pipe", "pipe.mcap"):
        os.mkfifo(folder / name)
    (folder / "zero.mcap").symlink_to("/dev/zero")
    (folder / "loop").symlink_to("loop")
    return folder


Strategy = Callable[[Path, Any], st.SearchStrategy[Callable[[], Case]]]


def through_arguments(place: Path, blocks: Any) -> st.SearchStrategy[Callable[[], Case]]:
    return inputs.arguments().map(lambda case: lambda: case)


def through_calibrations(place: Path, blocks: Any) -> st.SearchStrategy[Callable[[], Case]]:
    content = json.loads((place / "cal.json").read_text())
    content["covariance"] = [1e-30 if k % 8 == 0 else 0.0 for k in range(49)]
    content["certificate"] |= {"reasons": [], "noise_m": 1e-8, "polarity": 1}
    commands = st.sampled_from([
        ("predict", "motion.csv", "--calibration", "bad.json"),
        ("correct", "scan.mcap", "--calibration", "bad.json", "--out", "out", "--no-report"),
        ("correct", "scan.mcap", "--calibration", "bad.json", "--out", "out", "--no-report",
         "--override"),
        ("compare", "cal.json", "bad.json"),
        ("compare", "bad.json", "bad.json", "cal.json"),
        ("verify", "scan.mcap", "--calibration", "bad.json"),
    ])  # fmt: skip
    return st.builds(
        lambda words, text: lambda: Case((*words, "--json"), {"bad.json": text}),
        commands,
        inputs.calibration_texts(content),
    )


def through_models(place: Path, blocks: Any) -> st.SearchStrategy[Callable[[], Case]]:
    words = ("validate", "bad.json", "motion.csv", "--input", "time_s", "--output", "z_m")
    return inputs.model_texts(json.loads((place / "model.json").read_text())).map(
        lambda text: lambda: Case((*words, "--out", "run.csv", "--json"), {"bad.json": text})
    )


def through_yaml(place: Path, blocks: Any) -> st.SearchStrategy[Callable[[], Case]]:
    correct = ("correct", "scan.mcap", "--calibration", "cal.json", "--out", "out", "--no-report")
    predict = ("predict", "motion.csv", "--calibration", "cal.json")
    return st.builds(
        lambda words, text: lambda: Case((*words, "bad.yaml", "--json"), {"bad.yaml": text}),
        st.sampled_from(
            [(*correct, "--nominal"), (*correct, "--geometry"), (*predict, "--limits")]
        ),
        inputs.YAML_TEXTS,
    )


def through_settings(place: Path, blocks: Any) -> st.SearchStrategy[Callable[[], Case]]:
    words = ("identify", "steps.mcap", "--out", "new.json", "--order", "2", "--duration", "2.5")
    return inputs.SETTINGS.map(lambda text: lambda: Case((*words, "--settings", text, "--json")))


def through_csv(place: Path, blocks: Any) -> st.SearchStrategy[Callable[[], Case]]:
    words = st.sampled_from([
        ("predict", "bad.csv", "--calibration", "cal.json", "--json"),
        ("predict", "bad.csv", "--calibration", "cal.json", "--json"),
        ("identify", "bad.csv", "--input", "time_s", "--output", "z_m", "--period", "1e-3",
         "--order", "2", "--out", "new.json", "--json"),
    ])  # fmt: skip
    return st.builds(
        lambda words, text: lambda: Case(words, {"bad.csv": text}), words, inputs.motion_texts()
    )


_ON_BAGS = st.sampled_from([
    ("inspect", "{}", "--json"),
    ("correct", "{}", "--calibration", "cal.json", "--out", "out", "--no-report", "--json"),
    ("correct", "{}", "--calibration", "cal.json", "--out", "out", "--no-report", "--json",
     "--by-stamps"),
    ("correct", "{}", "--calibration", "cal.json", "--out", "out", "--no-report", "--json",
     "--override"),
    ("predict", "{}", "--calibration", "cal.json", "--json"),
    ("verify", "{}", "--calibration", "cal.json", "--json"),
    ("identify", "{}", "--out", "new.json", "--order", "2", "--json"),
    ("align", "{}", "--calibration", "cal.json", "--radius", "0.1", "--out", "g.yaml", "--json"),
])  # fmt: skip


def _on_bag(words: tuple[str, ...], name: str) -> tuple[str, ...]:
    return tuple(word.replace("{}", name) for word in words)


def through_messages(place: Path, blocks: Any) -> st.SearchStrategy[Callable[[], Case]]:
    return st.builds(
        lambda words, how: lambda: Case(_on_bag(words, bag_inputs.write_bag(place, how))),
        _ON_BAGS,
        bag_inputs.hostile_bags(blocks),
    )


def through_bag_files(place: Path, blocks: Any) -> st.SearchStrategy[Callable[[], Case]]:
    names = st.sampled_from(["bad.mcap"] * 6 + ["bad.db3", "bad.bin"])
    good = (place / "scan.mcap").read_bytes()
    return st.builds(
        lambda words, name, raw: lambda: Case(_on_bag(words, name), {name: raw}),
        _ON_BAGS,
        names,
        bag_inputs.damaged_files(good),
    )


DOORS: dict[Strategy, int] = {
    through_arguments: 4,
    through_calibrations: 4,
    through_models: 1,
    through_yaml: 2,
    through_settings: 1,
    through_csv: 1,
    through_messages: 4,
    through_bag_files: 3,
}
"""Doors, and the share of the cases that each is given."""


def _all_refused_or_right(
    door: Strategy,
    place: Path,
    blocks: Any,
    cases: int,
    derandomize: bool,
    ask: Callable[[Case, Path], Answer] = ask,
) -> None:
    @settings(
        max_examples=cases,
        deadline=None,
        derandomize=derandomize,
        database=None,
        suppress_health_check=list(HealthCheck),
        phases=[Phase.generate],  # what fails is short enough to read as it is
    )
    @given(door(place, blocks))
    def each(make: Callable[[], Case]) -> None:
        case = make()
        judge(case, ask(case, place), place)

    each()


@pytest.mark.parametrize("door", DOORS, ids=lambda door: door.__name__)
def test_a_sample_of_hostile_inputs(door, place, small_scan_blocks):
    _all_refused_or_right(door, place, small_scan_blocks[:BLOCKS], 8 * DOORS[door], True)


@pytest.mark.soak
@pytest.mark.timeout(0)
@pytest.mark.parametrize("door", DOORS, ids=lambda door: door.__name__)
def test_many_hostile_inputs(door, place, small_scan_blocks):
    cases = CASES * DOORS[door] // sum(DOORS.values())
    _all_refused_or_right(door, place, small_scan_blocks[:BLOCKS], cases, False)


EVERY_WAY_IN = st.sampled_from(list(DOORS))


def _through_any(place: Path, blocks: Any) -> st.SearchStrategy[Callable[[], Case]]:
    cases = EVERY_WAY_IN.flatmap(lambda door: door(place, blocks))
    return cases.filter(lambda make: all(map(_can_be_given, make().arguments)))


def _can_be_given(word: str) -> bool:
    """Whether the operating system lets a process have ``word`` as an argument."""
    try:
        return b"\0" not in os.fsencode(word)
    except UnicodeEncodeError:  # half a character
        return False


def test_a_few_as_processes_of_their_own(place, small_scan_blocks):
    _all_refused_or_right(_through_any, place, small_scan_blocks[:BLOCKS], 4, True, ask_process)


@pytest.mark.soak
@pytest.mark.timeout(0)
def test_many_as_processes_of_their_own(place, small_scan_blocks):
    cases = CASES // 60
    _all_refused_or_right(
        _through_any, place, small_scan_blocks[:BLOCKS], cases, False, ask_process
    )
