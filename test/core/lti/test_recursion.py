"""The streaming filter: steady start, and the same bits however the stream is cut."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

from omsm_ros.core.lti.discretisation import discretise
from omsm_ros.core.lti.recursion import Recursion, past_motion
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.twin.plant import PAPER_EQ_12

PAPER = PAPER_EQ_12.normalised()
LATE = TransferFunction(PAPER.numerator, PAPER.denominator, 0.34e-3)


def test_the_parabola_through_the_first_samples_is_found() -> None:
    index = np.arange(14)
    motion = past_motion(1e-3 + 3e-6 * index - 2e-9 * index**2)
    assert np.allclose(motion, [1e-3, 3e-6, -2e-9], rtol=1e-9)


@pytest.mark.parametrize("dynamics", [PAPER, LATE], ids=["rational", "delayed"])
@pytest.mark.parametrize("period", [1e-3, 1 / 70e3])
def test_a_start_in_accelerated_motion_leaves_no_transient(
    dynamics: TransferFunction, period: float
) -> None:
    digital = discretise(dynamics, period)
    motion = np.array([1e-3, 3e-6, 5e-9])
    past = digital.settling_samples(1e-12)
    index = np.arange(-past, 200.0)
    samples = motion[0] + motion[1] * index + motion[2] * index**2
    # The long way: let the filter run over the whole past.
    expected = signal.sosfilt(digital.sections, samples)[past:]
    recursion = Recursion(digital)
    recursion.start(motion)
    assert np.allclose(recursion.run(samples[past:]), expected, rtol=0, atol=1e-13)


def test_a_long_delay_starts_where_it_would_be_and_in_no_time() -> None:
    """A tenth of a second at 100 kHz: 5000 sections; to solve for each by itself takes 2 s."""
    period = 1e-5
    digital = discretise(TransferFunction(PAPER.numerator, PAPER.denominator, 0.1), period)
    begun = time.process_time()
    recursion = Recursion(digital)
    recursion.start(np.array([1e-3, 3e-9, 0.0]))
    taken = time.process_time() - begun
    lag = 0.1 + PAPER.low_frequency_delay
    late = recursion.run(1e-3 + 3e-9 * np.arange(100.0)) - 1e-3 - 3e-9 * np.arange(100.0)
    assert late == pytest.approx(-3e-9 * lag / period, abs=1e-12)
    assert taken < 0.5


def test_a_start_at_rest_in_moving_data_would_be_seen() -> None:
    recursion = Recursion(discretise(PAPER, 1e-3))
    recursion.start(np.array([1e-3, 0.0, 0.0]))
    moving = 1e-3 + 3e-6 * np.arange(100)
    response = recursion.run(moving)
    steady = moving - 3e-6 * (PAPER.low_frequency_delay / 1e-3)
    assert max(abs(response - steady)[:5]) > 0.5e-6
    assert abs(response - steady)[-1] < 1e-12


@settings(max_examples=40)
@given(cuts=st.lists(st.integers(1, 499), max_size=12))
def test_cuts_do_not_change_a_bit(cuts: list[int]) -> None:
    digital = discretise(LATE, 1e-3)
    samples = np.random.default_rng(4).normal(size=500)
    motion = past_motion(samples[:12])
    whole, pieces = Recursion(digital), Recursion(digital)
    whole.start(motion)
    pieces.start(motion)
    expected = whole.run(samples)
    parts = [pieces.run(part) for part in np.split(samples, sorted(set(cuts)))]
    assert np.array_equal(np.concatenate(parts), expected)
