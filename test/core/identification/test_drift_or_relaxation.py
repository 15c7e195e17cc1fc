"""What wanders during a test may be a drift, or the beginning of a relaxation."""

import numpy as np
import pytest
from late_steps import LAG, LATE, PERIOD, TIME, late_record

from omsm_ros.core.departures.families import DRIFT, relaxed
from omsm_ros.core.departures.hidden import hidden_terms, without_drift
from omsm_ros.core.departures.survey import Survey
from omsm_ros.core.dynamics.response_band import response_band
from omsm_ros.core.fitting.preparation import prepare
from omsm_ros.core.identification.departure_search import search
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.identification.model_choice import model_from_start


def walk(size, seed=3):
    steps = np.random.default_rng(seed).normal(0, size * np.sqrt(PERIOD), len(TIME))
    return np.cumsum(steps)


def test_drift_taken_for_noise_comes_back_into_the_residual():
    searched = search(prepare(late_record(-walk(15e-9)), "encoder"), model_from_start)
    drift = [b.columns for b in searched.beside if b.term.family == DRIFT]
    survey = searched.survey
    bare = without_drift(survey, drift)
    columns = survey.problem.background[survey.problem.used]
    modelled = sum(columns[:, part] @ survey.fitted.background[part] for part in drift)
    assert bare.fitted.residual - survey.fitted.residual == pytest.approx(modelled, abs=1e-15)
    kept = survey.problem.background.shape[1] - sum(part.stop - part.start for part in drift)
    assert bare.problem.background.shape[1] == len(bare.fitted.background) == kept
    assert isinstance(bare, Survey)
    # Of micrometres of relaxation a drift of nanometres hides a small part.
    alone, both = (hidden_terms(survey, part)[0] for part in ((), drift))
    assert both.carried * both.effect < 0.5 * alone.carried * alone.effect


def test_a_machine_that_wanders_a_little_is_calibrated():
    """6 nm in a second: the response is known, and what it is open by is said."""
    calibration = identify(late_record(-walk(6e-9))).calibration
    assert str(calibration.certificate["verdict"]).startswith("accepted with reservations")
    at = np.array([1.0])
    off = abs(calibration.dynamics.response(at) * np.exp(2j * np.pi * at * LAG) - 1)
    band = response_band(calibration.dynamics, calibration.covariance, at)
    assert off[0] < 3 * band.gain[0]
    assert off[0] < 1e-4


@pytest.mark.parametrize(
    "records",
    [3.0, pytest.param(1.0, marks=pytest.mark.soak), pytest.param(5.0, marks=pytest.mark.soak)],
)
def test_the_band_holds_a_relaxation_that_only_begins_in_the_record(records):
    """It looks like a drift; of 0.1 % of the motion all is missing at 1 Hz."""
    size = 1e-3
    crept = size * (relaxed(LATE, PERIOD / (records * TIME[-1])) - LATE)
    calibration = identify(late_record(-crept)).calibration
    at = np.array([1.0])
    truth = (1 - size) * np.exp(-2j * np.pi * at * LAG)
    off = abs(calibration.dynamics.response(at) / truth - 1)[0]
    band = response_band(calibration.dynamics, calibration.covariance, at)
    assert off == pytest.approx(size, rel=0.3)
    assert off < 3 * float(np.hypot(band.gain, band.phase)[0])
