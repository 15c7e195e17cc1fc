"""Test encoders of coarse steps on simulated machines of one or three poles."""

import numpy as np
import pytest
from linear_segments import through
from soaked import always

from benchmarks.recorded import record_from_arrays
from omsm_ros.core.estimation.preparation import prepare
from omsm_ros.core.identification.identify import identify
from omsm_ros.errors import IdentificationError

PERIOD, FINER, REST, RAMP, NOISE = 1e-3, 5, 300, 50, 10e-9
LAG = [4e-3, 1.0]
MODE = [1 / (2 * np.pi * 60) ** 2, 0.1 / (2 * np.pi * 60), 1.0]


def smooth(part):
    return part - np.sin(2 * np.pi * part) / (2 * np.pi)


def evenly(part):
    return part


def moved(shape, height, uneven=0.0, count=12):
    """Positions (n,) of ``count`` steps there and back, some twice as high."""
    rng = np.random.default_rng(5)
    z, at = [np.zeros(REST)], 0.0
    for step in range(count):
        move = height * (-1) ** step * (1 + (rng.random() < 0.2)) * (1 + uneven * rng.random())
        z += [at + move * shape(np.arange(1, RAMP + 1) / RAMP), np.full(REST, at + move)]
        at += move
    return np.concatenate(z)


def behind(positions, backlash):
    follows, through = 0.0, []
    for position in positions:
        follows = min(max(follows, position - backlash / 2), position + backlash / 2)
        through.append(follows)
    return np.array(through)


def record_of(z, step=0.0, machine=LAG, noise=NOISE, backlash=0.0):
    time = np.arange(len(z) * FINER) * PERIOD / FINER
    fine = np.interp(time, np.arange(len(z)) * PERIOD, z)
    seen = through([1.0], machine, fine, PERIOD / FINER)[::FINER]
    distance = 40e-6 - behind(seen, backlash) + np.random.default_rng(3).normal(0, noise, len(z))
    rounded = np.round(z / step) * step if step else z
    return record_from_arrays(PERIOD, rounded, distance)


@pytest.mark.parametrize("machine", [LAG, np.polymul(LAG, MODE)])
@pytest.mark.parametrize("step", always(1e-7, 4e-6, of=[1e-7, 2.5e-7, 1e-6, 4e-6]))
def test_steps_that_mask_the_response_are_named_with_their_size(step, machine):
    record = record_of(moved(smooth, 10e-6, uneven=0.7), step, machine)
    with pytest.raises(IdentificationError, match=r"come in steps of (100 nm|250 nm|1.00|4.00)"):
        identify(record)


def test_what_is_left_is_what_rounding_leaves():
    """Sum of the squared errors of rounding through the lag, by convolution."""
    z, step = moved(smooth, 10e-6, uneven=0.7), 1e-6
    impulse = PERIOD / LAG[0] * np.exp(-np.arange(50) * PERIOD / LAG[0])
    error = np.convolve(np.round(z / step) * step - z, impulse)[: len(z)]
    ramps = np.arange(len(z)) % (REST + RAMP) >= REST
    with pytest.raises(IdentificationError) as refused:
        prepare(record_of(z, step), "encoder")
    stated = refused.value.values["residual"]
    # The simple model takes a part of it for offset and drift of the plateaus.
    assert 0.3 < stated / np.std(error[ramps]) < 1.5


@pytest.mark.parametrize(("shape", "step"), [(smooth, 0.0), (smooth, 1e-9), (smooth, 1e-8)])
def test_fine_positions_pass(shape, step):
    prepare(record_of(moved(shape, 10e-6), step), "encoder")


def test_steps_below_the_noise_pass():
    prepare(record_of(moved(smooth, 10e-6), 1e-7, noise=60e-9), "encoder")


@pytest.mark.parametrize("backlash", [0.0, 60e-9, 150e-9])
def test_a_planned_ramp_lies_on_steps_that_are_no_rounding(backlash):
    """An even ramp of 5 µm in 50 samples: every position is a multiple of 100 nm."""
    prepare(record_of(moved(evenly, 5e-6), backlash=backlash), "encoder")
