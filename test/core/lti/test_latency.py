"""Latency of a calibration, and its uncertainty where it is not resolved."""

from __future__ import annotations

import numpy as np
import pytest

from omsm_ros.core.calibration.calibration import Calibration, excess_latency_text, with_latency
from omsm_ros.core.calibration.latency import (
    DECLARED,
    UNRESOLVED,
    declared_latency,
    unresolved_latency,
)
from omsm_ros.core.correction.uncertainty import ErrorSources
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.errors import ConfigurationError

LAG = 3e-4
KNOWN = Calibration(
    dynamics=TransferFunction(np.ones(1), np.array([1.0, LAG])),
    static_gain=1.0,
    sample_period=1e-3,
    valid_up_to=100.0,
    covariance=np.zeros((3, 3)),
)


def test_without_a_word_any_part_of_the_lag_may_be_latency() -> None:
    found = KNOWN.latency
    assert found.source == UNRESOLVED
    assert not found.resolved
    assert found.delay_s == 0.0
    # The root of the mean square of a uniform distribution from 0 to the lag.
    anywhere = np.random.default_rng(1).uniform(0.0, LAG, 100_000)
    assert found.uncertainty_s == pytest.approx(np.sqrt(np.mean(anywhere**2)), rel=0.01)
    assert ErrorSources.of(KNOWN).probe_latency == found.unshared_s


def test_no_lag_leaves_nothing_open() -> None:
    assert unresolved_latency(0.0).unshared_s == 0.0


def test_what_is_declared_counts_with_its_uncertainty() -> None:
    made = with_latency(KNOWN, declared_latency(LAG, LAG / 2, 5e-6, "data sheet, 0.3 ms exposure"))
    found = made.latency
    assert (found.source, found.resolved, found.share) == (DECLARED, True, pytest.approx(0.5))
    assert ErrorSources.of(made).probe_latency == 5e-6
    assert made.id != KNOWN.id


@pytest.mark.parametrize(
    ("delay", "uncertainty", "reason", "named"),
    [
        (-1e-6, 1e-6, "because", "latency is -1e-06 s"),
        (1e-6, -1e-6, "because", "latency unshared with Z is -1e-06 s"),
        (1e-6, 1e-6, "  ", "needs a reason"),
    ],
)
def test_what_cannot_be_declared_is_refused(
    delay: float, uncertainty: float, reason: str, named: str
) -> None:
    with pytest.raises(ConfigurationError, match=named):
        declared_latency(LAG, delay, uncertainty, reason)


@pytest.mark.parametrize(("delay", "uncertainty"), [(0.0, 0.0), (LAG, 0.0), (3.2e-4, 1e-5)])
def test_a_delay_within_the_lag_is_a_part_of_it(delay: float, uncertainty: float) -> None:
    assert excess_latency_text(KNOWN, delay, uncertainty) is None


@pytest.mark.parametrize(("delay", "uncertainty"), [(0.1, 1e-5), (3.2e-4, 1e-6)])
def test_a_delay_in_a_wrong_unit_is_more_than_the_lag(delay: float, uncertainty: float) -> None:
    said = excess_latency_text(KNOWN, delay, uncertainty)
    assert said is not None
    assert "is more than the whole lag of Z, 300 µs ± 0 s" in str(said)
