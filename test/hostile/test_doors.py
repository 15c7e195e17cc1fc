"""Whatever comes through a door is refused in one line that helps, or answered rightly.

A sample of each door's cases runs with all tests, always the same; ``make soak`` runs many
thousand others.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hostile import bag_inputs, maps, trees
from hostile.doors import DOORS, Strategy, right_cases
from hostile.judge import Answer, Case, ask, ask_process, judge
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from sections_of_polynomials import from_polynomials
from soaked import soaked

from omsm_ros import cli
from omsm_ros.core.calibration.calibration_set import calibration_set
from omsm_ros.core.estimation.sampled_model import SampledModel
from omsm_ros.core.kinematics.kinematics import Geometry
from omsm_ros.io.bag_writer import BagWriter
from omsm_ros.io.calibration_file import save_calibration
from omsm_ros.io.descriptions import save_geometry
from omsm_ros.pipelines.identify import save_model
from omsm_ros.twin.cell import blocks_of

MODEL = SampledModel(
    sections=replace(
        from_polynomials(
            "zero-order", 1e-3, np.array([0.0, 0.3, 0.1]), np.array([1.0, -1.2, 0.5]), 1e-3
        ),
        covariance=1e-6 * np.eye(6),
    ),
    valid=[(1.0, 100.0)],
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
                bag.write_block(axes)
                bag.write_block(distance)
    save_calibration(folder / "cal.json", true_calibration)
    save_geometry(folder / "geometry.yaml", Geometry(centre_x=1e-6))
    save_model(folder / "model.json", MODEL)
    (folder / "surface.yaml").write_text("shape: sphere\nradius: -0.1\n")
    (folder / "motion.csv").write_text(
        "\n".join(["time_s,z_m", *(f"{k / 1000},{k % 100 * 1e-7}" for k in range(600))])
    )
    (folder / "pitch.csv").write_text(
        "\n".join(["z_m,pitch_rad", *(f"{k * 1e-5},{k % 7 * 1e-7}" for k in range(-99, 99))])
    )
    made = calibration_set("x", [(x, true_calibration) for x in (0.0, 2e-3)])
    save_calibration(folder / "set.json", made)
    for name, content in (
        ("map", trees.COLUMNS),
        ("sources", trees.SOURCES),
        ("arm", {"abbe_arm": 0.05}),
    ):
        (folder / f"{name}.yaml").write_text(json.dumps(content))
    maps.write_maps(folder)
    maps.write_tables(folder)
    _write_results(folder)
    (folder / "sealed").write_bytes(b"")
    (folder / "sealed").chmod(0)
    (folder / "folder").mkdir()
    for name in ("pipe", "pipe.mcap"):
        os.mkfifo(folder / name)
    (folder / "zero.mcap").symlink_to("/dev/zero")
    (folder / "loop").symlink_to("loop")
    return folder


def _write_results(folder: Path) -> None:
    """Write a corrected scan and a catalogue, as the commands make them."""
    scan, calibration = str(folder / "scan.mcap"), str(folder / "cal.json")
    words = ["correct", scan, "--calibration", calibration, "--out", str(folder / "result")]
    more = ["--no-report", "--nominal", str(folder / "surface.yaml"), "--json"]
    assert cli.main([*words, *more, "--sources", str(folder / "sources.yaml")]) == 0
    catalogue = str(folder / "catalogue.sqlite")
    assert cli.main(["history", "--catalogue", catalogue, "--add", calibration, "--json"]) == 0


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
        derandomize=derandomize,
        database=None,
        suppress_health_check=list(HealthCheck),
        phases=[Phase.generate],  # what fails is short enough to read as it is
    )
    @given(door(place, blocks))
    def each(make: Callable[[], Case]) -> None:
        case = make()
        try:
            judge(case, ask(case, place), place)
        finally:
            _tidy(place, usual)

    usual = {path.name for path in place.iterdir()}
    each()


def _tidy(place: Path, usual: set[str]) -> None:
    """Remove what the last case laid down or wrote, so that each begins in the same place."""
    for path in place.iterdir():
        if path.name not in usual:
            shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()


@pytest.mark.parametrize("door", DOORS, ids=lambda door: door.__name__)
def test_a_sample_of_hostile_inputs(door, place, small_scan_blocks):
    _all_refused_or_right(door, place, small_scan_blocks[:BLOCKS], DOORS[door], True)


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
    _all_refused_or_right(_through_any, place, small_scan_blocks[:BLOCKS], 1, True, ask_process)


@pytest.mark.soak
@pytest.mark.timeout(0)
def test_many_as_processes_of_their_own(place, small_scan_blocks):
    cases = CASES // 60
    _all_refused_or_right(
        _through_any, place, small_scan_blocks[:BLOCKS], cases, False, ask_process
    )


@pytest.mark.parametrize("every", [3, *soaked(1)])
def test_what_is_right_comes_through(place, every):
    """Else a door would refuse all that is tried, and this would be no test of it."""
    wrong, cases = [], [*right_cases(place)][::every]
    usual = {path.name for path in place.iterdir()}
    for case in cases:
        done = ask(case, place)
        wrong += [(case.arguments, done.err)] if done.status else []
        _tidy(place, usual)
    assert not wrong, "\n".join(map(str, wrong))
