"""A signal between its computed values."""

import numpy as np
import pytest

from omsm_ros.errors import ConfigurationError
from omsm_ros.twin.plant import Trajectory


def _of(function, start=-1.0, step=1e-2, count=301):
    times = start + np.arange(count) * step
    return Trajectory(start, step, function(times))


def test_on_the_grid_the_value_itself():
    signal = _of(np.sin)
    asked = np.arange(100) * 1e-2
    np.testing.assert_array_equal(signal.at(asked), signal.values[100:200])


def test_a_cubic_is_met_everywhere():
    def cubic(t):
        return 1 - 2 * t + 3 * t**2 - 4 * t**3

    asked = np.random.default_rng(1).uniform(-1.0, 2.0, 1000)
    np.testing.assert_allclose(_of(cubic).at(asked), cubic(asked), atol=1e-13)


def test_the_error_of_a_sine_falls_with_the_fourth_power_of_the_step():
    asked = np.random.default_rng(1).uniform(0.0, 1.0, 1000)
    errors = [
        abs(
            _of(lambda t: np.sin(30 * t), step=h, count=int(3 / h) + 1).at(asked)
            - np.sin(30 * asked)
        ).max()
        for h in (1e-2, 5e-3)
    ]
    assert errors[0] / errors[1] == pytest.approx(16, rel=0.1)


@pytest.mark.parametrize("time", [-1.1, 2.1])
def test_outside_is_an_error(time):
    with pytest.raises(ConfigurationError, match="simulated are -1 to 2 s"):
        _of(np.sin).at(np.array([0.0, time]))
