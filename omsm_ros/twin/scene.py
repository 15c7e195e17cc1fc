"""The cell as it truly is at any instant, before any device looks at it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from omsm_ros.core.machine.kinematics import Geometry, workpiece_points, workpiece_xy
from omsm_ros.core.machine.surface_height import Surface
from omsm_ros.core.machine.trajectories import AxisPositions, Motion
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.twin.channels import acceleration_of
from omsm_ros.twin.disturbances import Disturbances
from omsm_ros.twin.machine_errors import Shift, random_walk
from omsm_ros.twin.part_pose import posed
from omsm_ros.twin.plant import Grid, Plant, move
from omsm_ros.twin.record_checks import is_default
from omsm_ros.twin.structure import deform
from omsm_ros.twin.trajectory import Trajectory
from omsm_ros.twin.vibration import Vibration

Random = Mapping[str, np.random.Generator]

# Sample periods simulated beyond those asked for, so that a cubic has its four points.
_SPARE_SAMPLES = 3
# Each turn of the search for a slanting beam's end leaves slope times slant of the error before;
# it ends when the last one changed no more than this [m].
_MOST_BEAM_ITERATIONS = 12
_BEAM_SETTLED_M = 1e-12


class Look(NamedTuple):
    """What the probe looks at, each (n,) [m].

    probe: its own true Z;  surface: height of the part under it;  x, y: where, on the chuck
    distance: true, along the beam
    """

    probe: FloatArray
    surface: FloatArray
    x: FloatArray
    y: FloatArray
    distance: FloatArray


Shifting = Callable[[FloatArray, AxisPositions], Shift]


@dataclass(frozen=True, slots=True)
class Timing:
    """``samples`` every ``period`` [s], each period simulated in ``substeps``."""

    samples: int
    period: float
    substeps: int

    @property
    def duration(self) -> float:
        """[s]"""
        return self.samples * self.period


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything as signals in time.

    carriage, probe: true Z [m];  surface: as it sits on the chuck
    stand_off: height of the probe's zero above the axis zero [m]
    shifting: what moves the workpiece against the probe, at a time and a position of the slides
    vibration: lines between workpiece and probe, which an accelerometer feels too
    """

    disturbances: Disturbances
    motion: Motion
    surface: Surface
    stand_off: float
    carriage: Trajectory
    probe: Trajectory
    shifting: tuple[Shifting, ...]
    vibration: Vibration

    def positions(self, time: FloatArray) -> AxisPositions:
        """Return True positions of the axes, as commanded but for the wobble of B."""
        slides = self.motion.positions(time)
        if not self.disturbances.machine.b_wobble_rad:
            return slides
        return slides._replace(b=slides.b + self.disturbances.machine.b_wobble(time))

    def look(self, time: FloatArray, about: FloatArray | float = 0.0) -> Look:
        """Return what is before the probe at ``time`` (n,) [s], ``about`` so far away [m]."""
        slides = self.positions(time)
        x, y, raised = self._shift(time, slides)
        shifted = slides._replace(x=slides.x - x, y=slides.y - y)
        probe, mount = self.probe.at(time), self.disturbances.machine.mount
        if is_default(mount) and not slides.b.any():
            on_x, on_y = workpiece_xy(shifted.x, shifted.y, slides.c)
            height = self.surface.height(on_x, on_y)
            distance = height + raised - probe - self.stand_off
            return Look(probe, height, on_x, on_y, distance)
        return self._along_the_beam(mount, shifted, probe, raised, about)

    def _shift(self, time: FloatArray, slides: AxisPositions) -> Shift:
        """Return the whole shift of the workpiece against the probe."""
        total = Shift(np.zeros(1), np.zeros(1), np.zeros(1))
        for shifting in self.shifting:
            part = shifting(time, slides)
            total = Shift(*(a + b for a, b in zip(total, part, strict=True)))
        return total

    def _along_the_beam(
        self,
        mount: Geometry,
        slides: AxisPositions,
        probe: FloatArray,
        raised: FloatArray,
        about: FloatArray | float,
    ) -> Look:
        """Return what ``look`` does, for a beam that slants or a probe that B carries about."""
        zero = probe + self.stand_off - raised
        distance = np.zeros_like(probe) + about
        for _ in range(_MOST_BEAM_ITERATIONS):
            at = workpiece_points(mount, (slides.x, slides.y, zero), slides.b, slides.c, distance)
            height = self.surface.height(at.x, at.y)
            change = height - at.height
            distance = distance + change
            if np.all(abs(change) < _BEAM_SETTLED_M):
                break
        return Look(probe, height, at.x, at.y, distance)

    def over_an_exposure(self, time: FloatArray) -> Look:
        """Return the mean of what is before the probe during the exposures at ``time``."""
        probe = self.disturbances.probe
        before, weights = probe.looks()
        look = self.look(time - before[0])
        if len(before) > 1:
            looks = (look, *(self.look(time - ago, look.distance) for ago in before[1:]))
            look = Look(*(weights @ np.array(parts) for parts in zip(*looks, strict=True)))
        if not self.vibration.lines:
            return look
        # Lines may be faster than the looks: their mean is known in closed form.
        middle, half = time - probe.lag_s, probe.window_s / 2
        begin, c, end = (self.motion.positions(middle + d).c for d in (-half, 0.0, half))
        shaken = self.vibration.height(middle, c, probe.window_s, end - begin)
        return look._replace(distance=look.distance + shaken)

    def acceleration(self, time: FloatArray, period: float) -> FloatArray:
        """Return the acceleration of the probe along Z [m/s²] at ``time`` (n,) [s]."""
        c = self.motion.positions(time).c
        speed = np.asarray(np.gradient(c, period))
        shaken = self.vibration.acceleration(time, c, speed)
        # What brings the part nearer moves the probe down.
        return np.asarray(acceleration_of(self.probe).at(time) - shaken)


def scene_of(
    plant: Plant,
    disturbances: Disturbances,
    motion: Motion,
    surface: Surface,
    stand_off: float,
    timing: Timing,
    random: Random,
) -> Scene:
    """Simulate ``motion`` and gather what happens beside it; ``random`` by the name of the use."""
    if disturbances.servo_bandwidth_hz is not None:
        plant = replace(plant, servo_bandwidth=disturbances.servo_bandwidth_hz)
    grid = _grid(plant, disturbances, timing)
    times = np.arange(-grid.lead, grid.samples + 1, dtype=np.float64) * timing.period
    moved = move(plant, motion, grid)
    if not is_default(disturbances.structure):
        slide_x = Trajectory(times[0], timing.period, motion.positions(times).x)
        moved = deform(disturbances.structure, moved, slide_x)
    vibration = Vibration.of(disturbances.vibration, random["vibration"])
    return Scene(
        disturbances=disturbances,
        motion=motion,
        surface=posed(surface, disturbances.machine.pose),
        stand_off=stand_off,
        carriage=moved.carriage,
        probe=moved.probe,
        shifting=tuple(_shifting(disturbances, times, random)),
        vibration=vibration,
    )


def _shifting(disturbances: Disturbances, times: FloatArray, random: Random) -> list[Shifting]:
    """Return what is switched on of all that moves the workpiece; ``times`` span the simulation."""
    machine, zero = disturbances.machine, np.zeros(1)
    result: list[Shifting] = []
    if not is_default(machine.drift):
        walk = Trajectory(times[0], times[1] - times[0], random_walk(times, random["drift"]))
        result.append(lambda time, slides: Shift(zero, zero, machine.drift.height(time, walk)))
    if not is_default(machine.spindle):
        noise = [
            Trajectory(times[0], times[1] - times[0], random["spindle"].normal(size=len(times)))
            for _ in range(5 if machine.spindle.is_noisy else 0)
        ]
        result.append(lambda time, slides: machine.spindle.shift(time, slides, noise))
    if not (is_default(machine.x_slide_along_z) and is_default(machine.z_slide_along_x)):
        result.append(lambda time, slides: machine.slides_shift(slides))
    return result


def _grid(plant: Plant, disturbances: Disturbances, timing: Timing) -> Grid:
    forgotten = int(np.ceil(plant.lead_in() / timing.period))
    if is_default(disturbances):
        return Grid(forgotten, timing.samples, timing.period, timing.substeps, timing.substeps)
    probe, clocks = disturbances.probe, disturbances.clocks.reach_s(timing.duration)
    reference = disturbances.reference.latency_s if disturbances.reference else 0.0
    late = max(probe.latency_s + probe.window_s, reference)
    lead = late + clocks + disturbances.structure.lead_s
    return Grid(
        lead=forgotten + int(np.ceil(lead / timing.period)) + _SPARE_SAMPLES,
        samples=timing.samples + int(np.ceil(clocks / timing.period)) + _SPARE_SAMPLES,
        sample_period=timing.period,
        substeps=timing.substeps,
        every=1,
    )
