"""The bound on what hides between samples, against what truly hides there."""

import numpy as np
import pytest

from omsm_ros.core.fitting.steps import find_steps
from omsm_ros.core.identification.inter_sample_bias import inter_sample_delay_bound
from omsm_ros.core.machine.trajectories import Chirp, StepTest
from omsm_ros.core.surface.nominal import Flat
from omsm_ros.twin.cell import Cell, record
from omsm_ros.twin.plant import Plant


def bound_of(rise, servo=200.0, period=1e-3):
    cell = Cell(plant=Plant(servo_bandwidth=servo), sample_period=period)
    z = record(cell, StepTest(rise=rise), Flat(), stand_off=-49e-6).axes.z
    return inter_sample_delay_bound(z, find_steps(z, period), period)


@pytest.mark.parametrize(("servo", "true_bias"), [(200.0, 53e-6), (100.0, 14e-6), (50.0, 3.3e-6)])
def test_the_bound_holds_the_bias_that_sharp_edges_were_seen_to_make(servo, true_bias):
    # Biases of the lag seen on Eq. 12 at 1 kHz, to be covered without being absurd.
    bound = bound_of(0.0, servo)
    assert 0.9 * true_bias < bound < 5 * true_bias


def test_jerk_limited_edges_hide_nothing_worth_a_tenth_of_a_microsecond():
    assert bound_of(20e-3) < 0.1e-6


def test_faster_sampling_hides_less():
    assert bound_of(0.0, period=1e-4) < 1e-2 * bound_of(0.0, period=1e-3)


def test_a_slow_path_hides_nothing():
    z = record(Cell(), Chirp(), Flat()).axes.z
    assert inter_sample_delay_bound(z, find_steps(z, 1e-3), 1e-3) < 0.1e-6


def test_an_edge_between_two_samples_hides_much():
    z = np.where(np.arange(2000) < 1000, 0.0, 1e-5)
    assert inter_sample_delay_bound(z, find_steps(z, 1e-3), 1e-3) > 100e-6
