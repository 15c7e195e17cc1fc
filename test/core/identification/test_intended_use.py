"""Test intended uses: spectra of motions against closed forms, and limits that follow from them."""

from __future__ import annotations

import numpy as np
import pytest

from omsm_ros.core.calibration.intended_use import PAPER_USE, IntendedUse, use_of_motion
from omsm_ros.errors import ConfigurationError

PERIOD = 1e-3
TIME = PERIOD * np.arange(20_000)


def test_a_sine_keeps_its_frequency_rms_and_speed() -> None:
    use = use_of_motion(1e-4 * np.sin(2 * np.pi * 2.0 * TIME), PERIOD)
    assert np.sqrt(np.sum(use.rms_m**2)) == pytest.approx(1e-4 / np.sqrt(2), rel=0.01)
    assert use.speed_m_s == pytest.approx(1e-4 * 2 * np.pi * 2.0 / np.sqrt(2), rel=0.01)
    assert use.highest_hz == pytest.approx(2.0, rel=0.15)


def test_a_slow_trend_and_noise_are_no_part_of_it() -> None:
    sine = 1e-4 * np.sin(2 * np.pi * 2.0 * TIME)
    noise = np.random.default_rng(1).normal(0, 1e-10, len(TIME))
    trend = use_of_motion(sine + 1e-3 * TIME + noise, PERIOD)
    assert trend.speed_m_s == pytest.approx(use_of_motion(sine, PERIOD).speed_m_s, rel=0.02)
    assert trend.highest_hz == pytest.approx(2.0, rel=0.15)


def test_twice_the_speed_allows_half_the_delay_and_needs_twice_the_band() -> None:
    fast = IntendedUse(tuple((2 * f, rms) for f, rms in PAPER_USE.spectrum))
    assert fast.harmless_delay_s == pytest.approx(PAPER_USE.harmless_delay_s / 2)
    assert fast.least_valid_up_to_hz == pytest.approx(2 * PAPER_USE.least_valid_up_to_hz)
    assert PAPER_USE.least_valid_up_to_hz == pytest.approx(5.0)


def test_half_the_accuracy_number_allows_half_the_delay() -> None:
    asked = [IntendedUse(PAPER_USE.spectrum, accuracy) for accuracy in (40e-9, 20e-9)]
    assert asked[0].harmless_delay_s == pytest.approx(2 * asked[1].harmless_delay_s)
    assert asked[1].harmless_delay_s == PAPER_USE.harmless_delay_s


@pytest.mark.parametrize(
    "spectrum", [(), ((1.0,),), ((1.0, 0.0),), ((0.0, 1e-6),), ((1.0, -1e-6),)]
)
def test_a_use_without_motion_is_refused(spectrum: tuple[tuple[float, ...], ...]) -> None:
    with pytest.raises(ConfigurationError):
        IntendedUse(spectrum)


@pytest.mark.parametrize("z", [np.zeros(100), np.full(100, np.nan), np.arange(3.0)])
def test_a_motion_that_does_not_move_is_refused(z: np.ndarray) -> None:
    with pytest.raises(ConfigurationError, match="no motion along Z"):
        use_of_motion(z, PERIOD)
