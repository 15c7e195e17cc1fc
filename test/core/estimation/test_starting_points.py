"""Test starting points by their distance from the known answer."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from omsm_ros.core.estimation.model_order import StartingPoints, coarser, fit
from omsm_ros.core.estimation.model_structure import ScaledStructure
from omsm_ros.core.estimation.output_error import Problem
from omsm_ros.core.estimation.sampled_choice import choose_sampled
from omsm_ros.core.estimation.sampled_fit import SampledRecord
from omsm_ros.core.lti.modes import known_modes
from omsm_ros.core.lti.transfer_function import Structure, TransferFunction

PERIOD = 1e-3


def points_for(dynamics, finer=1, lost=()):
    """Four seconds; ``finer``: times as many samples."""
    time = np.arange(4000 * finer) * (PERIOD / finer)
    motion = sum(1e-5 * np.exp(-(((time - c) / 4e-3) ** 2)) for c in np.arange(0.4, 3.6, 0.37))
    frequency = np.fft.rfftfreq(len(motion), PERIOD / finer)
    seen = np.fft.irfft(np.fft.rfft(motion) * dynamics.response(frequency), len(motion))
    seen = seen + np.random.default_rng(1).normal(0, 1e-9, len(motion))
    used = np.ones(len(motion), bool)
    used[list(lost)] = False
    seen[~used] = 0.0
    background = np.ones((len(motion), 1))
    problem = Problem(motion, seen, used, PERIOD / finer, background, 300.0)
    lag = fit(problem, Structure(0, 0, True), [np.array([0.1])])
    return StartingPoints(problem, lag)


def resonance(frequency, damping):
    omega = 2 * np.pi * frequency
    return TransferFunction.from_ascending([1.0], [1.0, 2 * damping / omega, omega**-2])


@pytest.mark.parametrize(("frequency", "damping"), [(30.0, 0.02), (80.0, 0.05), (140.0, 0.01)])
def test_a_resonance_is_found_from_the_mode_that_explains_most(frequency, damping):
    points = points_for(resonance(frequency, damping))
    structure = Structure(2, 0, False)
    found = fit(points.problem, structure, points.of(structure, []))
    (mode,) = known_modes(found.dynamics)
    assert mode.frequency == pytest.approx(frequency, rel=1e-3)
    assert mode.damping == pytest.approx(damping, rel=0.02)


def test_a_small_mode_is_added_to_the_fit_of_a_large_one():
    """1 + a (M - 1) of two modes: a of 0.2 at 40 Hz, and a of 0.01 at 130 Hz."""
    large, small = resonance(40.0, 0.05), resonance(130.0, 0.03)
    denominator = np.convolve(large.denominator[::-1], small.denominator[::-1])[::-1]
    numerator = 0.79 * denominator
    numerator[:3] += 0.2 * small.denominator + 0.01 * large.denominator
    points = points_for(TransferFunction.from_ascending(numerator, denominator))
    structures = Structure(2, 2, False), Structure(4, 4, False)
    fits = []
    for structure in structures:
        fits.append(fit(points.problem, structure, points.of(structure, fits)))
    found = sorted(mode.frequency for mode in known_modes(fits[-1].dynamics))
    assert found == pytest.approx([40.0, 130.0], rel=0.005)


def test_a_richer_structure_never_fits_worse_than_the_one_it_contains():
    points = points_for(resonance(60.0, 0.1))
    fits = []
    for structure in (Structure(1, 0, False), Structure(2, 0, False), Structure(3, 1, False)):
        fits.append(fit(points.problem, structure, points.of(structure, fits)))
    costs = [f.sum_of_squares for f in fits]
    assert costs[0] >= costs[1] * 0.999
    assert costs[1] >= costs[2] * 0.999


def test_every_start_has_the_nonlinear_of_its_structure_and_is_stable():
    points = points_for(resonance(60.0, 0.1))
    for structure in (Structure(4, 3, True), Structure(3, 2, False), Structure(0, 0, True)):
        scaled = ScaledStructure(structure, points.problem.rate)
        starts = points.of(structure, [])
        assert len(starts) > 0
        for shape in starts:
            assert len(shape) == scaled.nonlinear_size
            assert scaled.transfer_function(shape, np.ones(1)).is_stable


@pytest.mark.parametrize("every", [2, 3, 5])
def test_a_coarser_problem_has_the_same_response(every):
    """Compare with the known response of plant and motion, within the noise."""
    truth = TransferFunction.from_ascending([1.0, 2e-3], [1.0, 6e-3, 2e-5], 1e-3)
    problem = points_for(truth, finer=4).problem
    coarse = coarser(problem, every)
    assert coarse.period == pytest.approx(every * problem.period)
    assert len(coarse.input) == len(coarse.output) == len(coarse.used) == len(coarse.background)
    structure = Structure(2, 1, True)
    start = ScaledStructure(structure, problem.rate).nonlinear_of(
        np.array([-1.0, -2.0], complex), 0.3
    )
    found = fit(coarse, structure, [start]).dynamics
    lines = np.geomspace(1.0, 60.0, 8)
    np.testing.assert_allclose(found.response(lines), truth.response(lines), rtol=1e-3)


def test_what_is_beyond_the_new_half_rate_folds_nowhere():
    problem = points_for(resonance(60.0, 0.1)).problem
    time = np.arange(len(problem.input)) * PERIOD
    beyond = replace(problem, output=np.sin(2 * np.pi * 140.0 * time))
    inside = replace(problem, output=np.sin(2 * np.pi * 90.0 * time))
    at_rest = slice(50, -50)
    assert np.max(abs(coarser(beyond, 4).output[at_rest])) < 1e-4
    assert np.max(abs(coarser(inside, 4).output[at_rest])) == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("offset", range(3))
def test_readings_rarer_than_the_samples_of_the_axis_are_seen_in_fewer_samples(offset):
    """Every third sample holds a reading: those of the coarser problem may all lie between."""
    problem = points_for(resonance(30.0, 0.3), finer=3).problem
    rare = np.zeros(len(problem.used), bool)
    rare[offset::3] = True
    fewer = coarser(replace(problem, used=rare, output=np.where(rare, problem.output, 0.0)), 3)
    whole = coarser(problem, 3)
    assert np.mean(fewer.used) > 0.99
    error = (fewer.output - whole.output)[fewer.used]
    assert np.sqrt(np.mean(error**2)) < 3e-3 * np.ptp(whole.output)


def test_what_was_lost_for_longer_than_a_new_sample_stays_lost():
    problem = points_for(resonance(30.0, 0.3), finer=3).problem
    used = problem.used.copy()
    used[6000:6100] = used[300] = False
    fewer = coarser(replace(problem, used=used), 3)
    assert np.flatnonzero(~fewer.used).tolist() == list(range(2001, 2033))


def test_an_order_that_is_asked_for_ends_in_the_least_minimum():
    """In that minimum the residual has less power than the noise; one of four modes is weak."""
    rng = np.random.default_rng(2)
    u, y = rng.normal(size=600), np.zeros(600)
    frequency, damping = rng.uniform(0.03, 0.4, 4), np.exp(rng.uniform(-5.3, -3, 4))
    for f, d in zip(frequency, damping, strict=True):
        pole = np.exp(2 * np.pi * f * (-d + 1j * np.sqrt(1 - d * d)))
        size = rng.choice([-1, 1]) * np.exp(rng.normal(0, 0.8)) * (1 - abs(pole))
        y += size * signal.lfilter([0, 1], [1, -2 * pole.real, abs(pole) ** 2], u)
    noise = rng.normal(size=600) * 0.01 * np.std(y)
    record = SampledRecord(u[:, np.newaxis], y + noise, np.ones(600, bool))
    chosen = choose_sampled([record], "zero-order", order=8).chosen.fit
    assert chosen.order == 8
    assert np.std(chosen.residual) < np.std(noise)
