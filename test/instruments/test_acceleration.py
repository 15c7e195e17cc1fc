"""The emulated accelerometer: every sample once, in step with the motion."""

import numpy as np

from omsm_ros.core.kinematics.trajectories import Circle
from omsm_ros.core.surface.nominal import Flat
from omsm_ros.instruments.emulator_factory import AccelerationFeed
from omsm_ros.twin.cell import Cell, record
from omsm_ros.twin.disturbances import NOTHING, Disturbances, VibrationLine
from omsm_ros.twin.sensors import AccelerationSensor


def recording(disturbances):
    motion = Circle(Flat(), 5e-3, 60.0)
    return record(Cell(disturbances=disturbances), motion, Flat())


def test_every_sample_comes_once_and_in_time():
    shaking = VibrationLine(amplitude_m=5e-9, frequency_hz=680.0)
    errors = Disturbances(
        vibration=(shaking,), accelerometer=AccelerationSensor(sample_period_s=2.5e-4)
    )
    made = recording(errors)
    feed = AccelerationFeed(made, start_ns=7_000_000_000)
    given = [feed.due(played) for played in (0, 100, 100, 250, 1000, 1000)]
    assert [None if b is None else len(b) for b in given] == [None, 400, None, 600, 3000, None]
    np.testing.assert_array_equal(
        np.concatenate([b.z for b in given if b is not None]), made.acceleration.z
    )
    assert given[3].first_sample == 400
    assert given[3].stamp_ns == 7_100_000_000


def test_without_an_accelerometer_there_is_nothing():
    assert AccelerationFeed(recording(NOTHING), 0).due(1000) is None
