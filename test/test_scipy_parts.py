"""Compiled parts of scipy, against the public functions that they come from."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest
from scipy import linalg, signal

from omsm_ros import linear_algebra
from omsm_ros.linear_algebra import generalised_eigenvalues, sosfilt

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


@pytest.fixture
def scipy_elsewhere(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """As after a release of scipy that has moved its compiled parts."""
    cached = (linear_algebra._filter_loop, linear_algebra._pencil_solver)
    monkeypatch.setattr(linear_algebra, "_loaded", lambda name: None)
    for function in cached:
        function.cache_clear()
    yield
    for function in cached:
        function.cache_clear()


@pytest.mark.usefixtures("scipy_elsewhere")
def test_where_the_loop_is_not_found_the_public_function_serves() -> None:
    expected, after = public(SAMPLES, np.ones((3, 2)))
    state = np.ones((3, 2))
    assert linear_algebra._filter_loop() is linear_algebra._public_loop
    assert np.array_equal(sosfilt(SECTIONS, SAMPLES, state), expected)
    assert np.array_equal(state, after)


A = np.random.default_rng(5).normal(size=(5, 5))
B = np.diag([1.0, 1, 1, 1, 0])


def by_value(found: np.ndarray) -> np.ndarray:
    return np.sort_complex(found[np.isfinite(found) & (abs(found) < 1e9)])


def test_eigenvalues_are_those_of_scipy_to_the_last_bit() -> None:
    assert np.array_equal(by_value(generalised_eigenvalues(A, B)), by_value(linalg.eigvals(A, B)))
    assert len(by_value(generalised_eigenvalues(A, B))) == 4


@pytest.mark.usefixtures("scipy_elsewhere")
def test_where_the_solver_is_not_found_the_public_function_serves() -> None:
    assert linear_algebra._pencil_solver() is linear_algebra._public_solver
    assert np.array_equal(by_value(generalised_eigenvalues(A, B)), by_value(linalg.eigvals(A, B)))


def run(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.strip()


LOAD = "from omsm_ros.linear_algebra import _filter_loop, _pencil_solver; "
LOAD += "_filter_loop(), _pencil_solver()"


def test_correcting_loads_neither_ros_nor_the_heavy_parts_of_scipy() -> None:
    """The command adjusts the scan afterwards, so it alone may load more of scipy."""
    heavy = ["scipy.signal", "scipy.linalg", "scipy.stats", "scipy.optimize", "scipy.interpolate"]
    heavy += ["scipy.fft", "rclpy", "omsm_msgs", "matplotlib", "control", "tqdm"]
    code = f"import sys, omsm_ros.core.correction.correct; {LOAD}; "
    assert run(code + f"print([m for m in {heavy} if m in sys.modules])") == "[]"


@pytest.mark.parametrize("first", ["ours", "scipy"])
def test_scipy_and_its_parts_live_together(first: str) -> None:
    lines = [LOAD, "from scipy import linalg, signal"]
    same = "print([sys.modules[n].__name__ for n in "
    same += "('scipy.signal._sosfilt', 'scipy.linalg._flapack')], "
    same += "_filter_loop() is sys.modules['scipy.signal._sosfilt']._sosfilt)"
    use = "signal.sosfilt([[1.0, 0, 0, 1, 0, 0]], [1.0]); linalg.eigvals([[1.0]], [[1.0]])"
    ordered = lines if first == "ours" else lines[::-1]
    assert run("; ".join(["import sys", *ordered, use, same])).endswith("True")
