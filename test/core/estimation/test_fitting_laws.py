"""Test scaling laws and invariances of steps, noise, rounding and covariances."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import linalg, signal

from omsm_ros.core.estimation.covariance import autoregression, noise_spectrum, parameter_covariance
from omsm_ros.core.estimation.noise import (
    motion_scatter,
    plateau_variance,
    plateaus,
    reading_step,
    timing_variance,
)
from omsm_ros.core.estimation.output_error import Problem
from omsm_ros.core.estimation.steps import Steps, find_steps, sample_noise, segments
from omsm_ros.core.streams.blocks import FloatArray

PERIOD, REST, RAMP = 1e-3, 200, 40
SMOOTH = 0.5 - 0.5 * np.cos(np.pi * np.arange(1, RAMP + 1) / RAMP)


def stepped(*levels: float, noise: float = 0.0, seed: int = 0) -> FloatArray:
    """Rests at each of ``levels`` [m], with smooth edges between."""
    parts = [np.full(REST, levels[0])]
    for before, after in pairwise(levels):
        parts += [before + (after - before) * SMOOTH, np.full(REST, after)]
    z = np.concatenate(parts)
    return z + np.random.default_rng(seed).normal(0, noise, len(z)) if noise else z


LEVELS = (0.0, 10e-6, 22e-6, 12e-6, 0.0, 9e-6)
Z = stepped(*LEVELS, noise=2e-9)
STEPS = find_steps(Z, PERIOD)


def test_edges_are_where_they_are_and_as_high() -> None:
    assert np.array([e.height for e in STEPS.edges]) == pytest.approx(np.diff(LEVELS), abs=1e-9)
    for k, edge in enumerate(STEPS.edges):
        begins = REST + k * (REST + RAMP)
        assert begins - 25 < edge.start <= begins + 5
        assert begins + RAMP - 5 <= edge.stop < begins + RAMP + 25
        assert np.all(STEPS.moving[edge.start : edge.stop])
    assert STEPS.travel == pytest.approx(22e-6, abs=20e-9)
    assert STEPS.noise == pytest.approx(2e-9, rel=0.1)


def alike(found: Steps, edges: list[tuple[int, int]], heights: FloatArray, slack: int = 0) -> None:
    assert len(found.edges) == len(edges)
    for edge, (start, stop) in zip(found.edges, edges, strict=True):
        assert abs(edge.start - start) <= slack
        assert abs(edge.stop - stop) <= slack
    assert np.array([e.height for e in found.edges]) == pytest.approx(heights, rel=1e-3)


PLACES = [(e.start, e.stop) for e in STEPS.edges]
HEIGHTS = np.array([e.height for e in STEPS.edges])


def test_home_direction_and_unit_of_z_do_not_move_the_edges() -> None:
    alike(find_steps(Z + 0.3, PERIOD), PLACES, HEIGHTS)
    alike(find_steps(-Z, PERIOD), PLACES, -HEIGHTS)
    alike(find_steps(100 * Z, PERIOD), PLACES, 100 * HEIGHTS)
    n = len(Z)
    turned = [(n - stop, n - start) for start, stop in PLACES[::-1]]
    alike(find_steps(Z[::-1].copy(), PERIOD), turned, -HEIGHTS[::-1], slack=1)


def test_a_longer_rest_before_them_only_moves_the_edges() -> None:
    later = np.concatenate([Z[:REST], Z])
    alike(find_steps(later, PERIOD), [(a + REST, b + REST) for a, b in PLACES], HEIGHTS)


def test_segments_cover_the_record_once_and_hold_one_edge_each() -> None:
    cut = segments(STEPS, len(Z))
    assert cut[0][0] == 0
    assert cut[-1][1] == len(Z)
    assert all(one[1] == other[0] for one, other in pairwise(cut))
    for (start, stop), (a, b) in zip(cut, PLACES, strict=True):
        assert start < a < b < stop


# -- noise of samples

CURVE = np.sin(2 * np.pi * np.arange(5000) / 900)


@pytest.mark.parametrize("noise", [1e-9, 3e-8])
def test_noise_on_a_smooth_motion_is_distinguished_from_it(noise: float) -> None:
    z = 50e-6 * CURVE + np.random.default_rng(1).normal(0, noise, 5000)
    assert sample_noise(z) == pytest.approx(noise, rel=0.05)


@settings(max_examples=25)
@given(seed=st.integers(0, 99), factor=st.floats(1e-9, 1e6), line=st.floats(-1e3, 1e3))
def test_noise_is_in_proportion_and_knows_no_line(seed: int, factor: float, line: float) -> None:
    white = np.random.default_rng(seed).normal(size=400)
    found = sample_noise(white)
    assert found == pytest.approx(1.0, rel=0.4)
    assert sample_noise(factor * white) == pytest.approx(factor * found, rel=1e-9, abs=0)
    assert sample_noise(white + line * np.arange(400)) == pytest.approx(found, rel=0.1)
    assert sample_noise(-white[::-1]) == pytest.approx(found, rel=1e-9)


def test_of_too_few_samples_there_is_no_noise() -> None:
    assert sample_noise(np.array([1.0, 2.0])) == 0.0
    assert sample_noise(np.empty(0)) == 0.0


# -- readings in steps

STEP = 0.25e-6


@pytest.mark.parametrize("offset", [0.0, 3.1e-6, -0.2])
@pytest.mark.parametrize("unit", [1.0, 1e6])
def test_the_step_of_rounded_readings_is_found_anywhere(offset: float, unit: float) -> None:
    readings = unit * (offset + STEP * np.round(Z / STEP))
    found = reading_step(readings)
    assert found == pytest.approx(unit * STEP, rel=1e-6)
    shuffled = np.random.default_rng(3).permutation(readings)
    assert reading_step(shuffled) == found
    assert reading_step(-readings) == pytest.approx(found)


@pytest.mark.parametrize("readings", [Z, np.full(500, 1.0), np.repeat([0.0, 1.0], 300)])
def test_readings_without_steps_have_none(readings: FloatArray) -> None:
    assert reading_step(readings) == 0.0


def test_plateaus_are_counted_where_the_axis_rests() -> None:
    numbers = plateaus(STEPS, np.ones(len(Z), np.bool_))
    assert np.array_equal(numbers == -1, STEPS.moving)
    assert numbers[[0, -1]].tolist() == [0, len(LEVELS) - 1]
    assert np.all(np.diff(numbers[~STEPS.moving]) >= 0)


def test_what_a_plateau_shares_goes_from_all_to_nothing_with_the_noise() -> None:
    """Without noise that of an even distribution over a step, q²/12; with noise of a step none."""
    place = np.random.default_rng(4).uniform(0, 1e-4, 400)
    number = np.repeat(np.arange(400), 50)
    shared = []
    for noise in (0.0, 0.15 * STEP, 0.3 * STEP, 1.0 * STEP):
        seen = place[number] + np.random.default_rng(5).normal(0, 1, len(number)) * noise
        rounded = STEP * np.round(seen / STEP)
        shared.append(plateau_variance(rounded, number, STEP))
        # Against the error itself, that 50 readings do not average.
        mean = np.bincount(number, rounded - place[number]) / 50
        if noise in (0.15 * STEP, 0.3 * STEP):
            left = np.var(mean) - (noise**2 + STEP**2 / 12) / 50
            # Little noise cannot be distinguished from rounding: then all may be shared.
            most = STEP**2 / 12 if noise < 0.2 * STEP else 2 * left
            assert 0.9 * left < shared[-1] < 1.001 * most
    assert shared[0] == pytest.approx(STEP**2 / 12, rel=0.01, abs=0)
    assert shared[0] >= shared[1] > shared[2] > shared[3] == 0.0
    assert plateau_variance(rounded, np.full(len(number), -1), STEP) == 0.0
    assert plateau_variance(rounded, number, 0.0) == 0.0


# -- scatter in time

RATE = np.where(np.arange(20_000) % 1000 < 300, 2e-3 * np.sin(np.arange(20_000) / 40.0), 0.0)


def residual(scatter: float, noise: float = 10e-9, seed: int = 0) -> FloatArray:
    random = np.random.default_rng(seed)
    late = random.normal(0, scatter, len(RATE)) if scatter else np.zeros(len(RATE))
    return RATE * late + random.normal(0, noise, len(RATE))


def test_scatter_in_time_is_found_as_it_was_made() -> None:
    found = [timing_variance(residual(20e-6, seed=seed), RATE) for seed in range(10)]
    assert np.sqrt(np.mean(found)) == pytest.approx(20e-6, rel=0.03)
    assert timing_variance(residual(0.0), RATE) == 0.0


def test_scatter_knows_no_unit_sign_or_direction_of_time() -> None:
    plain = timing_variance(residual(20e-6), RATE)
    for found in (
        timing_variance(1e6 * residual(20e-6), 1e6 * RATE),
        timing_variance(-residual(20e-6), RATE),
        timing_variance(residual(20e-6), -RATE),
        timing_variance(residual(20e-6)[::-1], RATE[::-1]),
    ):
        assert found == pytest.approx(plain, rel=1e-6, abs=0)


def test_faster_at_the_same_residual_is_less_scatter() -> None:
    plain = timing_variance(residual(20e-6), RATE)
    twice = timing_variance(residual(20e-6), 2 * RATE)
    assert twice == pytest.approx(plain / 4, rel=1e-6, abs=0)


def test_samples_that_are_not_compared_do_not_count() -> None:
    holed = residual(20e-6)
    holed[::97] = np.nan
    plain = timing_variance(residual(20e-6), RATE)
    assert timing_variance(holed, RATE) == pytest.approx(plain, rel=0.1, abs=0)


def test_the_axis_own_scatter_is_found_in_its_motion() -> None:
    time = np.arange(len(RATE))
    rate = 2e-3 * np.maximum(np.sin(2 * np.pi * time / 1000), 0.0) ** 4
    path = np.cumsum(rate) * PERIOD
    late = np.random.default_rng(6).normal(0, 30e-6, len(time))
    seen = path + rate * late + np.random.default_rng(7).normal(0, 1e-9, len(time))
    assert motion_scatter(seen, rate) == pytest.approx(30e-6, rel=0.1)
    assert motion_scatter(path + 1e-9 * np.cos(time), rate) < 3e-6


# -- covariances

COUNT = 3000
COLUMNS = np.random.default_rng(8).normal(size=(COUNT, 3)) * [1.0, 1e-6, 50.0]


def problem(used: FloatArray | None = None) -> Problem:
    count = COUNT if used is None else len(used)
    return Problem(
        input=np.sin(np.arange(count) / 30.0), output=np.zeros(count),
        used=np.ones(count, np.bool_) if used is None else used.astype(np.bool_),
        period=PERIOD, background=np.ones((count, 1)), rate=100.0,
    )  # fmt: skip


def of_noise(noise: FloatArray, columns: FloatArray = COLUMNS) -> FloatArray:
    return parameter_covariance(problem(), columns, noise)


WHITE = np.random.default_rng(9).normal(0, 0.1, COUNT)
COLOURED = signal.lfilter([1.0], [1.0, -0.9], WHITE)


def test_in_white_noise_it_is_that_of_the_textbook() -> None:
    expected = np.var(WHITE) * np.linalg.inv(COLUMNS.T @ COLUMNS)
    scale = np.sqrt(np.diag(expected))
    found = of_noise(WHITE) / np.outer(scale, scale)
    np.testing.assert_allclose(found, expected / np.outer(scale, scale), atol=0.02)


def test_in_coloured_noise_it_is_the_sandwich_of_its_autocovariance() -> None:
    """Σ with the entries 0.9^|i-j| of a first-order process, written out in full."""
    slow = np.cos(np.outer(np.arange(COUNT), [0.002, 0.01]))
    variance = 0.01 / (1 - 0.81)
    sigma = variance * linalg.toeplitz(0.9 ** np.arange(COUNT))
    bread = np.linalg.inv(slow.T @ slow)
    expected = bread @ slow.T @ sigma @ slow @ bread
    found = of_noise(COLOURED, slow)
    assert np.diag(found) == pytest.approx(np.diag(expected), rel=0.25, abs=0)
    # As white noise of the same size it would be ten times too small.
    assert np.all(np.diag(found) > 5 * variance * np.diag(bread))


@pytest.mark.parametrize("noise", [WHITE, COLOURED], ids=["white", "coloured"])
def test_units_of_parameters_and_noise_pass_through(noise: FloatArray) -> None:
    plain, units = of_noise(noise), np.array([1e-9, 1.0, 1e5])
    scaled = of_noise(noise, COLUMNS * units)
    np.testing.assert_allclose(scaled * np.outer(units, units), plain, rtol=1e-6, atol=0)
    np.testing.assert_allclose(of_noise(3e-9 * noise), 9e-18 * plain, rtol=1e-6, atol=0)
    np.testing.assert_allclose(of_noise(-noise), plain, rtol=1e-9, atol=0)


def test_order_of_the_parameters_does_not_matter() -> None:
    turn = [2, 0, 1]
    found = of_noise(COLOURED, COLUMNS[:, turn])
    np.testing.assert_allclose(found, of_noise(COLOURED)[np.ix_(turn, turn)], rtol=1e-9, atol=0)


@pytest.mark.parametrize("poles", [[0.6], [0.5, -0.3], [0.8 * np.exp(0.7j), 0.8 * np.exp(-0.7j)]])
def test_a_process_of_known_poles_is_whitened_by_them(poles: list[complex]) -> None:
    filter_ = np.real(np.poly(poles))
    noise = signal.lfilter([1.0], filter_, np.random.default_rng(10).normal(0, 2.0, 40_000))
    found, variance = autoregression(noise)
    assert found[: len(filter_)] == pytest.approx(filter_, abs=0.02)
    assert np.all(np.abs(found[len(filter_) :]) < 0.03)
    assert variance == pytest.approx(4.0, rel=0.03)
    scaled, larger = autoregression(1e-6 * noise)
    assert scaled == pytest.approx(found, rel=1e-9)
    assert larger == pytest.approx(1e-12 * variance, rel=1e-9, abs=0)
    _, response = signal.freqz([1.0], filter_, worN=np.pi * np.arange(129) / 128)
    assert noise_spectrum(noise, 256) == pytest.approx(4.0 * np.abs(response) ** 2, rel=0.3)
