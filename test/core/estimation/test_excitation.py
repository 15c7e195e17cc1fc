"""Test the order of persistent excitation of known inputs."""

import numpy as np
import pytest

from omsm_ros.core.estimation.sampled_choice import excited_parameters

TIME = np.arange(3000) * 1e-3


@pytest.mark.parametrize("lines", [[3.0], [3.0, 11.0], [3.3, 11.0, 40.1, 61.0, 200.0]])
def test_each_sine_excites_two(lines):
    u = 7 + sum(np.sin(2 * np.pi * f * TIME + f) for f in lines)
    assert excited_parameters(u, 41) == 2 * len(lines)
    assert excited_parameters(1e6 * u, 41) == 2 * len(lines)


def test_rounding_of_a_text_excites_nothing():
    u = np.array([float(f"{value:.7g}") for value in np.sin(2 * np.pi * 3 * TIME)])
    assert excited_parameters(u, 41) == 2


def test_a_step_and_noise_excite_all():
    assert excited_parameters(np.where(TIME > 1, 1.0, 0.0), 41) == 41
    assert excited_parameters(np.random.default_rng(1).normal(0, 1, 3000), 41) == 41
