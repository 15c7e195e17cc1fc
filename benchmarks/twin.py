"""The digital twin: how fast it is, and how fine."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from benchmarks.disturbance_catalogue import CATALOGUE, together
from benchmarks.row import Row, at_most
from benchmarks.step_test import StepTest
from benchmarks.twin_motions import step_test_of
from omsm_ros.core.surface.nominal import Flat
from omsm_ros.errors import ConfigurationError
from omsm_ros.twin.cell import Cell, Probe, record
from omsm_ros.twin.disturbances import Disturbances
from omsm_ros.twin.scenario import Scenario, scan_of
from omsm_ros.twin.sensors import AccelerationSensor
from omsm_ros.units import NANOMETRE_M

_RUNS = 3


def rows(full: bool) -> Iterator[Row]:
    """Processor time of the paper's motions, and what half the simulation's step would change."""
    del full  # it takes a minute
    everything, count = everything_at_once()
    scenario = Scenario()
    for name, make, clean, disturbed in (
        ("step test", step_test_of, 0.15, 0.5),
        ("scan of 254 000 points", scan_of, 1.0, 3.0),
    ):
        yield at_most(f"twin, {name}", _seconds(partial(make, scenario)), "s", clean, runs=_RUNS)
        took = _seconds(partial(make, scenario, everything))
        yield at_most(
            f"twin, {name}, {count} disturbances at once", took, "s", disturbed, runs=_RUNS
        )
    worst, name = max((_halving(sizes[-1]), name) for name, sizes in CATALOGUE.items())
    yield at_most(
        "twin, half its step changes the reading by at most",
        worst / NANOMETRE_M,
        "nm",
        0.1,
        peer=name,
    )


def everything_at_once() -> tuple[Disturbances, int]:
    """All disturbances of the catalogue in medium size that do not exclude each other."""
    joined, count = Disturbances(accelerometer=AccelerationSensor()), 0
    for sizes in CATALOGUE.values():
        try:
            joined = together(joined, sizes[1])
            count += 1
        except ConfigurationError:
            continue  # the same number in another size
    return joined, count


def _seconds(work: Callable[[], object]) -> float:
    """Least processor time of a few runs: others use this machine too."""
    best = np.inf
    for _ in range(_RUNS):
        begin = time.process_time()
        work()
        best = min(best, time.process_time() - begin)
    return float(best)


def _halving(disturbances: Disturbances) -> float:
    quiet = Probe(noise=0.0, resolution=0.0)
    cell = Cell(probe=quiet, encoder_noise=0.0, disturbances=disturbances)
    motion = StepTest(count=2)
    coarse, fine = (
        record(cell, motion, Flat(), stand_off=-motion.step, substeps=n).distance.distance
        for n in (16, 32)
    )
    return float(np.nanmax(abs(coarse - fine)))
