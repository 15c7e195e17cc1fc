"""Simulate the measurement of the paper: step test and scan, with the true values."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from omsm_ros.core.kinematics.trajectories import (
    PLANNED_COUNT,
    PLANNED_DWELL_S,
    SECOND_SHARE,
    Motion,
    Spiral,
    StepTest,
    plan_steps,
)
from omsm_ros.core.surface.nominal import PAPER_MIRROR, PAPER_MIRROR_RADIUS_M, Flat
from omsm_ros.twin.cell import Cell, Recording, record
from omsm_ros.twin.disturbances import NOTHING, Disturbances
from omsm_ros.twin.part import FigureError, PartPose


@dataclass(frozen=True)
class Scenario:
    """Motion and part of a simulation.

    seed: of all random numbers;  part_seed: of the figure error, None takes ``seed``
    spindle_speed: [rpm];  feed_per_turn, start_radius: [m];  step_rise, sample_period: [s]
    tool_marks: peak to valley of the marks of the turning tool [m]
    outward: scan from the centre outward
    """

    seed: int = 1
    spindle_speed: float = 30.0
    feed_per_turn: float = 1e-4
    start_radius: float = PAPER_MIRROR_RADIUS_M
    step_rise: float = 20e-3
    sample_period: float = 1e-3
    part_seed: int | None = None
    tool_marks: float = 0.0
    outward: bool = False

    @property
    def part(self) -> FigureError:
        """Mirror with its figure error, which is the same for one ``part_seed``."""
        seed = self.seed if self.part_seed is None else self.part_seed
        return FigureError(
            PAPER_MIRROR, PAPER_MIRROR_RADIUS_M, seed=seed, tool_marks=self.tool_marks
        )


def planned_test_of(scenario: Scenario, disturbances: Disturbances = NOTHING) -> Recording:
    """Return the step test of ``omsm plan steps`` with half its dwell, on a fixed flat."""
    step = StepTest().step
    motion = plan_steps(
        sample_period=scenario.sample_period,
        step=step,
        second_step=SECOND_SHARE * step,
        count=PLANNED_COUNT,
        dwell=PLANNED_DWELL_S / 2,
        rise=scenario.step_rise,
    )
    return on_a_flat(scenario, motion, disturbances)


def on_a_flat(
    scenario: Scenario, motion: Motion, disturbances: Disturbances = NOTHING
) -> Recording:
    """Return a ``motion`` over a fixed flat without pose, centred in the range of the probe."""
    z = motion.positions(
        np.arange(0.0, motion.duration, scenario.sample_period, dtype=np.float64)
    ).z
    fixed = replace(disturbances, machine=replace(disturbances.machine, pose=PartPose()))
    cell = Cell(seed=scenario.seed, sample_period=scenario.sample_period, disturbances=fixed)
    return record(cell, motion, Flat(), stand_off=-float(z.max() + z.min()) / 2)


def scan_of(scenario: Scenario, disturbances: Disturbances = NOTHING) -> Recording:
    """Return the spiral scan of the mirror with its figure error."""
    # The seed differs from that of the step test, so that their noise is independent.
    cell = Cell(
        seed=scenario.seed + 1, sample_period=scenario.sample_period, disturbances=disturbances
    )
    return record(cell, spiral_of(scenario), scenario.part)


def spiral_of(scenario: Scenario) -> Spiral:
    """Return the commanded motion of the scan over the nominal mirror."""
    return Spiral(
        PAPER_MIRROR,
        scenario.start_radius,
        scenario.feed_per_turn,
        scenario.spindle_speed,
        scenario.outward,
    )


def verifying(scenario: Scenario) -> Scenario:
    """Return the scan that verifies ``scenario``: the same part outward at twice the speed."""
    return replace(
        scenario,
        seed=scenario.seed + 1,
        part_seed=scenario.seed if scenario.part_seed is None else scenario.part_seed,
        spindle_speed=2 * scenario.spindle_speed,
        outward=not scenario.outward,
    )


def verifying_scan_of(scenario: Scenario, disturbances: Disturbances = NOTHING) -> Recording:
    """Return the scan of :func:`verifying`."""
    return scan_of(verifying(scenario), disturbances)
