"""The paper's measurement on the twin: its step test and its scan, seeded, with the truth."""

from __future__ import annotations

from dataclasses import dataclass, replace

from omsm_ros.core.machine.trajectories import Spiral, StepTest
from omsm_ros.core.surface.nominal import PAPER_MIRROR, PAPER_MIRROR_RADIUS_M, Flat
from omsm_ros.twin.cell import Cell, Recording, record
from omsm_ros.twin.disturbances import NOTHING, Disturbances
from omsm_ros.twin.figure_error import FigureError
from omsm_ros.twin.part_pose import PartPose


@dataclass(frozen=True)
class Scenario:
    """What the cell does.

    spindle_speed: [rpm];  feed_per_turn, start_radius: [m];  step_rise, sample_period: [s]
    """

    seed: int = 1
    spindle_speed: float = 30.0
    feed_per_turn: float = 1e-4
    start_radius: float = PAPER_MIRROR_RADIUS_M
    step_rise: float = 20e-3
    sample_period: float = 1e-3


def step_test_of(scenario: Scenario, disturbances: Disturbances = NOTHING) -> Recording:
    """The step test on a fixed flat, its middle in the middle of the probe's range.

    The flat is no part: it has no pose.
    """
    motion = StepTest(rise=scenario.step_rise)
    middle = motion.count * motion.step / 2
    on_a_flat = replace(disturbances, machine=replace(disturbances.machine, pose=PartPose()))
    cell = Cell(seed=scenario.seed, sample_period=scenario.sample_period, disturbances=on_a_flat)
    return record(cell, motion, Flat(), stand_off=-middle)


def scan_of(scenario: Scenario, disturbances: Disturbances = NOTHING) -> Recording:
    """The spiral over the paper's mirror, as it really is."""
    motion = spiral_of(scenario)
    # Another seed than the step test's: the same noise twice would be no independent check.
    cell = Cell(
        seed=scenario.seed + 1, sample_period=scenario.sample_period, disturbances=disturbances
    )
    made = FigureError(PAPER_MIRROR, PAPER_MIRROR_RADIUS_M, scenario.seed)
    return record(cell, motion, made)


def spiral_of(scenario: Scenario) -> Spiral:
    """The commanded motion of the scan, along the nominal mirror."""
    return Spiral(
        PAPER_MIRROR, scenario.start_radius, scenario.feed_per_turn, scenario.spindle_speed
    )
