"""A probe whose scale changes over its range, behind two lags and a delay: own arithmetic, no twin.

The probe bends what it sees, which is late; a model that bends the axis's position takes a share of
the lag for the bend, and its G is off by microseconds.
"""

import numpy as np
import pytest
from scipy import signal

from benchmarks.recorded import record_from_arrays
from omsm_ros.core.identification.identify import identify

PERIOD, FINER, DWELL = 1e-3, 20, 0.75
STEP_M, RISE_S, NOISE_M = 9.8e-6, 20e-3, 10e-9
LAGS_S, DELAY_S, CURVATURE_M = (1.33e-3, 0.23e-3), 0.37e-3, 0.3e-6


def staircase(time):
    """Ten steps up and ten down, each an S-curve of the fifth order."""
    height = np.zeros_like(time)
    for k in range(20):
        phase = np.clip((time - DWELL * (k + 1)) / RISE_S, 0, 1)
        sign = 1 if k < 10 else -1
        height += sign * STEP_M * phase**3 * (10 - 15 * phase + 6 * phase**2)
    return height


@pytest.fixture(scope="module")
def calibration():
    fine = np.arange(round(22 * DWELL / PERIOD) * FINER) * PERIOD / FINER
    seen = staircase(fine - DELAY_S)
    for lag in LAGS_S:
        # Tustin's rule: at a fiftieth of a millisecond as good as exact.
        b, a = signal.bilinear([1.0], [lag, 1.0], FINER / PERIOD)
        seen = signal.lfilter(b, a, seen)
    seen, z = seen[::FINER], staircase(fine[::FINER])
    place = (seen - 5 * STEP_M) / (5 * STEP_M)
    random = np.random.default_rng(4)
    noise = NOISE_M * random.normal(size=len(z))
    return identify(
        record_from_arrays(PERIOD, z, -40e-6 - seen - CURVATURE_M * place**3 + noise)
    ).calibration


def test_a_curved_scale_leaves_the_lag_alone(calibration):
    certificate = calibration.certificate
    assert certificate.verdict != "rejected"
    (found,) = (d for d in certificate.model_errors.modelled if d.family == "probe linearity")
    assert found.size_m == pytest.approx(CURVATURE_M, rel=0.05)
    off = calibration.dynamics.low_frequency_delay - sum(LAGS_S) - DELAY_S
    # A bend of the axis's position put it 11 µs off.
    assert abs(off) < min(3 * certificate.response.low_frequency_delay_uncertainty_s, 5e-6)
