"""Backlash and friction against their definitions, step by step, and between the steps."""

from __future__ import annotations

import numpy as np
import pytest

from omsm_ros.core.model_errors.families import dahl_friction
from omsm_ros.twin.plant import Trajectory
from omsm_ros.twin.structure import backlash


def behind(position, width):
    """Return the motion behind backlash that follows ``position``, one value a second."""
    return backlash(Trajectory(0.0, 1.0, position), width)


def test_the_backlash_loop_has_the_stated_width():
    turn = np.linspace(0, 6 * np.pi, 60_001)
    position = 1e-6 * np.sin(turn)
    followed = behind(position, 60e-9).values
    rising = (turn > 4 * np.pi - 1) & (turn < 4 * np.pi + 1)  # well after a reversal
    falling = (turn > 5 * np.pi - 1) & (turn < 5 * np.pi + 1)
    np.testing.assert_allclose(position[rising] - followed[rising], 30e-9, atol=1e-15)
    np.testing.assert_allclose(position[falling] - followed[falling], -30e-9, atol=1e-15)


def _paths():
    random = np.random.default_rng(3)
    yield np.cumsum(random.normal(0, 1e-8, 5000))
    yield np.repeat(np.cumsum(random.normal(0, 1e-8, 500)), 10)  # with rests
    yield np.zeros(10)


@pytest.mark.parametrize("path", list(_paths()), ids=["walk", "with rests", "at rest"])
def test_backlash_is_the_play_operator_step_by_step(path):
    state, expected = path[0], []
    for z in path:
        state = min(max(state, z - 20e-9), z + 20e-9)
        expected.append(state)
    np.testing.assert_allclose(behind(path, 40e-9).values, expected, atol=1e-21)


@pytest.mark.parametrize("path", list(_paths()), ids=["walk", "with rests", "at rest"])
def test_friction_obeys_dahls_equation_step_by_step(path):
    state, expected = 0.0, [0.0]
    for dz in np.diff(path):
        sign = np.sign(dz)
        state = sign - (sign - state) * np.exp(-abs(dz) / 30e-9) if dz else state
        expected.append(state)
    np.testing.assert_allclose(dahl_friction(path, 30e-9)[0], expected, atol=1e-12)


def test_friction_turns_over_within_the_presliding_distance():
    there = np.linspace(0, 100e-6, 10_001)
    path = np.r_[there, there[-2::-1]]
    found = dahl_friction(path, 1e-6)[0]
    assert found[10_000] == pytest.approx(1.0)
    # One micrometre after the reversal:
    assert found[10_100] == pytest.approx(-1 + 2 * np.exp(-1), abs=1e-3)
    assert found[-1] == pytest.approx(-1.0)


def test_between_the_steps_backlash_is_as_exact_as_its_driver():
    """A kink between two values stays a kink: the play operator of the true motion at any time."""
    times = np.arange(20_001) * 1e-3

    def motion(t):
        return 1e-6 * np.sin(t)

    played = backlash(Trajectory(0.0, 1e-3, motion(times)), 0.5e-6)
    asked = np.random.default_rng(1).uniform(2.0, 19.0, 5000)
    # Driven up to the crest, held until the motion has come back by the width, then driven down.
    turn = np.floor(asked / np.pi + 0.5) * np.pi - np.pi / 2  # the last crest or trough
    crest = np.sin(turn)
    held = 1e-6 * crest - 0.25e-6 * crest
    expected = np.clip(held, motion(asked) - 0.25e-6, motion(asked) + 0.25e-6)
    np.testing.assert_allclose(played.at(asked), expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(played.at(times), played.values, rtol=0, atol=1e-21)
