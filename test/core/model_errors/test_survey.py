"""Test the diagnostics: p-values, evidence, order of families, families left out."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.recorded import record_from_arrays
from omsm_ros.core.identification.response_uncertainty import reference_lag
from omsm_ros.core.model_errors.families import (
    BACKLASH,
    CREEP,
    DRIFT,
    PERIODIC,
    STIFFENING,
    VIBRATION,
    ModelErrorTerm,
)
from omsm_ros.core.model_errors.residual_diagnostics import FALSE_ALARM, Score, ScoreTest


def judged(chi_square, degrees=2, trials=1.0):
    score = Score(np.zeros(degrees), np.eye(degrees), chi_square, degrees)
    return ScoreTest(ModelErrorTerm("any", 0.0, trials, np.zeros((4, degrees))), score)


def test_a_term_found_among_many_is_as_many_times_as_likely_by_chance():
    assert judged(30.0, trials=50.0).log_p == pytest.approx(-15 + np.log(50))
    assert judged(30.0).log_p == pytest.approx(-15)


def test_chance_below_the_false_alarm_is_significant_and_no_more():
    limit = -2 * np.log(FALSE_ALARM)
    assert judged(limit + 0.01).significant
    assert not judged(limit - 0.01).significant
    assert not judged(limit + 0.01, trials=2.0).significant


def test_evidence_is_half_the_chi_square_less_the_price_of_the_coefficients():
    for degrees in (1, 2, 5):
        assert judged(40.0, degrees).evidence(1000) == pytest.approx(
            20 - degrees * np.log(1000) / 2
        )


def test_the_clearest_comes_first_and_those_named_are_left_out(step_test_of):
    time = step_test_of.time
    diagnostics = step_test_of.diagnostics(
        200e-9 * np.sin(2 * np.pi * 40 * time) + 20e-9 * (2 * time / time[-1] - 1) ** 2,
        only=(VIBRATION, DRIFT, STIFFENING),
    )
    found = diagnostics.significant()
    assert found[0].term.family == VIBRATION
    assert [diagnostics.evidence(one) for one in found] == sorted(
        map(diagnostics.evidence, found), reverse=True
    )
    assert VIBRATION not in {one.term.family for one in diagnostics.significant(but=(VIBRATION,))}
    assert set(diagnostics.best) <= {VIBRATION, DRIFT, STIFFENING}
    assert diagnostics.evidence(found[0]) == pytest.approx(
        found[0].evidence(diagnostics.fitted.samples)
    )


@pytest.mark.parametrize("degree", [2, 4])
def test_of_several_drifts_that_bends_enough_and_no_more(step_test_of, degree):
    time = 2 * step_test_of.time / step_test_of.time[-1] - 1
    wave = np.polynomial.legendre.legval(time, [0.0] * degree + [1.0])
    best = step_test_of.diagnostics(12e-9 * wave, 2, only=(DRIFT,)).best[DRIFT]
    assert best.term.columns.shape[1] == degree - 1
    assert best.score.size[-1] == pytest.approx(-12e-9, rel=0.3)


def test_a_period_between_those_of_the_travel_is_found(step_test_of):
    travel = np.ptp(step_test_of.late)
    period = travel / 7.45
    added = 40e-9 * np.sin(2 * np.pi * step_test_of.late / period)
    best = step_test_of.diagnostics(added, only=(PERIODIC,)).best[PERIODIC]
    assert best.significant
    assert best.term.parameter == pytest.approx(period, rel=0.02)


def test_backlash_by_steps_is_distinguished_from_none_by_its_size(step_test_of):
    half, state, added = 40e-9, step_test_of.late[0], []
    for value in step_test_of.late:
        state = min(max(state, value - half), value + half)
        added.append(state - value)
    best = step_test_of.diagnostics(np.array(added), only=(BACKLASH,)).best[BACKLASH]
    assert best.significant
    assert best.score.size[0] == pytest.approx(half, rel=0.15)


def test_every_relaxation_is_judged_by_its_first_column_alone(clean):
    found = clean.creep
    assert [one.term.parameter for one in found] == pytest.approx(
        clean.model_errors.time_constants()
    )
    for one in found[::3]:
        assert one.term.family == CREEP
        alone = clean.space.score(one.term.columns[:, :1])
        assert one.score.size == pytest.approx(alone.size)
        assert len(one.score.size) == 1


class TestIndependence:
    def test_what_follows_the_rate_is_no_chance(self, step_test_of):
        rate = np.gradient(step_test_of.late)
        later = np.roll(rate, 12) * (np.arange(len(rate)) > 25)
        curved = 60e-9 * (later / np.max(abs(later))) ** 3
        assert step_test_of.diagnostics(curved).independence < 1e-6

    def test_what_follows_nothing_is(self, step_test_of):
        chances = [step_test_of.diagnostics(seed=seed).independence for seed in range(8)]
        assert np.all((np.array(chances) > 0) & (np.array(chances) <= 1))
        assert np.median(chances) > 0.05

    def test_a_motion_at_rest_is_followed_by_nothing(self, clean):
        still = replace(clean.problem, input=np.zeros(len(clean.problem.input)))
        assert replace(clean, problem=still).independence == 1.0


@pytest.mark.parametrize("edges", [0, 1])
def test_without_two_edges_a_plateau_is_the_whole_record(clean, edges):
    few = replace(clean.steps, edges=clean.steps.edges[:edges])
    assert replace(clean, steps=few).plateau == pytest.approx(3.5)


class TestReferenceLag:
    TIME = np.arange(4000) * 1e-3
    Z = 20e-6 * np.sin(2 * np.pi * 1.3 * TIME)

    def record(self, reference, z=None):
        z = self.Z if z is None else z
        return record_from_arrays(1e-3, z, np.zeros(len(z)), reference=reference)

    def test_without_a_reference_there_is_none(self):
        assert reference_lag(self.record(None)) is None

    def test_too_little_of_it_says_nothing(self):
        reference = np.where(self.TIME < 0.049, self.Z, np.nan)
        assert np.count_nonzero(np.isfinite(reference)) == 49
        assert reference_lag(self.record(reference)) is None

    def test_one_that_does_not_move_has_none(self):
        assert reference_lag(self.record(np.zeros(4000))) is None

    def test_offset_drift_scale_and_holes_in_either_leave_the_lag(self):
        """The lag is small against the period, so that the first order suffices."""
        late = 150e-6
        reference = -0.5 * 20e-6 * np.sin(2 * np.pi * 1.3 * (self.TIME - late))
        reference += 3e-3 + 2e-6 * self.TIME
        reference[500:700] = np.nan
        z = self.Z.copy()
        z[1200:1300] = np.nan  # where it is bridged, and so wrong
        found = reference_lag(self.record(reference, z))
        assert found.value == pytest.approx(late, rel=1e-3)
        assert found.uncertainty < 1e-6

    def test_its_uncertainty_is_its_scatter(self):
        rng = np.random.default_rng(8)
        found = [
            reference_lag(self.record(self.Z + rng.normal(0, 50e-9, len(self.Z))))
            for _ in range(60)
        ]
        stated = np.mean([one.uncertainty for one in found])
        assert np.std([one.value for one in found]) == pytest.approx(stated, rel=0.3)
        rate = np.gradient(self.Z, 1e-3)
        assert stated == pytest.approx(50e-9 / np.sqrt(np.sum(rate**2)), rel=0.1)
