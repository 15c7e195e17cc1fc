"""Records that look like a fault that they have not; exchanged channels, which look like none."""

import numpy as np
import pytest
from scipy import signal
from soaked import soaked

from benchmarks.recorded import record_from_arrays
from benchmarks.step_test import StepTest
from omsm_ros.core.estimation.optimisation import EvaluationBudget
from omsm_ros.core.estimation.preparation import prepare
from omsm_ros.core.identification.identify import identify
from omsm_ros.errors import ConfigurationError, IdentificationError

PERIOD = 1e-3
TIME = np.arange(0.0, 15.0, PERIOD)


def test_a_lag_of_half_a_period_is_no_other_gain():
    rng = np.random.default_rng(1)
    lag = 60e-3
    time = np.arange(0.0, 20.0, PERIOD)
    z, seen = (20e-6 * signal.chirp(time - late, 0.5, 20.0, 15.0) for late in (0.0, lag))
    record = record_from_arrays(
        PERIOD, z + rng.normal(0, 0.3e-9, len(z)), -seen + rng.normal(0, 10e-9, len(z))
    )
    found = identify(record).calibration
    assert found.certificate.verdict == "accepted"
    assert found.dynamics.low_frequency_delay == pytest.approx(lag, abs=20e-6)
    assert found.static_gain == pytest.approx(1.0, abs=1e-3)


def late_sine(limit):
    """A sine that is seen a sixth of a period late, in steps of 10 nm, up to ``limit`` [m]."""
    z, seen = (20e-6 * np.sin(2 * np.pi * 0.5 * TIME - late) for late in (0.0, 1.0))
    return record_from_arrays(PERIOD, z, np.round(np.minimum(-seen, limit) / 10e-9) * 10e-9)


def test_a_peak_that_is_seen_late_is_not_clipped():
    prepare(late_sine(1.0), "encoder")
    with pytest.raises(IdentificationError, match="it is clipped"):
        prepare(late_sine(19.8e-6), "encoder")


@pytest.mark.soak
@pytest.mark.parametrize("seed", [2, 5])
def test_exchanged_channels_are_named(seed):
    """Also where the search for a model is cut short."""
    rng, lag = np.random.default_rng(seed), 0.34e-3
    test = StepTest()
    time = np.arange(0.0, test.duration, PERIOD)
    z = test.positions(time).z + rng.normal(0, 0.3e-9, len(time))
    seen = test.positions(time - lag).z + rng.normal(0, 10e-9, len(time))
    certificate = identify(record_from_arrays(PERIOD, seen, -z)).calibration.certificate
    assert certificate.verdict == "rejected"
    assert any("channels are exchanged" in reason for reason in map(str, certificate.reasons))


@pytest.mark.soak
def test_what_is_not_linear_is_given_up_after_a_bounded_effort():
    """Sixty lines of hum, more than the rounds of the search describe."""
    rng = np.random.default_rng(3)
    time = np.arange(round(StepTest().duration / 1e-3)) * 1e-3
    z = StepTest().positions(time).z
    hum = sum(2e-7 * np.sin(2 * np.pi * f * time + f) for f in np.linspace(3, 480, 60))
    seen = signal.lfilter([0.2], [1, -0.8], z) + hum + rng.normal(0, 1e-8, len(z))
    budget = EvaluationBudget()
    found = identify(record_from_arrays(1e-3, z, 40e-6 - seen), budget=budget)
    certificate = found.calibration.certificate
    assert certificate.verdict == "rejected"
    full = EvaluationBudget()
    while not full.exhausted:
        full.count(len(z))
    # A quarter more for the fit that was begun by then, and for the last choice.
    assert 1000 < budget.evaluations < 1.25 * full.evaluations


@pytest.mark.parametrize("name", ["crep", *soaked("backlash", "Creep")])
def test_a_prior_on_a_detectable_family_is_refused(name):
    rng = np.random.default_rng(1)
    z = StepTest(count=2).positions(TIME).z
    record = record_from_arrays(PERIOD, z, rng.normal(-z, 10e-9))
    with pytest.raises(ConfigurationError, match="is unknown, expected one of 'creep'"):
        identify(record, settings={"priors": {name: 1e-6}})
