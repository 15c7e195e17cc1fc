"""Simulate the measurement of the paper: step test and scan, with the true values."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from omsm_ros.core.adjustment.source_evaluation import PASSES, SPHERE, STAND_OFFS, STILL, TURNED
from omsm_ros.core.kinematics.trajectories import (
    BEYOND,
    PLANNED_COUNT,
    PLANNED_DWELL_S,
    PLANNED_STEP_M,
    SECOND_SHARE,
    AxisPositions,
    Motion,
    Spiral,
    plan_steps,
    s_curve,
)
from omsm_ros.core.streams.blocks import FloatArray, Status
from omsm_ros.core.surface.aperture import Aperture
from omsm_ros.core.surface.aspheres import Sphere
from omsm_ros.core.surface.nominal import (
    PAPER_MIRROR,
    PAPER_MIRROR_HALF_LENGTH_M,
    PAPER_MIRROR_RADIUS_M,
    Flat,
)
from omsm_ros.core.surface.posed import Pose, PosedSurface
from omsm_ros.twin.cell import Cell, Recording, record
from omsm_ros.twin.disturbances import NOTHING, Disturbances
from omsm_ros.twin.part import FigureError, PartPose
from omsm_ros.units import RPM_HZ

MIRROR_APERTURE = Aperture.of("ellipse", PAPER_MIRROR_HALF_LENGTH_M, PAPER_MIRROR_RADIUS_M)
"""The paper's mirror seen along the normal at its centre, 25.4 × 35.9 mm."""


@dataclass(frozen=True)
class Scenario:
    """Motion and part of a simulation.

    seed: of all random numbers;  part_seed: of the figure error, None takes ``seed``
    spindle_speed: [rpm];  feed_per_turn, start_radius: [m];  step_rise, sample_period: [s]
    tool_marks: peak to valley of the marks of the turning tool [m]
    outward: scan from the centre outward;  beyond: way of X on its other side [m]
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
    beyond: float = 0.0

    @property
    def part(self) -> FigureError:
        """Mirror with its figure error, which is the same for one ``part_seed``."""
        seed = self.seed if self.part_seed is None else self.part_seed
        radius = max(PAPER_MIRROR_RADIUS_M, self.start_radius)
        return FigureError(PAPER_MIRROR, radius, seed=seed, tool_marks=self.tool_marks)


def planned_test_of(scenario: Scenario, disturbances: Disturbances = NOTHING) -> Recording:
    """Return the step test of ``omsm plan steps`` with half its dwell, on a fixed flat."""
    motion = plan_steps(
        sample_period=scenario.sample_period,
        second_step=SECOND_SHARE * PLANNED_STEP_M,
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
    """Return the spiral scan of the mirror with its figure error.

    Beyond the circle of 25.4 mm the mirror is an ellipse; off it the probe sees no target.
    """
    # The seed differs from that of the step test, so that their noise is independent.
    cell = Cell(
        seed=scenario.seed + 1, sample_period=scenario.sample_period, disturbances=disturbances
    )
    made = record(cell, spiral_of(scenario), scenario.part)
    if scenario.start_radius <= PAPER_MIRROR_RADIUS_M:
        return made
    assert made.truth is not None
    off = ~MIRROR_APERTURE.holds(made.truth.x, made.truth.y)
    seen = replace(
        made.distance,
        distance=np.where(off, np.nan, made.distance.distance),
        status=np.where(off, np.uint8(Status.NO_TARGET), made.distance.status),
    )
    return replace(made, distance=seen)


def spiral_of(scenario: Scenario) -> Spiral:
    """Return the commanded motion of the scan over the nominal mirror."""
    return Spiral(
        PAPER_MIRROR,
        scenario.start_radius,
        scenario.feed_per_turn,
        scenario.spindle_speed,
        scenario.outward,
        scenario.beyond,
    )


def verifying(scenario: Scenario) -> Scenario:
    """Return the scan that verifies ``scenario``: at twice the speed from beyond the centre."""
    return replace(
        scenario,
        seed=scenario.seed + 1,
        part_seed=scenario.seed if scenario.part_seed is None else scenario.part_seed,
        spindle_speed=2 * scenario.spindle_speed,
        outward=not scenario.outward,
        beyond=BEYOND * scenario.start_radius,
    )


def verifying_scan_of(scenario: Scenario, disturbances: Disturbances = NOTHING) -> Recording:
    """Return the scan of :func:`verifying`; C counts on from the turns of ``scenario``."""
    found = scan_of(verifying(scenario), disturbances)
    turned = 2 * np.pi * round(scenario.start_radius / scenario.feed_per_turn)
    return replace(found, axes=replace(found.axes, c=found.axes.c + turned))


@dataclass(frozen=True, slots=True)
class Commanded:
    """A motion of X, Z and C alone, for ``duration`` [s]: ``of`` gives x, z [m] and c [rad]."""

    duration: float
    of: Callable[[FloatArray], tuple[FloatArray | float, FloatArray | float, FloatArray | float]]

    def positions(self, time: FloatArray) -> AxisPositions:
        """Return the commanded axes at ``time`` [s]."""
        x, z, c = (value + np.zeros(np.shape(time)) for value in self.of(np.maximum(time, 0.0)))
        return AxisPositions(x, np.zeros_like(x), z, np.zeros_like(x), c)


def _ring_of_stand_offs(radius: float, speed: float, reach: float, turns: int) -> Commanded:
    """Return a ring at ``speed`` [rpm], on which Z takes a step in the first tenth of each turn.

    The steps lead once through ± ``reach`` [m].
    """

    def of(time: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        turned = time * speed * RPM_HZ
        place = np.maximum(np.floor(turned) - 1 + s_curve(10 * (turned % 1.0)), 0.0)
        return radius, reach * np.sin(2 * np.pi * place / turns), 2 * np.pi * turned

    return Commanded(turns / (speed * RPM_HZ), of)


# Of the reference sphere, and how far it is mounted from the axis: only so does centre_y show.
SPHERE_RADIUS_M, SPHERE_OFFSET_M = 0.05, 1e-3


def source_recording(
    kind: str, scenario: Scenario, disturbances: Disturbances = NOTHING
) -> Recording:
    """Return the recording from which ``omsm sources`` evaluates the sources of ``kind``."""
    cell = Cell(
        seed=scenario.seed + 7, sample_period=scenario.sample_period, disturbances=disturbances
    )
    if kind == SPHERE:
        ball = PosedSurface(Sphere(SPHERE_RADIUS_M), Pose(x=SPHERE_OFFSET_M))
        return record(cell, Spiral(ball, 4e-3, 2e-4, scenario.spindle_speed), ball)
    flat = Flat()
    motions: dict[str, Motion] = {
        STILL: Commanded(60.0, lambda _: (0.0, 0.0, 0.0)),
        PASSES: Commanded(40.0, lambda t: (5e-3 * (1 - np.cos(np.pi / 2 * t)), 0.0, 0.0)),
        TURNED: Spiral(flat, 1e-2, 4e-4, scenario.spindle_speed),
        STAND_OFFS: _ring_of_stand_offs(1e-2, scenario.spindle_speed, 4e-5, 20),
    }
    return record(cell, motions[kind], flat)
