"""Residuals of scans that should agree, against waves and noise of known size."""

import numpy as np
import pytest

from omsm_ros.core.adjustment.self_calibration import HARMONICS, RINGS, ScanConsistencySums

TURNS, POINTS = 40, 2000
ANGLE = np.linspace(0.0, 2 * np.pi * TURNS, TURNS * POINTS, endpoint=False)
RADIUS = np.linspace(1e-3, 10e-3, len(ANGLE))
NOISE = 2e-9


def judged(wave, seed=1):
    sums = ScanConsistencySums(2, 1e-3, 10e-3)
    random = np.random.default_rng(seed)
    for scan, sign in ((0, 1.0), (1, -1.0)):
        left = sign * wave + random.normal(0.0, NOISE, len(ANGLE))
        sums.add(scan, RADIUS, ANGLE, left)
    return sums.result()


def test_noise_alone_is_what_neighbours_tell():
    found = judged(np.zeros(len(ANGLE)))
    assert found.noise == pytest.approx(NOISE, rel=0.01)
    # The ratio is the mean of exponential variables of mean one.
    assert found.ratio == pytest.approx(1.0, abs=4 / np.sqrt(2 * RINGS * HARMONICS))
    assert found.holds


@pytest.mark.parametrize("harmonic", [1, 3, HARMONICS])
def test_a_wave_around_the_axis_shows_with_its_rms(harmonic):
    size = 30e-9
    found = judged(size * np.cos(harmonic * ANGLE + 0.7))
    assert found.disagreement == pytest.approx(size / np.sqrt(2), rel=0.02)
    # A sum of n values a cos²: (a n/2)², over the variance n σ² of one of all the harmonics.
    expected = 1 + (size / NOISE) ** 2 * len(ANGLE) / RINGS / 4 / HARMONICS
    assert found.ratio == pytest.approx(expected, rel=0.05)
    assert not found.holds


def test_what_is_finer_than_the_harmonics_is_no_disagreement():
    found = judged(30e-9 * np.cos((HARMONICS + 3) * ANGLE))
    assert found.disagreement < 1e-9
