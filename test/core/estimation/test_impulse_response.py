"""Impulse responses without a model, against those that made the record."""

import numpy as np
import pytest
from scipy import signal

from omsm_ros.core.estimation.impulse_response import impulse_response

TRUTH = np.exp(-np.arange(60) / 8) * np.sin(np.arange(60) / 3)
STRETCH = (np.arange(3000) < 900) | (np.arange(3000) >= 1800)
SCATTERED = np.random.default_rng(5).random(3000) > 0.3


@pytest.mark.parametrize("used", [np.ones(3000, bool), STRETCH, SCATTERED])
def test_lost_samples_do_not_bend_the_response(used):
    """Interpolated, a lost stretch of a third of the record makes it wrong by 40 %."""
    rng = np.random.default_rng(0)
    u = rng.normal(size=3000)
    y = 4.0 + signal.lfilter(TRUTH, [1.0], u) + 0.01 * rng.normal(size=3000)
    found = impulse_response(u[:, np.newaxis], np.where(used, y, 0.0), used)[0]
    missed = found - np.pad(TRUTH, (0, len(found) - len(TRUTH)))
    assert np.linalg.norm(missed) < 0.05 * np.linalg.norm(TRUTH)


def test_a_record_too_short_has_none():
    assert impulse_response(np.ones((30, 1)), np.ones(30), np.ones(30, bool)) is None
