"""Responses without a model, against known ones."""

import numpy as np

from omsm_ros.core.lti.frequency_response import frequency_response

PERIOD = 1e-3


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
