"""A sine in time or in position is found at its own frequency, and once."""

import numpy as np
import pytest
from late_steps import LATE, NOISE, STEPS, TIME, late_record

from omsm_ros.core.estimation.model_order import fit
from omsm_ros.core.estimation.preparation import prepare
from omsm_ros.core.identification.model_choice import model_from_start
from omsm_ros.core.identification.model_error_search import search_model_errors
from omsm_ros.core.lti.transfer_function import Structure
from omsm_ros.core.model_errors.families import PERIODIC, VIBRATION
from omsm_ros.core.model_errors.residual_diagnostics import ResidualDiagnostics


def prepared_of(added):
    return prepare(late_record(added), "encoder")


def best(added, family):
    prepared = prepared_of(added)
    late = fit(prepared.problem, Structure(0, 0, True), [np.array([0.1])])
    return ResidualDiagnostics(prepared.problem, late, prepared.steps, (family,)).best[family]


@pytest.mark.parametrize(
    "frequency",
    [
        13.711,
        pytest.param(2.033, marks=pytest.mark.soak),
        pytest.param(120.04, marks=pytest.mark.soak),
    ],
)
def test_a_line_is_found_between_the_lines_of_the_record(frequency):
    """Within the bound of Cramér and Rao times four, far below the 0.1 Hz between lines."""
    size = 20e-9
    found = best(size * np.sin(2 * np.pi * frequency * TIME + 0.4), VIBRATION)
    bound = np.sqrt(6 / len(TIME)) * NOISE / size / (np.pi * STEPS.duration)
    assert found.significant
    assert found.term.parameter == pytest.approx(frequency, abs=4 * bound)
    assert np.linalg.norm(found.score.size) == pytest.approx(size, rel=0.05)


@pytest.mark.parametrize("period", [2.413e-6, pytest.param(7.03e-6, marks=pytest.mark.soak)])
def test_an_error_between_two_periods_of_the_travel_is_one_error(period):
    size = 20e-9
    searched = search_model_errors(
        prepared_of(size * np.sin(2 * np.pi * LATE / period + 1.0)), model_from_start
    )
    found = [b.term.parameter for b in searched.nuisance_terms if b.term.family == PERIODIC]
    assert len(found) == 1
    assert found[0] == pytest.approx(period, rel=0.01)
