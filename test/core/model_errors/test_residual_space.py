"""Test the score test against least squares of all columns (theorem of Frisch and Waugh)."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import special

from omsm_ros.core.model_errors.residual_diagnostics import (
    ResidualSpace,
    Score,
    smooth_noise_spectrum,
)


def columns_like(diagnostics, count, seed=3):
    """Return smooth columns; half of them correlate with those of the fit."""
    time = np.linspace(0, 1, len(diagnostics.problem.input))
    rng = np.random.default_rng(seed)
    waves = [np.sin(2 * np.pi * f * time + p) for f, p in rng.uniform(2, 40, (count, 2))]
    return np.column_stack(
        [w + diagnostics.problem.input * 3e4 * (k % 2) for k, w in enumerate(waves)]
    )


def at_once(diagnostics, columns):
    """Return coefficients of ``columns`` fitted with all parameters, and the sum of squares."""
    used = diagnostics.problem.used
    every = np.column_stack([diagnostics.problem.sensitivity(diagnostics.fitted), columns[used]])
    scale = np.linalg.norm(every, axis=0)
    found = np.linalg.lstsq(every / scale, diagnostics.fitted.residual, rcond=1e-12)[0]
    left = diagnostics.fitted.residual - every / scale @ found
    return (found / scale)[-columns.shape[1] :], float(left @ left)


@pytest.fixture(scope="module")
def holed(step_test_of):
    return step_test_of.diagnostics(lost=[*range(300, 330), 900, 1500])


def projected_by(space, columns):
    """Return ``columns`` (n, c) projected orthogonally to the fit, where compared, (k, c)."""
    rows = columns.T.copy()
    space._free(rows)
    return rows[:, space.problem.used].T


class TestWhatIsFree:
    def test_it_is_at_right_angles_to_all_that_the_fit_may_change(self, holed):
        space = holed.space
        projected = projected_by(space, columns_like(holed, 4))
        moved = holed.problem.sensitivity(holed.fitted)
        cosines = (projected / np.linalg.norm(projected, axis=0)).T @ (
            moved / np.linalg.norm(moved, axis=0)
        )
        assert len(projected) == holed.fitted.samples < len(holed.problem.input)
        assert np.max(abs(cosines)) < 1e-9

    def test_what_the_fit_imitates_adds_nothing(self, clean):
        columns = columns_like(clean, 2)
        moved = np.zeros((len(columns), 1))
        moved[clean.problem.used] = clean.problem.sensitivity(clean.fitted)[:, :1]
        moved *= np.linalg.norm(columns[:, 0]) / np.linalg.norm(moved)
        np.testing.assert_allclose(
            projected_by(clean.space, columns + 5 * moved),
            projected_by(clean.space, columns),
            atol=1e-9,
        )


class TestScore:
    def test_its_size_is_that_of_least_squares_of_everything(self, holed):
        for count in (1, 2, 3):
            columns = columns_like(holed, count)
            assert holed.space.score(columns).size == pytest.approx(
                at_once(holed, columns)[0], rel=1e-6
            )

    def test_in_white_noise_its_covariance_is_that_of_least_squares(self, clean, step_test_of):
        columns = columns_like(clean, 3)
        projected = projected_by(clean.space, columns)
        expected = step_test_of.noise**2 * np.linalg.inv(projected.T @ projected)
        score = clean.space.score(columns)
        # The level of noise beside each line is known to a quarter, and taken large.
        ratio = np.diag(score.covariance) / np.diag(expected)
        assert np.all((ratio > 0.8) & (ratio < 2.0))
        assert score.uncertainty == pytest.approx(np.sqrt(score.covariance[0, 0]))

    def test_units_and_mixtures_of_its_columns_change_no_chance(self, clean):
        columns = columns_like(clean, 2)
        plain = clean.space.score(columns)
        mixture = np.array([[1.0, 2.0], [-3.0, 1.0]]) * [1e-6, 1e3]
        mixed = clean.space.score(columns @ mixture)
        assert mixed.chi_square == pytest.approx(plain.chi_square, rel=1e-6)
        assert mixed.size == pytest.approx(np.linalg.solve(mixture, plain.size), rel=1e-5)
        assert mixed.degrees == plain.degrees == 2

    def test_what_is_there_is_found_within_its_uncertainty(self, step_test_of):
        empty = step_test_of.diagnostics()
        wave = np.sin(2 * np.pi * 3.7 * step_test_of.time)[:, np.newaxis]
        pulls = []
        for seed in range(12):
            there = step_test_of.diagnostics(-30e-9 * wave[:, 0], seed)
            score = there.space.score(wave)
            pulls.append((score.size[0] - 30e-9) / score.uncertainty)
            assert score.log_p < -20
        assert abs(np.mean(pulls)) < 1.0
        assert np.sqrt(np.mean(np.square(pulls))) < 1.6
        assert empty.space.score(wave).log_p > -8

    def test_a_term_that_the_fit_imitates_is_unknown_and_tells_nothing(self, clean):
        imitated = clean.problem.background
        score = clean.space.score(imitated)
        assert score.degrees == 0
        assert (score.chi_square, score.log_p) == (0.0, 0.0)
        assert np.isinf(score.uncertainty)
        assert not score.size.any()

    def test_an_orthogonal_column_is_scored_as_if_it_were_alone(self, clean):
        free = columns_like(clean, 1)
        both = clean.space.score(np.column_stack([clean.problem.background[:, 0], free]))
        alone = clean.space.score(free)
        assert both.degrees == alone.degrees == 1
        assert both.chi_square == pytest.approx(alone.chi_square, rel=1e-9)
        assert both.size == pytest.approx([0.0, alone.size[0]], rel=1e-9)
        assert np.isinf(both.covariance[0, 0])
        assert both.covariance[1, 1] == pytest.approx(alone.covariance[0, 0], rel=1e-9, abs=0)

    def test_a_column_twice_is_one_coefficient_more_and_no_evidence_more(self, clean):
        free = columns_like(clean, 1)
        twice = clean.space.score(np.column_stack([free, free]))
        alone = clean.space.score(free)
        assert twice.degrees == alone.degrees
        assert twice.chi_square == pytest.approx(alone.chi_square, rel=1e-6)
        assert np.sum(twice.size) == pytest.approx(alone.size[0], rel=1e-6)

    def test_a_column_of_zeros_says_nothing(self, clean):
        score = clean.space.score(np.zeros((len(clean.problem.input), 1)))
        assert (score.degrees, score.log_p) == (0, 0.0)

    @pytest.mark.parametrize("chi_square", [0.5, 3.0, 200.0, 1300.0])
    def test_the_chance_of_two_coefficients_is_an_exponential(self, chi_square):
        two = Score(np.zeros(2), np.eye(2), chi_square, 2)
        assert two.log_p == pytest.approx(-chi_square / 2, rel=1e-9)
        one = Score(np.zeros(1), np.eye(1), chi_square, 1)
        expected = np.log(2) + special.log_ndtr(-np.sqrt(chi_square))
        assert one.log_p == pytest.approx(expected, rel=1e-9)


class TestScreen:
    @pytest.mark.parametrize("terms", [1, 2, 3])
    def test_it_is_what_each_group_takes_off_the_sum_of_squares(self, holed, terms):
        columns = columns_like(holed, 4 * terms)
        fitted = holed.fitted
        expected = [
            (fitted.sum_of_squares - at_once(holed, group)[1])
            / (fitted.sum_of_squares / fitted.samples)
            for group in np.split(columns, 4, axis=1)
        ]
        found = holed.space.screen(columns, terms)
        assert found == pytest.approx(expected, rel=1e-5, abs=1e-6)

    def test_the_true_one_of_many_is_first(self, step_test_of):
        frequencies = np.arange(2.0, 30.0, 0.5)
        angle = 2 * np.pi * np.outer(step_test_of.time, frequencies)
        diagnostics = step_test_of.diagnostics(15e-9 * np.sin(angle[:, 21] + 1))
        waves = np.stack([np.sin(angle), np.cos(angle)], axis=2).reshape(len(angle), -1)
        assert np.argmax(diagnostics.space.screen(waves, 2)) == 21


def noise_of(values, place, length):
    on_grid = np.zeros(length)
    on_grid[place] = values
    return smooth_noise_spectrum(values, np.fft.rfft(on_grid), length)


class TestNoise:
    def test_white_noise_has_its_variance_at_every_frequency(self):
        values = np.random.default_rng(1).normal(0, 3.0, 6000)
        found = noise_of(values, np.arange(6000), 6000)
        assert len(found) == 3001
        assert np.mean(found[10:]) == pytest.approx(9.0, rel=0.1)
        assert np.min(found) > 0.5 * 9.0

    def test_missing_samples_change_its_level_little(self):
        rng = np.random.default_rng(2)
        values = rng.normal(0, 1.0, 6000)
        kept = np.flatnonzero(rng.uniform(size=6000) > 0.3)
        found = noise_of(values[kept], kept, 6000)
        assert np.mean(found[10:]) == pytest.approx(1.0, rel=0.1)

    def test_a_slow_line_lifts_its_octave_and_no_other(self):
        place = np.arange(8192)
        line = 400
        quiet = np.random.default_rng(3).normal(0, 1.0, 8192)
        loud = quiet + 0.5 * np.cos(2 * np.pi * line * place / 8192)
        before, after = (noise_of(v, place, 8192) for v in (quiet, loud))
        ratio = after / before
        # Over an octave: 0.5²/4 of power on each of 8192 lines, spread over 0.71 to 1.41 of it.
        expected = 1 + 0.25 / 4 * 8192 / (line * (2**0.5 - 0.5**0.5))
        assert ratio[line] == pytest.approx(expected, rel=0.25)
        assert np.max(ratio[1000:]) < 1.3

    def test_it_scales_with_the_square(self):
        values = np.cumsum(np.random.default_rng(4).normal(size=500))
        place = np.arange(500)
        np.testing.assert_allclose(
            noise_of(1e-9 * values, place, 512), 1e-18 * noise_of(values, place, 512), rtol=1e-9
        )

    def test_the_scatter_of_any_sum_is_as_stated_in_noise_that_wanders(self, clean):
        """Compare the stated covariance in coloured noise with that of many draws."""
        rng = np.random.default_rng(5)
        samples, time = clean.fitted.samples, np.linspace(0, 1, len(clean.problem.input))
        waves = np.column_stack([np.sin(2 * np.pi * f * time) for f in (4.0, 200.0)])
        sizes, stated = [], []
        for _ in range(40):
            noise = np.convolve(rng.normal(0, 1e-8, samples + 9), np.ones(10) / 10**0.5, "valid")
            noisy = ResidualSpace(clean.problem, replace(clean.fitted, residual=noise))
            score = noisy.score(waves)
            sizes.append(score.size)
            stated.append(np.sqrt(np.diag(score.covariance)))
        ratio = np.std(sizes, axis=0) / np.mean(stated, axis=0)
        # 40 draws know a deviation to 11 %; what is stated errs on the safe side.
        assert np.all(ratio < 1.35)
        assert ratio[0] > 0.5
