"""Test the effect of omitted terms on G against new fits, and their sizes in closed form."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal, stats

from omsm_ros.core.calibration.intended_use import PAPER_USE
from omsm_ros.core.estimation.model_order import fit
from omsm_ros.core.lti.transfer_function import Structure, TransferFunction
from omsm_ros.core.model_errors.families import CREEP, MODE, STIFFENING
from omsm_ros.core.model_errors.residual_diagnostics import FALSE_ALARM
from omsm_ros.core.model_errors.undetected import (
    UndetectedTerm,
    fitted_relaxation,
    omission_shift,
    undetected_terms,
    with_drift_as_noise,
    with_slow_creep,
)

SCAN_RMS = np.sqrt(np.sum(PAPER_USE.rms_m**2))


def coefficients(fitted):
    g = fitted.dynamics
    return np.concatenate([g.numerator, g.denominator[1:], [g.delay]])


def fitted_anew(diagnostics, structure, starts, added=0.0):
    problem = replace(diagnostics.problem, output=diagnostics.problem.output + added)
    return fit(problem, structure, starts)


@pytest.fixture(scope="module")
def with_a_pole(clean):
    found = fitted_anew(clean, Structure(1, 0, True), [np.array([0.1, 0.1]), np.array([1.0, 0.3])])
    return replace(clean, fitted=found)


class TestOmitted:
    @pytest.mark.parametrize("frequency", [2.0, 9.0])
    def test_it_is_what_fitting_anew_with_the_term_in_the_data_gives(self, clean, frequency):
        mode = clean.model_errors.modes([(frequency, 0.1)]).part(0, 1)[:, 0]
        size = 1e-4
        anew = fitted_anew(clean, Structure(0, 0, True), [clean.fitted.nonlinear], size * mode)
        found = coefficients(anew) - coefficients(clean.fitted)
        expected = size * omission_shift(clean, mode)
        assert found == pytest.approx(expected, rel=0.02, abs=1e-9)
        assert abs(expected[-1]) > 1e-9

    def test_with_a_pole_too(self, with_a_pole):
        mode = with_a_pole.model_errors.modes([(6.0, 0.1)]).part(0, 1)[:, 0]
        size = 1e-5
        start = [with_a_pole.fitted.nonlinear]
        before, after = (
            fitted_anew(with_a_pole, Structure(1, 0, True), start, part * mode)
            for part in (-size, size)
        )
        found = (coefficients(after) - coefficients(before)) / 2
        assert found == pytest.approx(size * omission_shift(with_a_pole, mode), rel=0.1, abs=1e-9)

    def test_what_the_background_holds_shifts_nothing(self, clean):
        shift = omission_shift(clean, clean.problem.background @ np.array([3e-9, 5e-9]))
        assert np.max(abs(shift)) < 1e-15

    def test_a_delay_of_the_answer_is_a_shift_of_the_delay(self, clean):
        answer = clean.fitted.gain * clean.problem.response(clean.fitted)
        shift = omission_shift(clean, -np.gradient(answer, clean.problem.period))
        assert shift[-1] == pytest.approx(1.0, rel=0.01)

    def test_it_is_linear(self, clean):
        one, other = clean.model_errors.modes([(5.0, 0.1)]).part(0, 1).T
        np.testing.assert_allclose(
            omission_shift(clean, 2 * one - other),
            2 * omission_shift(clean, one) - omission_shift(clean, other),
        )


class TestSizes:
    def term(self, **changed):
        whole = {
            "family": CREEP, "parameter": 1.0, "size": 3e-4, "uncertainty": 4e-4, "missed": 1.0,
            "shift": np.array([1.0, -2.0, 0.5]), "gain": np.array([1.0, 0.0, 0.0]),
            "late": np.array([0.0, 0.0, 1.0]), "above": 0.5, "lag": 2e-3, "effect": 1e-5,
        }  # fmt: skip
        return UndetectedTerm(**(whole | changed))

    def test_carried_are_size_and_uncertainty_together(self):
        assert self.term().carried == pytest.approx(5e-4)

    def test_the_covariance_is_that_of_three_independent_shifts(self):
        term = self.term()
        rng = np.random.default_rng(1)
        drawn = 5e-4 * rng.normal(size=(200_000, 3))
        shifts = drawn @ np.array([term.shift, 0.5 * term.gain, 2e-3 * term.late])
        np.testing.assert_allclose(term.covariance(5e-4), np.cov(shifts.T), rtol=0.03, atol=1e-9)

    def test_a_size_twice_as_unsure_is_four_times_the_covariance(self):
        np.testing.assert_allclose(self.term().covariance(2.0), 4 * self.term().covariance(1.0))
        assert not self.term().covariance(0.0).any()


class TestRelaxationFound:
    @staticmethod
    def shares(found):
        """Return the share of G(0) of poles slower than 20 ms, by partial fractions."""
        parts, poles, _ = signal.residue(found.numerator[::-1], found.denominator[::-1])
        slow = (abs(poles.imag) < 1e-9) & (-poles.real < 50)
        return sum(abs(-part / pole) for part, pole in zip(parts[slow], poles[slow], strict=True))

    @pytest.mark.parametrize("sizes", [(0.01, -0.004), (0.2, 0.3), (1e-4, 2e-3)])
    def test_the_shares_of_several_add_up_whatever_their_sign(self, sizes):
        fast = 1.2e-3
        slow = (0.7, 0.09)
        bottom = np.polynomial.Polynomial([1.0])
        for time in (fast, *slow):
            bottom *= np.polynomial.Polynomial([1.0, time])
        top = np.polynomial.Polynomial([0.0])
        for share, time in zip((1 - sum(sizes), *sizes), (fast, *slow), strict=True):
            others = [t for t in (fast, *slow) if t != time]
            term = np.polynomial.Polynomial([share])
            for other in others:
                term *= np.polynomial.Polynomial([1.0, other])
            top += term
        found = TransferFunction.from_ascending(top.coef, bottom.coef)
        assert fitted_relaxation(found) == pytest.approx(sum(map(abs, sizes)), rel=1e-6)
        assert fitted_relaxation(found) == pytest.approx(self.shares(found), rel=1e-6)

    def test_a_fast_pole_and_a_pair_of_slow_ones_are_none(self):
        assert fitted_relaxation(TransferFunction.from_ascending([1.0], [1.0, 15e-3])) == 0.0
        ringing = TransferFunction.from_ascending([1.0], [1.0, 0.02, 0.02])
        assert fitted_relaxation(ringing) == 0.0
        # It is the response of a slow probe.
        assert fitted_relaxation(TransferFunction.from_ascending([1.0], [1.0, 25e-3])) == 0.0


@pytest.fixture(scope="module")
def undetected(clean):
    return undetected_terms(clean)


class TestDiagnosticsOfUndetectedTerms:
    def test_relaxations_up_to_a_minute_are_looked_for_or_to_ten_records(self, clean):
        assert with_slow_creep(clean).longest_time_constant == pytest.approx(35.0)
        period = clean.problem.period
        longer = replace(clean, problem=replace(clean.problem, period=10 * period))
        assert with_slow_creep(longer).longest_time_constant == pytest.approx(50.0)
        longest = replace(clean, problem=replace(clean.problem, period=30 * period))
        assert with_slow_creep(longest).longest_time_constant == pytest.approx(105.0)

    def test_a_drift_taken_for_noise_is_in_the_residual_and_no_column(self, clean):
        moved = with_drift_as_noise(clean, [slice(1, 2)])
        assert moved.problem.background.shape[1] == clean.problem.background.shape[1] - 1
        drifted = clean.problem.background[:, 1] * clean.fitted.background[1]
        added = moved.fitted.residual - clean.fitted.residual
        np.testing.assert_allclose(added, drifted[clean.problem.used])
        whole = clean.problem.modelled(clean.fitted)[clean.problem.used] + clean.fitted.residual
        same = moved.problem.modelled(moved.fitted)[clean.problem.used] + moved.fitted.residual
        np.testing.assert_allclose(same, whole, atol=1e-15)

    def test_a_slow_relaxation_is_surer_without_a_drift_of_any_size(self, clean):
        free = with_slow_creep(clean).creep[-1].score.uncertainty
        held = (
            with_drift_as_noise(with_slow_creep(clean), [slice(1, 2)]).creep[-1].score.uncertainty
        )
        assert held < 0.5 * free

    def test_of_relaxations_the_worst_comes_first_and_costs_no_more_than_all_of_it(
        self, undetected
    ):
        worst, *others = undetected
        assert worst.family == CREEP
        assert 0 < worst.above <= 1.05
        assert 0 < worst.effect < 1.05 * SCAN_RMS
        assert {term.family for term in others} <= {CREEP, MODE, STIFFENING}
        assert not worst.shift.any()

    def test_what_would_be_missed_is_the_alarm_and_five_per_cent_of_the_normal(
        self, clean, undetected
    ):
        worst = undetected[0]
        found = with_slow_creep(clean).creep
        (alone,) = [j for j in found if j.term.parameter == worst.parameter]
        alarm = stats.norm.isf(FALSE_ALARM / 3 / 2)
        expected = (alarm + stats.norm.isf(0.05)) * alone.score.uncertainty
        assert worst.missed == pytest.approx(expected, rel=1e-3)

    def test_the_gain_scales_and_the_lateness_delays_the_whole_response(self, with_a_pole):
        worst = undetected_terms(with_a_pole)[0]
        g = with_a_pole.fitted.dynamics
        assert worst.gain == pytest.approx([*g.numerator, *np.zeros(len(g.denominator))])
        assert worst.late == pytest.approx([*np.zeros(len(worst.gain) - 1), 1.0])

    def test_a_stiffness_bends_coefficients_by_what_is_omitted(self, clean, undetected):
        (stiff,) = [term for term in undetected if term.family == STIFFENING]
        column = clean.model_errors.stiffening().term(0).columns[:, 0]
        np.testing.assert_allclose(stiff.shift, omission_shift(clean, column))
        assert (stiff.above, stiff.lag) == (0.0, 0.0)
