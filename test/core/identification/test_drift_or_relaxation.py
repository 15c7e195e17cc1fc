"""Slow changes during a test may be a drift, or the beginning of a relaxation."""

import numpy as np
import pytest
from late_steps import LAG, LATE, NOISE, PERIOD, TIME, late_record
from soaked import soaked

from omsm_ros.core.estimation.noise import RandomWalk
from omsm_ros.core.estimation.preparation import prepare
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.identification.model_choice import model_from_start
from omsm_ros.core.identification.model_error_search import search_model_errors
from omsm_ros.core.lti.frequency_response import response_band
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.model_errors.families import CREEP, DRIFT, FASTEST_CREEP_S, low_pass_response
from omsm_ros.core.model_errors.residual_diagnostics import FALSE_ALARM, ResidualDiagnostics
from omsm_ros.core.model_errors.undetected import (
    fitted_relaxation,
    undetected_terms,
    with_drift_as_noise,
)


def walk(size, seed=3):
    steps = np.random.default_rng(seed).normal(0, size * np.sqrt(PERIOD), len(TIME))
    return np.cumsum(steps)


def test_drift_taken_for_noise_comes_back_into_the_residual():
    searched = search_model_errors(prepare(late_record(-walk(15e-9)), "encoder"), model_from_start)
    drift = [b.columns for b in searched.nuisance_terms if b.term.family == DRIFT]
    diagnostics = searched.diagnostics
    bare = with_drift_as_noise(diagnostics, drift)
    columns = diagnostics.problem.background[diagnostics.problem.used]
    modelled = sum(columns[:, part] @ diagnostics.fitted.background[part] for part in drift)
    assert bare.fitted.residual - diagnostics.fitted.residual == pytest.approx(modelled, abs=1e-15)
    kept = diagnostics.problem.background.shape[1] - sum(part.stop - part.start for part in drift)
    assert bare.problem.background.shape[1] == len(bare.fitted.background) == kept
    assert isinstance(bare, ResidualDiagnostics)
    # A drift of nanometres can replace a small part of a relaxation of micrometres.
    free, as_noise = (max(map(open_to, one.creep)) for one in (diagnostics, bare))
    assert as_noise < 0.5 * free
    # The band takes no more than the least of what either says.
    worst = undetected_terms(diagnostics, drift)[0]
    assert worst.carried <= undetected_terms(diagnostics)[0].carried


def open_to(judged):
    return np.hypot(judged.score.size[0], judged.score.uncertainty)


@pytest.mark.parametrize(("seconds", "size"), [(80.0, 1e-3), *soaked((80.0, 3e-4), (120.0, 3e-4))])
def test_a_relaxation_of_minutes_that_looks_like_a_steady_drift_is_in_the_band(seconds, size):
    """In ten seconds it goes on evenly, by a nanometre, and is missing whole at 1 Hz."""
    crept = size * (low_pass_response(LATE, PERIOD / seconds) - LATE)
    assert sigmas(identify(late_record(-crept)).calibration, size) < 3


def test_only_a_significant_drift_can_mask_a_relaxation():
    quiet, drifting = (identify(late_record(rate * TIME)).calibration for rate in (0.0, 1e-9))
    at = np.array([1.0])
    still, open_ = (response_band(c.dynamics, c.covariance, at).gain[0] for c in (quiet, drifting))
    # The slope of a line through the readings is known to σ √(12 / n) / T, and over 50 s so is a
    # relaxation that moves by half the travel; gain and lag, fitted with it, cost the rest.
    samples, travel = len(TIME), np.ptp(LATE)
    known = NOISE * np.sqrt(12 / samples) / TIME[-1] * 50.0 / (0.5 * travel)
    assert known / 3 < still < 3 * known
    assert open_ > 3 * still


def test_a_machine_that_wanders_a_little_is_calibrated():
    """6 nm in a second: the response is known, and what it is open by is said."""
    calibration = identify(late_record(-walk(6e-9))).calibration
    assert {error.family for error in calibration.certificate.model_errors.modelled} <= {DRIFT}
    assert str(calibration.certificate.verdict).startswith("accepted with reservations")
    at = np.array([1.0])
    off = abs(calibration.dynamics.response(at) * np.exp(2j * np.pi * at * LAG) - 1)
    band = response_band(calibration.dynamics, calibration.covariance, at)
    assert off[0] < 3 * band.gain[0]
    assert off[0] < 1e-4


@pytest.mark.soak
@pytest.mark.parametrize("records", [1.0, 3.0, 5.0])
def test_the_band_holds_a_relaxation_that_only_begins_in_the_record(records):
    """It looks like a drift; of 0.1 % of the motion all is missing at 1 Hz."""
    size = 1e-3
    crept = size * (low_pass_response(LATE, PERIOD / (records * TIME[-1])) - LATE)
    calibration = identify(late_record(-crept)).calibration
    assert sigmas(calibration, size) < 3


def sigmas(calibration, size):
    """Return the error at 1 Hz over its uncertainty, where the whole relaxation is missing."""
    at = np.array([1.0])
    truth = (1 - size) * np.exp(-2j * np.pi * at * LAG)
    off = abs(calibration.dynamics.response(at) / truth - 1)[0]
    band = response_band(calibration.dynamics, calibration.covariance, at)
    assert off == pytest.approx(size, rel=0.3)
    return off / float(np.hypot(band.gain, band.phase)[0])


@pytest.mark.parametrize("share", [3e-4, -2e-3])
def test_the_share_of_slow_poles_is_their_partial_fraction(share):
    """ε/(1 + sτ) + (1 - ε)/(1 + sT): only the first is slower than a structure's."""
    slow, fast = 4 * FASTEST_CREEP_S, 0.5 * FASTEST_CREEP_S
    numerator = [1.0, share * fast + (1 - share) * slow]
    whole = TransferFunction.from_ascending(numerator, [1.0, slow + fast, slow * fast])
    assert fitted_relaxation(whole) == pytest.approx(abs(share), rel=1e-9)


@pytest.mark.soak
def test_next_to_a_relaxation_lag_and_roll_off_stay_independent():
    """With a lag alone beside it the band would close at the upper end, where nothing is known.

    The relaxation is weighed against drift: the choice of the order does not make a pole of it.
    """
    crept = 1e-2 * (low_pass_response(LATE, PERIOD / 0.3) - LATE)
    searched = search_model_errors(prepare(late_record(-crept), "encoder"), model_from_start)
    assert [term.family for term in searched.added_poles] == [CREEP]
    assert fitted_relaxation(searched.model.chosen.fit.dynamics) == pytest.approx(1e-2, rel=0.02)
    pole_and_zero, lag_and_roll_off = 2, 3
    structure = searched.model.chosen.fit.structure
    assert structure.size >= pole_and_zero + lag_and_roll_off


@pytest.mark.parametrize("seed", soaked(0, 1, 2))
def test_a_random_walk_is_no_relaxation_and_no_soft_mode(seed):
    """What polynomials leave of it has more power the slower it is; it is noise, not a response."""
    prepared = prepare(late_record(walk(4e-9, seed)), "encoder")
    searched = search_model_errors(prepared, model_from_start)
    assert not searched.added_poles
    assert searched.p_value > FALSE_ALARM
    assert {modelled.term.family for modelled in searched.nuisance_terms} <= {DRIFT}


def strongest_line(residual):
    """Return sine and cosine (2, n) at the strongest line with two periods or more in a record."""
    power = np.abs(np.fft.rfft(residual, 4 * len(residual))) ** 2
    angle = 2 * np.pi * (8 + np.argmax(power[8:])) / (4 * len(residual)) * np.arange(len(residual))
    return np.array([np.sin(angle), np.cos(angle)])


def test_the_rate_of_a_random_walk_is_estimated_beside_what_the_fit_follows():
    """Mean of 20 walks, against the rate with which they were drawn."""
    model = search_model_errors(prepare(late_record(0.0), "encoder"), model_from_start)
    space = model.diagnostics.space
    basis = np.linalg.qr(space.problem.sensitivity(space.fitted))[0]
    walks = RandomWalk.of(space.problem.used, basis, space.problem.recordings)
    rows, used = np.empty((0, len(TIME))), space.problem.used
    found = []
    for seed in range(20):
        noise = np.random.default_rng(seed).normal(0, NOISE, len(TIME))
        residual = np.where(used, walk(6e-9, seed) + noise, 0.0)
        found.append(walks.variance(residual, rows)[0])
        # The strongest line takes much of a walk; only one that is no part of it leaves less.
        line = strongest_line(residual) * used
        assert walks.variance(residual, line)[0] == found[-1]
        assert walks.variance(residual + 100e-9 * line[0], line)[0] < 1.5 * found[-1]
    assert np.mean(found) / (6e-9**2 * PERIOD) == pytest.approx(1, abs=0.2)
    assert walks.variance(np.where(used, noise, 0.0))[0] == 0
