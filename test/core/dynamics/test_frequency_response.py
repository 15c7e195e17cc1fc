"""Spectra against Parseval and known lines."""

import numpy as np
import pytest

from omsm_ros.core.dynamics.frequency_response import frequency_response, power_spectrum
from omsm_ros.errors import DataError

PERIOD = 1e-3


def test_the_density_adds_up_to_the_variance():
    values = np.random.default_rng(1).normal(0, 3.0, 50_000)
    assert power_spectrum(values, PERIOD).rms_between(0, 500) == pytest.approx(3.0, rel=0.02)


def test_a_line_is_found_with_its_rms():
    time = np.arange(20_000) * PERIOD
    values = 2 * np.sin(2 * np.pi * 120 * time)
    spectrum = power_spectrum(values, PERIOD)
    assert spectrum.strongest() == pytest.approx(120, abs=1)
    assert spectrum.rms_between(110, 130) == pytest.approx(np.sqrt(2), rel=0.02)


def test_the_response_of_a_delay_is_its_phase():
    rng = np.random.default_rng(2)
    motion = np.cumsum(rng.normal(size=40_000))
    measured = frequency_response(motion, 0.5 * np.roll(motion, 2), PERIOD, 1000)
    inside = (measured.frequency > 1) & (measured.frequency < 100)
    expected = 0.5 * np.exp(-2j * np.pi * measured.frequency * 2 * PERIOD)
    np.testing.assert_allclose(measured.response[inside], expected[inside], rtol=0.05)
    assert np.min(measured.coherence[inside]) > 0.98


def test_noise_lowers_the_coherence():
    rng = np.random.default_rng(3)
    motion = np.cumsum(rng.normal(size=40_000))
    measured = frequency_response(motion, rng.normal(size=40_000), PERIOD, 1000)
    assert np.median(measured.coherence) < 0.1


@pytest.mark.parametrize("values", [np.zeros(3), np.array([np.nan] * 20)])
def test_what_has_no_spectrum_is_refused(values):
    with pytest.raises(DataError, match="at least 8 finite"):
        power_spectrum(values, PERIOD)
