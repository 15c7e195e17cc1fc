"""A free path against sines, for which errors and lags are known in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from omsm_ros.core.calibration.verification import PathCheck, check_path, excited_bands
from omsm_ros.core.lti.discretisation import discretise
from omsm_ros.core.lti.recursion import through
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.streams.blocks import FloatArray

PERIOD, COUNT = 1e-3, 4000
TIME = PERIOD * np.arange(COUNT)
AMPLITUDE, FREQUENCY = 0.3e-3, 5.0
OMEGA = 2 * np.pi * FREQUENCY


def sine(gain: float = 1.0, lag: float = 0.0) -> FloatArray:
    return np.asarray(AMPLITUDE * gain * np.sin(OMEGA * TIME - lag))


def checked(
    gain: float, lag: float, static: float = 1.0, offset: float = 40e-6, model: float = 0.0
) -> PathCheck:
    """A probe that sees ``gain`` of the motion, ``lag`` late; a model that is late by ``model``."""
    distance = offset - static * sine(gain, lag)
    return check_path(sine(), distance, sine(gain, model), static, PERIOD)


@pytest.mark.parametrize("lag", [0.0, 0.01, 0.3, -0.2])
@pytest.mark.parametrize("gain", [1.0, 0.97])
def test_error_and_lag_of_a_sine(gain: float, lag: float) -> None:
    found = checked(gain, lag)
    assert found.lag_before == pytest.approx(np.full(COUNT, lag), abs=1e-9)
    missed = abs(1 - gain * np.exp(-1j * lag))
    assert found.rms_before == pytest.approx(AMPLITUDE * missed / np.sqrt(2), rel=1e-9, abs=1e-18)
    assert np.max(found.error_before) == pytest.approx(AMPLITUDE * missed, rel=1e-3, abs=1e-15)
    assert found.frequency == pytest.approx(np.full(COUNT, FREQUENCY), rel=1e-6)


def test_a_model_that_is_right_leaves_nothing() -> None:
    found = checked(0.97, 0.3, model=0.3)
    assert np.max(np.abs(found.error_after)) < 1e-15
    assert np.max(np.abs(found.lag_after)) < 1e-9
    assert found.rms_after < 1e-15 < found.rms_before


def test_a_model_that_is_partly_right_leaves_the_rest() -> None:
    found = checked(0.97, 0.3, model=0.25)
    assert found.lag_after == pytest.approx(np.full(COUNT, 0.05), abs=1e-9)
    expected = 0.97 * AMPLITUDE * abs(np.exp(-0.25j) - np.exp(-0.3j)) / np.sqrt(2)
    assert found.rms_after == pytest.approx(expected, rel=1e-9)


def test_static_gain_and_stand_off_are_the_probes_own() -> None:
    plain, other = checked(0.97, 0.3), checked(0.97, 0.3, static=-1.7, offset=3e-3)
    for name in ("error_before", "error_after", "lag_before", "lag_after"):
        np.testing.assert_allclose(getattr(other, name), getattr(plain, name), atol=1e-12)
    assert other.excited == plain.excited == ((5.0, 6.0),)


def test_the_pace_only_scales_the_frequency() -> None:
    distance = 40e-6 - sine(0.97, 0.3)
    fast = check_path(sine(), distance, sine(0.97), 1.0, PERIOD / 10)
    assert fast.frequency == pytest.approx(10 * checked(0.97, 0.3).frequency)
    assert fast.rms_before == checked(0.97, 0.3).rms_before
    assert fast.excited == ((50.0, 51.0),)


def test_a_chirp_is_as_late_as_its_response_says() -> None:
    """A first-order lag on a sweep from 2 to 40 Hz: arctan(2π f τ), where f then is."""
    lag = TransferFunction(np.ones(1), np.array([1.0, 1e-3]))
    z = 1e-4 * np.sin(2 * np.pi * (2.0 * TIME + 0.5 * 38.0 / 4.0 * TIME**2))
    seen = through(discretise(lag, PERIOD), z)
    found = check_path(z, -seen, seen, 1.0, PERIOD)
    middle = slice(800, 3200)
    swept = 2.0 + 38.0 / 4.0 * TIME
    assert found.frequency[middle] == pytest.approx(swept[middle], abs=1.0)
    expected = np.arctan(2 * np.pi * swept * 1e-3)
    assert found.lag_before[middle] == pytest.approx(expected[middle], abs=0.02)
    assert found.rms_after == 0.0


@pytest.mark.parametrize("samples", [3000, 4000, 4001, 7777])
def test_a_line_is_in_the_band_of_its_own_hertz(samples: int) -> None:
    time = PERIOD * np.arange(samples)
    assert excited_bands(np.sin(2 * np.pi * 7.5 * time), PERIOD) == ((7.0, 8.0),)


def test_a_weak_line_next_to_a_strong_one_is_no_excitation() -> None:
    strong = np.sin(2 * np.pi * 3.5 * TIME)
    weak, equal = (a * np.sin(2 * np.pi * 40.5 * TIME) for a in (0.1, 0.9))
    assert excited_bands(strong + weak, PERIOD) == ((3.0, 4.0),)
    assert excited_bands(strong + equal, PERIOD) == ((3.0, 4.0), (40.0, 41.0))


def test_offset_unit_sign_and_direction_of_time_do_not_matter() -> None:
    motion = np.sin(2 * np.pi * 3.5 * TIME) + 0.8 * np.cos(2 * np.pi * 12.5 * TIME)
    expected = excited_bands(motion, PERIOD)
    for other in (motion + 5.0, 1e-6 * motion, -motion, motion[::-1]):
        assert excited_bands(other, PERIOD) == expected == ((3.0, 4.0), (12.0, 13.0))
