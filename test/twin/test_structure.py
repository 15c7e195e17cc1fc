"""Creep, soft modes, backlash, friction and stiffness against closed forms and second methods."""

from __future__ import annotations

import numpy as np
import pytest

from omsm_ros.errors import ConfigurationError
from omsm_ros.twin.plant import Trajectory
from omsm_ros.twin.structure import (
    Creep,
    Friction,
    LogCreep,
    SoftMode,
    StructureErrors,
    deform,
    hardened,
)

STEP_S = 1e-3


def _deformed(errors, slide, probe=None, start=-10.0):
    """Motion of the probe where the clean one would be ``probe``, by default the carriage's."""
    made = [Trajectory(start, STEP_S, z) for z in (slide, slide if probe is None else probe)]
    slide_x = Trajectory(start, 1.0, np.arange(60) * 1e-4)
    return deform(errors, tuple(made), slide_x).values


def _times(duration=30.0, start=-10.0):
    return start + np.arange(round((duration - start) / STEP_S)) * STEP_S


@pytest.mark.parametrize("tau", [0.05, 2.0, 20.0])
def test_a_step_creeps_by_its_fraction_with_its_time_constant(tau):
    t = _times()
    step = np.where(t > 0, 10e-6, 0.0)
    found = _deformed(StructureErrors(creep=(Creep(fraction=1e-2, time_constant_s=tau),)), step)
    after = t > 0
    # The step rises along a straight line from the sample before it, half a step early.
    expected = 10e-6 * (1 - 1e-2 * np.exp(-(t[after] + 0.5 * STEP_S - STEP_S) / tau))
    np.testing.assert_allclose(found[after], expected, rtol=0, atol=1e-2 * 10e-6 * 2e-4)
    assert np.all(found[~after] == 0)


def test_logarithmic_creep_is_straight_in_the_logarithm_of_time():
    t = _times(duration=120.0)
    step = np.where(t > 0, 1.0, 0.0)
    law = LogCreep(fraction_per_decade=1e-3, shortest_s=0.01, longest_s=1000.0)
    found = _deformed(StructureErrors(log_creep=law), step)
    at = np.searchsorted(t, [0.1, 1.0, 10.0, 100.0])
    np.testing.assert_allclose(np.diff(found[at]), 1e-3, rtol=0.03)


@pytest.mark.parametrize("frequency", [0.5, 2.0, 8.0, 20.0])
def test_a_swing_comes_out_as_the_response_says(frequency):
    errors = StructureErrors(
        creep=(Creep(fraction=3e-3, time_constant_s=1.0),),
        soft_modes=(SoftMode(frequency_hz=7.0, damping_ratio=0.1, participation=1e-2),),
    )
    t = _times(20.0)
    found = _deformed(errors, np.cos(2 * np.pi * frequency * t))
    late = t > 10  # what the spin-up left has died away
    turning = np.exp(2j * np.pi * frequency * t[late])
    expected = (errors.response(np.array([2j * np.pi * frequency])) * turning).real
    np.testing.assert_allclose(found[late], expected, rtol=0, atol=2e-5)


def test_at_rest_nothing_is_added():
    errors = StructureErrors(
        creep=(Creep(fraction=1e-3, time_constant_s=5.0),),
        soft_modes=(SoftMode(frequency_hz=2.0, damping_ratio=0.02, participation=1e-3),),
        backlash_m=1e-7,
        friction=Friction(drag_m=5e-8, presliding_m=1e-6),
    )
    np.testing.assert_allclose(_deformed(errors, np.full(20_000, 3e-6)), 3e-6, atol=1e-18)
    assert abs(errors.response(np.zeros(1, complex)) - 1) < 1e-15


def test_the_probe_is_held_back_by_the_drag():
    there = np.linspace(0, 100e-6, 20_001)
    errors = StructureErrors(friction=Friction(drag_m=50e-9, presliding_m=1e-6))
    assert there[-1] - _deformed(errors, there)[-1] == pytest.approx(50e-9)


def test_a_hardening_spring_obeys_its_law():
    linear = np.linspace(-3e-6, 3e-6, 101)
    found = hardened(linear, 1e-6)
    np.testing.assert_allclose(found + found**3 / 1e-12, linear, atol=1e-20)
    # At its scale the stiffness has doubled: half of the linear deflection of 2 µm.
    assert hardened(np.array([2e-6]), 1e-6)[0] == pytest.approx(1e-6)


def test_stiffness_changes_the_deflection_along_z():
    slide = np.linspace(-1e-3, 1e-3, 2001)
    probe = slide - 300e-9
    found = _deformed(StructureErrors(compliance_per_m_of_z=100.0), slide, probe)
    np.testing.assert_allclose(slide - found, 300e-9 * (1 + 100 * slide), atol=1e-18)


def test_stiffness_changes_the_deflection_along_x():
    slide = np.zeros(2001)
    found = _deformed(StructureErrors(compliance_per_m_of_x=50.0), slide, slide - 300e-9)
    x = np.arange(2001) * STEP_S * 1e-4  # a tenth of a millimetre a second
    np.testing.assert_allclose(slide - found, 300e-9 * (1 + 50 * x), atol=1e-18)


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: StructureErrors(backlash_m=-1e-9), "backlash_m"),
        (lambda: StructureErrors(hardening_deflection_m=0.0), "hardening_deflection_m"),
        (lambda: Creep(fraction=1e-3, time_constant_s=0.0), "time_constant_s"),
        (lambda: Creep(fraction=np.nan, time_constant_s=1.0), "fraction"),
        (lambda: LogCreep(fraction_per_decade=1e-3, shortest_s=1.0, longest_s=0.1), "LogCreep"),
        (lambda: LogCreep(fraction_per_decade=1e-3, shortest_s=1e-9), "LogCreep"),
        (lambda: Friction(drag_m=1e-9, presliding_m=-1.0), "presliding_m"),
        (lambda: SoftMode(frequency_hz=0.0, damping_ratio=0.1, participation=0.1), "frequency_hz"),
    ],
)
def test_sizes_that_cannot_be_are_named(make, name):
    with pytest.raises(ConfigurationError, match=name):
        make()
