"""Out with a band: nothing moves, and what is said of it holds."""

import numpy as np
import pytest

from omsm_ros.core.ripple.density import band_stop
from omsm_ros.errors import ConfigurationError

TIME = np.arange(20_000) * 1e-3


def test_the_band_goes_and_the_rest_keeps_phase_and_size():
    kept, hum = 5e-9 * np.sin(2 * np.pi * 280 * TIME + 1), 5e-9 * np.sin(2 * np.pi * 320 * TIME)
    found = band_stop(np.arange(20_000), kept + hum, 1e-3, [(310.0, 330.0)])
    inner = slice(int(found.settling / 1e-3), -int(found.settling / 1e-3))
    left = (kept + hum - found.removed)[inner]
    np.testing.assert_allclose(left, kept[inner], atol=0.02e-9)
    assert found.rms_before == pytest.approx(5e-9, rel=1e-3)
    assert found.rms_after == pytest.approx(5e-9 / 2**0.5, rel=5e-3)
    assert found.rms_removed == pytest.approx(5e-9 / 2**0.5, rel=5e-3)


@pytest.mark.parametrize("frequency", [100.0, 309.0, 312.0, 340.0])
def test_the_response_that_is_stated_is_the_one_that_acts(frequency):
    wave = np.sin(2 * np.pi * frequency * TIME)
    found = band_stop(np.arange(20_000), wave, 1e-3, [(310.0, 330.0)])
    inner = slice(5000, -5000)
    phasor = 2 * np.mean(
        (wave - found.removed)[inner] * np.exp(-2j * np.pi * frequency * TIME[inner])
    )
    stated = np.interp(frequency, found.frequency, found.response)
    assert abs(phasor) == pytest.approx(stated, abs=0.03)
    if stated > 0.1:
        assert np.angle(phasor * 1j) == pytest.approx(0.0, abs=1e-3)


def test_missing_samples_are_bridged():
    kept = np.random.default_rng(1).uniform(size=20_000) > 0.1
    hum = np.sin(2 * np.pi * 50 * TIME)
    found = band_stop(np.arange(20_000)[kept], hum[kept], 1e-3, [(45.0, 55.0)])
    assert found.rms_after < 0.1 * found.rms_before


@pytest.mark.parametrize("band", [(0.0, 10.0), (30.0, 20.0), (400.0, 500.0)])
def test_a_band_that_is_none_is_refused(band):
    with pytest.raises(ConfigurationError, match="half the sampling rate"):
        band_stop(np.arange(1000), np.zeros(1000), 1e-3, [band])
