"""Test that two scans of one part agree, and that one with 20 nm more astigmatism differs.

Scans at 30 and 45 rpm and different feeds, each with its own drift, on a calibration identified
from a step test; the mirror to its full radius with ``--full``, else its inner half.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.correction import identified_calibration
from benchmarks.row import Row, at_least, at_most, shown
from omsm_ros.core.calibration.calibration import Calibration, with_latency
from omsm_ros.core.calibration.latency import declared_latency
from omsm_ros.core.surface.nominal import PAPER_MIRROR, PAPER_MIRROR_RADIUS_M
from omsm_ros.io import bags
from omsm_ros.io.bag_writer import BagWriter
from omsm_ros.pipelines.difference import ComparisonOptions, compare_measurements
from omsm_ros.pipelines.measure import measure
from omsm_ros.twin.cell import Cell, blocks_of, record
from omsm_ros.twin.disturbances import Disturbances
from omsm_ros.twin.machine_errors import Drift, MachineErrors
from omsm_ros.twin.part import FigureError
from omsm_ros.twin.scenario import Spiral
from omsm_ros.units import NANOMETRE_M

DRIFT = Drift(ramp_m_per_s=0.2e-9, random_walk_m_per_root_s=1e-9)
ADDED = 20 * NANOMETRE_M
_SLOW, _FAST = (30.0, 1.0e-4), (45.0, 1.3e-4)
_AGREES, _DIFFERS = "agree", "differ"


def _calibration() -> Calibration:
    """Return a calibration with known latency; otherwise a lag hides 10s of nm of astigmatism."""
    made = identified_calibration()
    lag = made.dynamics.low_frequency_delay
    return with_latency(made, declared_latency(lag, 0.0, 2e-6, "the twin's probe is prompt"))


def scanned(folder: Path, part: FigureError, way: tuple[float, float], seed: int) -> Path:
    """Scan ``part`` at ``way``, rpm and feed per turn [m], and return the corrected result."""
    rpm, feed = way
    drifting = Disturbances(machine=MachineErrors(drift=DRIFT))
    cell = Cell(seed=seed, disturbances=drifting)
    made = record(cell, Spiral(PAPER_MIRROR, part.radius, feed, rpm), part)
    folder.mkdir()
    bag = folder / "scan.mcap"
    with BagWriter(bag, (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)) as writer:
        for axes, distance in blocks_of(made):
            writer.write_block(axes)
            writer.write_block(distance)
    measure(bag, _calibration(), folder, report=False)
    return folder


def rows(full: bool) -> Iterator[Row]:
    """Yield verdicts and E_n numbers of pairs of scans."""
    runs = 10 if full else 3
    radius = PAPER_MIRROR_RADIUS_M if full else PAPER_MIRROR_RADIUS_M / 2
    alike, added, numbers = [], [], []
    for seed in range(runs):
        part = FigureError(PAPER_MIRROR, radius, seed=seed)
        other = replace(part, astigmatism=part.astigmatism + ADDED)
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            a = scanned(folder / "a", part, _SLOW, 2 * seed)
            b = scanned(folder / "b", part, _FAST, 2 * seed + 1)
            c = scanned(folder / "c", other, _FAST, 2 * seed + 1)
            same, _ = compare_measurements(a, b, ComparisonOptions(), None)
            apart, _ = compare_measurements(a, c, ComparisonOptions(), None)
        alike.append(same.verdict)
        added.append(apart.verdict)
        figures = same.agreement.figures.values() if same.agreement else ()
        numbers += [abs(n.e_n) for n in figures if n.e_n is not None]
    wrong = alike.count(_DIFFERS) + added.count(_AGREES)
    yield at_most("pairs of scans judged wrongly", wrong, "1", 0, runs=2 * runs)
    share = 100 * alike.count(_AGREES) / runs
    yield at_least("scans of one part at 30 and 45 rpm that agree", share, "%", 90.0, runs=runs)
    share = 100 * added.count(_DIFFERS) / runs
    name = "found to differ with 20 nm of astigmatism added to one"
    yield at_least(name, share, "%", 90.0, runs=runs)
    yield shown("largest |E_n| of the figures of one part", np.max(numbers), "1", runs=runs)
