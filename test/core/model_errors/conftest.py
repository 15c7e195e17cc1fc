"""A short step test whose probe has a delay, fitted by a delay, with model errors added."""

from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.recorded import record_from_arrays
from benchmarks.step_test import StepTest
from omsm_ros.core.estimation.model_order import fit
from omsm_ros.core.estimation.preparation import prepare
from omsm_ros.core.lti.transfer_function import Structure
from omsm_ros.core.model_errors.residual_diagnostics import ResidualDiagnostics

PERIOD, LAG, NOISE = 2e-3, 0.7e-3, 10e-9
STEPS = StepTest(count=3, dwell=0.5, rise=40e-3)
TIME = np.arange(round(STEPS.duration / PERIOD)) * PERIOD
Z, LATE = STEPS.positions(TIME).z, STEPS.positions(TIME - LAG).z


def diagnostics(added=0.0, seed=1, lost=(), **options):
    """Return a step test; added: error along the motion (n,) [m];  lost: readings (k,)."""
    random = np.random.default_rng(seed)
    seen = -(LATE + added) + random.normal(0, NOISE, len(TIME))
    seen[list(lost)] = np.nan
    record = record_from_arrays(PERIOD, Z + random.normal(0, 0.3e-9, len(Z)), seen)
    prepared = prepare(record, "encoder")
    late = fit(prepared.problem, Structure(0, 0, True), [np.array([0.1])])
    return ResidualDiagnostics(prepared.problem, late, prepared.steps, **options)


@pytest.fixture(scope="session")
def step_test_of():
    return SimpleNamespace(
        diagnostics=diagnostics, period=PERIOD, lag=LAG, noise=NOISE, time=TIME, late=LATE
    )


@pytest.fixture(scope="session")
def clean():
    return diagnostics()
