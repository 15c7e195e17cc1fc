"""Test the columns of the families against differential equations and closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from omsm_ros.core.estimation.steps import Steps
from omsm_ros.core.model_errors.families import (
    BACKLASH,
    CREEP,
    DRIFT,
    FRICTION,
    LINEARITY,
    MODE,
    PERIODIC,
    STIFFENING,
    VIBRATION,
    ModelErrorFamilies,
    ModelErrorFamily,
    low_pass_response,
)


@pytest.fixture(scope="module")
def model_errors(clean):
    return clean.model_errors


@pytest.fixture(scope="module")
def answer(clean):
    """Return the motion through the fitted G and gain."""
    return clean.fitted.gain * clean.problem.response(clean.fitted)


def through(numerator, denominator, values, period):
    """Return the response from rest to linear segments, by the state space."""
    time = np.arange(len(values)) * period
    return signal.lsim((numerator, denominator), values - values[0], time)[1]


class TestRelaxation:
    @pytest.mark.parametrize("time_constant", [3e-3, 0.05, 2.0, 400.0])
    def test_it_is_its_differential_equation(self, time_constant, answer, step_test_of):
        found = low_pass_response(answer, step_test_of.period / time_constant)
        expected = through([1.0], [time_constant, 1.0], answer, step_test_of.period)
        np.testing.assert_allclose(found, answer[0] + expected, atol=1e-9 * np.ptp(answer))

    def test_it_is_linear_and_keeps_what_rests(self):
        rng = np.random.default_rng(1)
        one, other = rng.normal(size=(2, 60))
        np.testing.assert_allclose(
            low_pass_response(2 * one - 3 * other, 0.1),
            2 * low_pass_response(one, 0.1) - 3 * low_pass_response(other, 0.1),
        )
        np.testing.assert_allclose(low_pass_response(np.full(5, 4.0), 0.3), 4.0)

    def test_what_is_fast_follows_and_what_is_slow_stays(self):
        values = np.random.default_rng(2).normal(size=50)
        np.testing.assert_allclose(low_pass_response(values, 1e4), values, atol=1e-3)
        np.testing.assert_allclose(low_pass_response(values, 1e-7), values[0], atol=1e-4)

    def test_the_time_constants_reach_from_a_structures_to_the_record(self, clean, model_errors):
        found = model_errors.time_constants()
        assert found[0] == pytest.approx(20e-3)
        assert found[-1] == pytest.approx(model_errors.duration) == pytest.approx(3.5)
        assert np.max(found[1:] / found[:-1]) < 1.7
        longer = replace(model_errors, slower=10.0).time_constants()
        assert longer[-1] == pytest.approx(35.0)
        assert replace(clean, slower=10.0).longest_time_constant == pytest.approx(35.0)

    def test_its_columns_are_the_model_error_and_its_derivative(self, model_errors, answer):
        family, period = model_errors.creep(), model_errors.problem.period
        assert family.width == 2
        for index in range(0, len(family.parameters), 4):
            term = family.term(index)
            assert (term.family, term.damping) == (CREEP, 0.0)
            first, second = term.columns.T
            step = period / term.parameter
            np.testing.assert_allclose(first, low_pass_response(answer, step) - answer, atol=1e-12)
            h = 1e-4
            slope = (
                (
                    low_pass_response(answer, step * np.exp(-h))
                    - low_pass_response(answer, step * np.exp(h))
                )
                / 2
                / h
            )
            # A relaxation of a relaxation is drawn straight from sample to sample twice.
            np.testing.assert_allclose(second, slope, atol=2 * step**2 * np.ptp(answer) + 1e-12)


class TestModes:
    @pytest.mark.parametrize(("frequency", "damping"), [(8.0, 0.1), (11.0, 0.2)])
    def test_a_mode_and_its_velocity_are_their_differential_equation(
        self, model_errors, answer, frequency, damping
    ):
        model_error, velocity = model_errors.modes([(frequency, damping)]).part(0, 1).T
        omega, period = 2 * np.pi * frequency, model_errors.problem.period
        bottom = [omega**-2, 2 * damping / omega, 1.0]
        moved = through([1.0], bottom, answer, period)
        fast = through([1 / omega, 0.0], bottom, answer, period)
        expected = moved - (answer - answer[0])
        # Between samples one is straight, the other band-limited.
        tolerance = 5e-4 * np.ptp(answer)
        np.testing.assert_allclose(model_error, expected, atol=tolerance)
        np.testing.assert_allclose(velocity, fast, atol=tolerance)

    def test_modes_cover_their_band_and_stand_as_they_are_alone(self, model_errors):
        family = model_errors.modes()
        dampings = np.unique(family.dampings)
        assert len(dampings) == 2
        for damping in dampings:
            lines = family.parameters[family.dampings == damping]
            assert lines[0] == pytest.approx(2 / model_errors.duration)
            assert np.all(np.diff(np.log(lines)) < 2.5 * damping)
            assert lines[-1] <= 100.0
        for index in (0, len(family.parameters) - 1):
            term = family.term(index)
            alone = model_errors.modes([(term.parameter, term.damping)]).part(0, 1)
            np.testing.assert_allclose(term.columns, alone, atol=1e-18)


class TestLines:
    def with_residual(self, clean, values):
        fitted = replace(clean.fitted, residual=values[clean.problem.used])
        return ModelErrorFamilies(clean.problem, fitted, clean.steps)

    def test_the_strongest_lines_are_found_in_their_order_by_sine_and_cosine(
        self, clean, step_test_of
    ):
        time = step_test_of.time
        lines = (17.31, 60.77, 141.03)
        values = sum((3 - k) * np.sin(2 * np.pi * f * time + k) for k, f in enumerate(lines))
        family = self.with_residual(clean, values).vibration()
        # A hundredth of the 0.29 Hz between the lines of the record.
        assert family.parameters == pytest.approx(lines, abs=5e-3)
        angle = 2 * np.pi * family.parameters[1] * time
        np.testing.assert_allclose(family.term(1).columns, np.c_[np.sin(angle), np.cos(angle)])

    def test_what_is_slower_than_two_periods_is_no_line(self, clean, step_test_of):
        time = step_test_of.time
        slow = 2 * np.sin(2 * np.pi * 1.2 * time / time[-1])
        family = self.with_residual(clean, slow + np.sin(2 * np.pi * 40 * time)).vibration()
        assert np.min(abs(family.parameters - 40)) < 0.02
        assert np.min(family.parameters) > 1.9 / 3.5

    def test_drifts_bend_and_neither_shift_nor_tilt(self, model_errors):
        families = list(model_errors.drift())
        time = np.linspace(-1, 1, len(model_errors.problem.input))
        for family in families:
            degree = round(model_errors.duration / family.parameters[0])
            assert (family.name, family.term(0).columns.shape[1]) == (DRIFT, degree - 1)
            # With offset and tilt they make any polynomial of that degree.
            every = np.column_stack([np.ones(len(time)), time, family.term(0).columns])
            power = time**degree
            left = power - every @ np.linalg.lstsq(every, power, rcond=None)[0]
            assert np.max(abs(left)) < 1e-9
            assert abs(np.trapezoid(family.term(0).columns, time, axis=0)).max() < 1e-3
        assert [f.term(0).columns.shape[1] for f in families] == [1, 2, 3, 5, 7]


class TestOfThePosition:
    def test_a_curved_probe_is_square_and_cube_of_the_place_that_it_sees(
        self, model_errors, answer
    ):
        motion, seen = model_errors.problem.input, answer / model_errors.fitted.gain
        place = (seen - np.mean([motion.min(), motion.max()])) / (np.ptp(motion) / 2)
        columns = model_errors.linearity().term(0).columns
        np.testing.assert_allclose(columns, np.column_stack([place**2, place**3]), atol=1e-9)
        assert np.max(abs(columns)) == pytest.approx(1.0, abs=1e-3)

    def test_an_axis_at_rest_bends_nothing(self, clean):
        still = replace(clean.problem, input=np.zeros(len(clean.problem.input)))
        assert (
            not ModelErrorFamilies(still, clean.fitted, clean.steps)
            .linearity()
            .term(0)
            .columns.any()
        )

    def test_what_stiffens_is_the_cube_of_what_the_probe_is_behind(self, model_errors, answer):
        (column,) = model_errors.stiffening().term(0).columns.T
        behind = answer / model_errors.fitted.gain - model_errors.problem.input
        assert np.max(abs(column)) == pytest.approx(1.0)
        line = np.polyfit(np.cbrt(column), behind, 1)
        np.testing.assert_allclose(
            np.polyval(line, np.cbrt(column)), behind, atol=1e-6 * np.ptp(behind)
        )

    @pytest.mark.parametrize("near", [None, 1e-6])
    def test_a_periodic_error_is_sine_and_cosine_of_the_place(self, model_errors, answer, near):
        family = model_errors.periodic(near)
        place = answer / model_errors.fitted.gain
        assert len(family.parameters) > 9
        for index in range(0, len(family.parameters), 9):
            term = family.term(index)
            angle = 2 * np.pi * place / term.parameter
            np.testing.assert_allclose(
                term.columns, np.column_stack([np.sin(angle), np.cos(angle)]), atol=1e-9
            )

    def test_periods_reach_from_a_third_of_the_travel_and_then_about_one(self, model_errors):
        travel = np.ptp(model_errors.problem.input)
        periods = model_errors.periodic().parameters
        assert periods[0] == pytest.approx(travel / 3, rel=1e-3)
        assert np.diff(travel / periods) == pytest.approx(1.0, rel=1e-3)
        between = model_errors.periodic(periods[20]).parameters
        assert periods[20] == pytest.approx(between[len(between) // 2])
        assert np.all((between < periods[19]) & (between > periods[21]))


class TestWhichFamilies:
    EVERY = (CREEP, MODE, VIBRATION, DRIFT, LINEARITY, STIFFENING, PERIODIC, FRICTION, BACKLASH)

    def test_a_step_test_shows_all_of_them(self, model_errors):
        assert {family.name for family in model_errors.families()} == set(self.EVERY)

    @pytest.mark.parametrize("only", [(CREEP,), (BACKLASH, DRIFT), (LINEARITY, STIFFENING)])
    def test_those_named_come_alone(self, model_errors, only):
        assert {family.name for family in model_errors.families(only)} == set(only)

    def test_a_motion_without_edges_shows_neither_friction_nor_backlash(self, clean):
        moving = np.ones(len(clean.problem.input), bool)
        endless = Steps((), moving, clean.steps.noise, clean.steps.travel)
        found = ModelErrorFamilies(clean.problem, clean.fitted, endless)
        assert not list(found.families((FRICTION, BACKLASH)))

    def test_friction_and_gap_have_the_size_of_a_force_and_of_a_lead(self, model_errors):
        largest = [
            np.max(abs(family.part(0, len(family.parameters))))
            for family in model_errors.families((FRICTION, BACKLASH))
        ]
        assert largest == pytest.approx([1.0, 1.0], rel=0.01)

    def test_what_a_gap_loses_is_what_the_probe_does_not_follow(self, model_errors, step_test_of):
        """Compare half a backlash of 300 nm with the play operator on the true motion."""
        (of_travel,) = model_errors.families((BACKLASH,))
        half, state, lost = 150e-9, step_test_of.late[0], []
        for value in step_test_of.late:
            state = min(max(state, value - half), value + half)
            lost.append((state - value) / half)
        (index,) = np.flatnonzero(of_travel.parameters == 300e-9)
        column, start = of_travel.term(int(index)).columns.T
        # The probe reads the other way; the encoder's noise moves what is lost by a hundredth.
        found = column / model_errors.fitted.gain
        moved = abs(np.array(lost)) > 0.99
        np.testing.assert_allclose(found[moved], np.array(lost)[moved], atol=0.03)
        assert start[0] == pytest.approx(-model_errors.fitted.gain)

    def test_a_term_has_its_columns_in_another_fit(self, clean, step_test_of):
        other = step_test_of.diagnostics(seed=9).model_errors
        every = list(clean.model_errors.families((CREEP, PERIODIC, LINEARITY)))
        assert len(every) == 3
        for family in every:
            term = family.term(0)
            again = other.again(term)
            assert (again.family, again.damping) == (term.family, term.damping)
            if family.name == PERIODIC:  # its periods are parts of each fit's own travel
                assert again is term
            else:
                assert again.parameter == term.parameter
                scale = np.max(abs(term.columns))
                np.testing.assert_allclose(again.columns, term.columns, atol=2e-3 * scale)


def test_a_family_gives_its_terms_with_their_own_columns():
    columns = np.arange(12.0).reshape(2, 6)
    made = ModelErrorFamily.of("some", np.array([5.0, 7.0, 9.0]), 2.5, columns)
    family = replace(made, dampings=np.array([0.1, 0.2, 0.3]))
    term = family.term(1)
    assert (family.width, term.parameter, term.damping, term.trials) == (2, 7.0, 0.2, 2.5)
    np.testing.assert_array_equal(term.columns, [[2.0, 3.0], [8.0, 9.0]])
