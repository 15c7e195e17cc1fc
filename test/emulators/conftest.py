"""A recording of the twin that several tests play."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from omsm_ros.core.machine.trajectories import Spiral
from omsm_ros.core.samples.blocks import Status
from omsm_ros.core.surface.nominal import OffAxisParaboloid
from omsm_ros.twin.cell import Cell, Recording, record


@pytest.fixture(scope="module")
def recording() -> Recording:
    """A spiral over the paper's mirror, with a stretch where the probe sees nothing."""
    mirror = OffAxisParaboloid(parent_focal_length=25.4e-3, off_axis_distance=50.8e-3)
    spiral = Spiral(surface=mirror, start_radius=2e-3, feed_per_turn=1e-3, spindle_speed=30.0)
    whole = record(Cell(), spiral, mirror, substeps=2)
    status = whole.distance.status.copy()
    status[700:730] = Status.NO_TARGET
    distance = whole.distance.distance.copy()
    distance[700:715] = np.nan
    return replace(whole, distance=replace(whole.distance, status=status, distance=distance))
