"""The loop that runs every filter, against the public function that it comes from."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from scipy import signal

from omsm_ros import sosfilt as module
from omsm_ros.sosfilt import sosfilt

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


def test_where_the_loop_is_not_found_the_public_function_serves(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def absent() -> None:
        raise ImportError("elsewhere")

    expected, after = public(SAMPLES, np.ones((3, 2)))
    monkeypatch.setattr(module, "_loaded", absent)
    module._loop.cache_clear()
    state = np.ones((3, 2))
    try:
        assert module._loop() is module._public
        assert np.array_equal(sosfilt(SECTIONS, SAMPLES, state), expected)
    finally:
        module._loop.cache_clear()
    assert np.array_equal(state, after)


def run(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_correcting_loads_neither_ros_nor_the_heavy_parts_of_scipy() -> None:
    code = "import sys, omsm_ros.cli.measuring; from omsm_ros.sosfilt import _loop; _loop(); "
    heavy = "('scipy.signal', 'scipy.stats', 'scipy.optimize', 'scipy.interpolate', 'rclpy', "
    heavy += "'omsm_msgs', 'matplotlib', 'control')"
    assert run(code + f"print([m for m in {heavy} if m in sys.modules])") == "[]"


@pytest.mark.parametrize("first", ["loop", "scipy"])
def test_scipy_signal_and_the_loop_live_together(first: str) -> None:
    ours, theirs = "from omsm_ros.sosfilt import _loop; _loop()", "from scipy import signal"
    lines = [ours, theirs] if first == "loop" else [theirs, ours]
    same = "print(_loop() is sys.modules['scipy.signal._sosfilt']._sosfilt)"
    use = "signal.sosfilt([[1.0, 0, 0, 1, 0, 0]], [1.0])"
    assert run("; ".join(["import sys", *lines, use, same])) == "True"
