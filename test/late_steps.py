"""A step test whose probe is late and nothing else, for tests that add one thing to it."""

import numpy as np

from benchmarks.recorded import record_from_arrays
from benchmarks.step_test import StepTest

PERIOD, LAG, NOISE = 1e-3, 0.7e-3, 10e-9
STEPS = StepTest()
TIME = np.arange(round(STEPS.duration / PERIOD)) * PERIOD
Z, LATE = STEPS.positions(TIME).z, STEPS.positions(TIME - LAG).z


def late_record(added, seed=1):
    """With ``added`` (n,) [m] in the readings."""
    random = np.random.default_rng(seed)
    seen = -LATE + added + random.normal(0, NOISE, len(TIME))
    return record_from_arrays(PERIOD, Z + random.normal(0, 0.3e-9, len(Z)), seen)
