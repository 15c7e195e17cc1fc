"""A late probe of the twin."""

from __future__ import annotations

import numpy as np
import pytest

from omsm_ros.core.machine.trajectories import Spiral
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.errors import ConfigurationError
from omsm_ros.twin.cell import Cell, Probe, record

QUIET = Probe(noise=0.0, resolution=0.0)
SPIRAL = Spiral(PAPER_MIRROR, start_radius=12.7e-3, feed_per_turn=5e-3, spindle_speed=30.0)


def test_a_reading_one_sample_late_is_the_reading_before() -> None:
    prompt = record(Cell(probe=QUIET, encoder_noise=0.0), SPIRAL, PAPER_MIRROR)
    late = record(Cell(probe=QUIET, encoder_noise=0.0, latency=1e-3), SPIRAL, PAPER_MIRROR)
    for name in ("surface_height", "probe_motion"):
        ours, theirs = getattr(late, name)[1:], getattr(prompt, name)[:-1]
        assert np.allclose(ours, theirs, rtol=0, atol=1e-12)
    readings = late.distance.distance[1:], prompt.distance.distance[:-1]
    assert np.allclose(*readings, rtol=0, atol=1e-12)
    assert np.allclose(late.axes.z, prompt.axes.z, rtol=0, atol=1e-13)


@pytest.mark.parametrize("latency", [-1e-3, np.nan, np.inf])
def test_a_latency_that_cannot_be_is_named(latency: float) -> None:
    with pytest.raises(ConfigurationError, match="latency"):
        Cell(latency=latency)
