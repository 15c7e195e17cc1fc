"""The cell as it truly is at any instant, before any device looks at it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from omsm_ros.core.machine.kinematics import workpiece_xy
from omsm_ros.core.machine.surface_height import Surface
from omsm_ros.core.machine.trajectories import AxisPositions, Motion
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.twin.disturbances import Disturbances
from omsm_ros.twin.machine_errors import posed, random_walk
from omsm_ros.twin.plant import Grid, Plant, move
from omsm_ros.twin.quantities import is_default
from omsm_ros.twin.structure import deform
from omsm_ros.twin.trajectory import Trajectory
from omsm_ros.twin.vibration import Vibration

# Sample periods simulated beyond those asked for, so that a cubic has its four points.
_SPARE_SAMPLES = 3


class Look(NamedTuple):
    """What the probe looks at, each (n,) [m].

    probe: its own true Z;  surface: height of the part under it;  x, y: where, on the chuck
    raised: how much nearer the part is than its height tells, by drift, vibration and the like
    """

    probe: FloatArray
    surface: FloatArray
    x: FloatArray
    y: FloatArray
    raised: FloatArray


Raising = Callable[[FloatArray, AxisPositions], FloatArray]


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything as signals in time.

    carriage, probe: true Z [m];  surface: as it sits on the chuck
    raising: what brings the part nearer, at a time and a position of the slides
    """

    disturbances: Disturbances
    motion: Motion
    surface: Surface
    carriage: Trajectory
    probe: Trajectory
    raising: tuple[Raising, ...]

    def look(self, time: FloatArray) -> Look:
        """What is before the probe at ``time`` (n,) [s]."""
        slides = self.motion.positions(time)
        x, y = workpiece_xy(slides.x, slides.y, slides.c)
        raised = np.zeros(1)
        for raise_ in self.raising:
            raised = raised + raise_(time, slides)
        return Look(self.probe.at(time), self.surface.height(x, y), x, y, raised)

    def over_an_exposure(self, time: FloatArray) -> Look:
        """The mean of what is before the probe while it looks for the triggers at ``time``."""
        before, weights = self.disturbances.probe.looks()
        if len(before) == 1:
            return self.look(time - before[0])
        looks = [self.look(time - ago) for ago in before]
        return Look(
            *(
                np.asarray(sum(w * part for w, part in zip(weights, parts, strict=True)))
                for parts in zip(*looks, strict=True)
            )
        )


def scene_of(
    plant: Plant,
    disturbances: Disturbances,
    motion: Motion,
    surface: Surface,
    samples: int,
    sample_period: float,
    substeps: int,
    random: Mapping[str, np.random.Generator],
) -> Scene:
    """Simulate ``motion`` and gather what happens beside it.

    substeps: simulated steps in a sample period;  random: by the name of the use
    """
    grid = _grid(plant, disturbances, samples, sample_period, substeps)
    moved = deform(disturbances.structure, move(plant, motion, grid))
    raising: list[Raising] = []
    if not is_default(disturbances.machine.drift):
        times = np.arange(-grid.lead, grid.samples + 1) * sample_period
        walk = Trajectory(times[0], sample_period, random_walk(times, random["drift"]))
        raising.append(lambda time, slides: disturbances.machine.drift.height(time, walk))
    if disturbances.vibration:
        vibration = Vibration.of(disturbances.vibration, random["vibration"])
        raising.append(lambda time, slides: vibration.height(time, slides.c))
    on_chuck = posed(surface, disturbances.machine.pose)
    return Scene(disturbances, motion, on_chuck, moved.carriage, moved.probe, tuple(raising))


def _grid(
    plant: Plant, disturbances: Disturbances, samples: int, period: float, substeps: int
) -> Grid:
    forgotten = int(np.ceil(plant.lead_in() / period))
    if is_default(disturbances):
        return Grid(forgotten, samples, period, substeps, every=substeps)
    probe = disturbances.probe
    earlier = probe.latency_s + probe.window_s + disturbances.structure.lead_s
    lead = forgotten + int(np.ceil(earlier / period)) + _SPARE_SAMPLES
    return Grid(lead, samples + _SPARE_SAMPLES, period, substeps, every=1)
