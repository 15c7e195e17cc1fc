"""Samples of the devices: scale, noise, resolution, range, drift, seed."""

import numpy as np
import pytest

from benchmarks.step_test import StepTest
from omsm_ros.core.streams.blocks import Status
from omsm_ros.core.surface.nominal import Flat
from omsm_ros.errors import ConfigurationError
from omsm_ros.twin.cell import Cell, Probe, blocks_of, record
from omsm_ros.twin.disturbances import NOTHING, Disturbances
from omsm_ros.twin.machine_errors import Drift, MachineErrors
from omsm_ros.twin.plant import PAPER_STATIC_GAIN

MIDDLE = -49e-6


def test_reading_is_the_scaled_distance_with_noise_and_resolution():
    made = record(Cell(), StepTest(), Flat(), stand_off=MIDDLE)
    true = made.surface_height - made.probe_motion - MIDDLE
    error = made.distance.distance - PAPER_STATIC_GAIN * true
    assert np.std(error) == pytest.approx(np.hypot(10e-9, 10e-9 / np.sqrt(12)), rel=0.03)
    steps = made.distance.distance / 10e-9
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)


def test_encoder_has_its_noise_and_no_more():
    loud, silent = (record(Cell(encoder_noise=n), StepTest(), Flat()) for n in (0.4e-9, 0.0))
    assert np.std(loud.axes.z - silent.axes.z) == pytest.approx(0.4e-9, rel=0.03)


def test_beyond_its_range_the_probe_sees_nothing():
    # Without the stand-off the target leaves the range half way up.
    made = record(Cell(), StepTest(), Flat())
    lost = abs(made.surface_height - made.probe_motion) > 50e-6
    assert 0.3 < np.mean(lost) < 0.7
    np.testing.assert_array_equal(made.distance.ok, ~lost)
    assert np.all(np.isnan(made.distance.distance[lost]))
    assert set(made.distance.status[lost]) == {Status.NO_TARGET}


def test_drift_moves_the_target():
    drift = Disturbances(machine=MachineErrors(drift=Drift(ramp_m_per_s=100e-9 / 60)))
    quiet = Probe(noise=0.0, resolution=0.0)
    still, drifting = (
        record(Cell(disturbances=d, probe=quiet), StepTest(), Flat(), stand_off=MIDDLE)
        for d in (NOTHING, drift)
    )
    moved = drifting.distance.distance - still.distance.distance
    expected = PAPER_STATIC_GAIN * 100e-9 / 60 * np.arange(len(moved)) * 1e-3
    np.testing.assert_allclose(moved, expected, atol=1e-15)


def test_the_seed_decides_the_noise():
    first, again, other = (record(Cell(seed=s), StepTest(), Flat()) for s in (1, 1, 2))
    np.testing.assert_array_equal(first.axes.z, again.axes.z)
    assert np.any(first.axes.z != other.axes.z)
    np.testing.assert_array_equal(first.probe_motion, other.probe_motion)


def test_blocks_are_the_recording():
    made = record(Cell(), StepTest(), Flat(), stand_off=MIDDLE)
    pairs = blocks_of(made, 300)
    np.testing.assert_array_equal(np.concatenate([a.z for a, _ in pairs]), made.axes.z)
    for axes, distance in pairs:
        assert axes.first_sample == distance.first_sample
        assert axes.stamp_ns == axes.first_sample * 1_000_000


def test_a_trigger_needs_a_period():
    with pytest.raises(ConfigurationError, match="sample_period"):
        Cell(sample_period=0.0)
