"""Motions of the twin for tests and measured figures: a plant alone, and the paper's step test."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.step_test import StepTest
from omsm_ros.core.kinematics.trajectories import Motion
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.twin.cell import Recording
from omsm_ros.twin.disturbances import NOTHING, Disturbances
from omsm_ros.twin.plant import Plant, TimeGrid, move
from omsm_ros.twin.scenario import Scenario, on_a_flat


@dataclass(frozen=True, eq=False)
class Response:
    """True motion of slide and probe at the sampling instants [m], each (n,)."""

    slide: FloatArray
    probe: FloatArray


def respond(
    plant: Plant, motion: Motion, samples: int, sample_period: float, substeps: int = 16
) -> Response:
    """Return the response of the plant to ``motion`` every ``sample_period`` [s]."""
    lead = int(np.ceil(plant.lead_in() / sample_period))
    grid = TimeGrid(lead, samples, sample_period, substeps, substeps)
    slide, probe = move(plant, motion, grid)
    at_samples = slice(lead - 1, lead - 1 + samples)
    return Response(slide.values[at_samples], probe.values[at_samples])


def step_test_of(scenario: Scenario, disturbances: Disturbances = NOTHING) -> Recording:
    """Return the step test of the paper on a fixed flat."""
    return on_a_flat(scenario, StepTest(rise=scenario.step_rise), disturbances)
