"""The compiled loop of scipy, against the public function that it comes from."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from scipy import signal

from omsm_ros.linear_algebra import sosfilt

SECTIONS = signal.butter(6, 0.2, output="sos")
SAMPLES = np.random.default_rng(1).normal(size=700)


def public(samples: np.ndarray, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    response, after = signal.sosfilt(SECTIONS, samples, zi=state)
    return response, after


def test_response_and_state_are_those_of_scipy_to_the_last_bit() -> None:
    state = np.random.default_rng(2).normal(size=(3, 2))
    expected = public(SAMPLES, state.copy())
    response = sosfilt(SECTIONS, SAMPLES, state)
    assert np.array_equal(response, expected[0])
    assert np.array_equal(state, expected[1])


def test_the_samples_given_are_left_as_they_were() -> None:
    before = SAMPLES.copy()
    sosfilt(SECTIONS, SAMPLES, np.zeros((3, 2)))
    assert np.array_equal(SAMPLES, before)


@pytest.mark.parametrize("samples", [SAMPLES[::2], SAMPLES.reshape(70, 10)[:, 3]])
def test_any_layout_of_samples_will_do(samples: np.ndarray) -> None:
    expected, _ = public(samples.copy(), np.zeros((3, 2)))
    assert np.array_equal(sosfilt(SECTIONS, samples, np.zeros((3, 2))), expected)


def run(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_correcting_loads_neither_ros_nor_the_parts_of_scipy_for_searches() -> None:
    heavy = ["scipy.io", "scipy.cluster", "rclpy", "omsm_msgs", "matplotlib", "control", "tqdm"]
    code = "import sys, omsm_ros.core.correction.correct; "
    assert run(code + f"print([m for m in {heavy} if m in sys.modules])") == "[]"


def test_a_live_node_loads_what_makes_its_filters_before_samples_come() -> None:
    pytest.importorskip("rclpy", reason="ROS 2 is not installed")
    code = "import sys, omsm_ros.nodes.corrector_node; print('scipy.signal' in sys.modules)"
    assert run(code) == "True"
