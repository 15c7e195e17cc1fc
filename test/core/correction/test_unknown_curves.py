"""Components of an unknown curve against the covariance that they stand for."""

from __future__ import annotations

import numpy as np
import pytest

from omsm_ros.core.correction.source_kinds import Kernel, components, fading, random_walk, smooth

TIME = np.linspace(0.0, 250.0, 700)


@pytest.mark.parametrize("kernel", [random_walk, fading(80.0), smooth(85.0)])
def test_components_add_up_to_the_covariance(kernel: Kernel) -> None:
    parts = components(kernel, TIME)
    expected = kernel(TIME[:, np.newaxis], TIME[np.newaxis])
    assert np.max(abs(parts.T @ parts - expected)) < 0.03 * np.max(expected)


def test_a_walk_has_the_components_of_the_textbook() -> None:
    """``√2 T / ((k - ½) π) · sin((k - ½) π t / T) / √T`` (Karhunen and Loève)."""
    first = components(random_walk, TIME)[0]
    angle = 0.5 * np.pi
    expected = np.sqrt(2 * TIME[-1]) / angle * np.sin(angle * TIME / TIME[-1])
    assert np.max(abs(abs(first) - expected)) < 0.01 * np.max(expected)


def test_a_drawn_walk_has_its_variance() -> None:
    parts = components(random_walk, TIME)
    draws = np.random.default_rng(5).normal(size=(3000, len(parts))) @ parts
    assert np.std(draws[:, -1]) == pytest.approx(np.sqrt(TIME[-1]), rel=0.05)


def test_smooth_curves_have_few_components() -> None:
    assert len(components(smooth(125.0), TIME)) <= 5


def test_where_nothing_moves_the_curve_is_a_constant() -> None:
    parts = components(smooth(1.0), np.zeros(5))
    assert np.allclose(parts, np.ones((1, 5)))


@pytest.mark.parametrize("kernel", [fading(80.0), smooth(80.0)])
def test_the_correlation_falls_to_1_e_over_the_length(kernel: Kernel) -> None:
    assert kernel(np.zeros(1), np.array([80.0])) == pytest.approx(np.exp(-1))
