"""Residual tests with known outcome, and the paper's Fig. 9."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import signal, stats

from benchmarks.step_test import StepTest
from benchmarks.twin_motions import respond
from omsm_ros.core.calibration.verification import check_path
from omsm_ros.core.estimation.model_order import fit
from omsm_ros.core.estimation.output_error import Problem
from omsm_ros.core.estimation.steps import find_steps
from omsm_ros.core.identification.residual_tests import (
    independence,
    noise_colour,
    residual_tests,
    response_difference,
    whiteness,
)
from omsm_ros.core.kinematics.trajectories import Chirp
from omsm_ros.core.lti.transfer_function import Structure, TransferFunction
from omsm_ros.twin.plant import PAPER_EQ_12, Plant


def test_p_values_of_white_noise_are_uniform():
    rng = np.random.default_rng(1)
    values = [whiteness(rng.normal(size=1000)) for _ in range(200)]
    assert stats.kstest(values, "uniform").pvalue > 1e-3


def test_coloured_noise_is_not_white():
    noise = signal.lfilter([1.0], [1.0, -0.3], np.random.default_rng(2).normal(size=2000))
    assert whiteness(noise) < 1e-6


def test_p_values_of_an_independent_residual_are_uniform():
    rng = np.random.default_rng(3)
    drive = np.convolve(rng.normal(size=1500), np.hanning(20), "same")
    values = [independence(rng.normal(size=1500), drive) for _ in range(200)]
    assert stats.kstest(values, "uniform").pvalue > 1e-3


def test_a_residual_that_follows_the_motion_is_caught():
    rng = np.random.default_rng(4)
    drive = np.convolve(rng.normal(size=1500), np.hanning(20), "same")
    drive /= np.std(drive)
    assert independence(rng.normal(size=1500) + 0.3 * np.roll(drive, 3), drive) < 1e-6


def test_a_motion_at_rest_drives_nothing():
    assert independence(np.random.default_rng(5).normal(size=100), np.zeros(100)) == 1.0


def stepped(delay, noise=1e-8):
    motion = StepTest(count=4)
    time = np.arange(round(motion.duration / 1e-3)) * 1e-3
    z, late = motion.positions(time).z, motion.positions(time - delay).z
    seen = late + np.random.default_rng(6).normal(0, noise, len(time))
    used = np.ones(len(time), bool)
    problem = Problem(z, seen, used, 1e-3, np.ones((len(time), 1)), 300.0)
    return problem, find_steps(z, 1e-3)


def test_a_right_model_leaves_noise_and_a_known_noise_is_taken():
    problem, steps = stepped(0.0005)
    found = fit(problem, Structure(0, 0, True), [np.array([0.1])])
    tests = residual_tests(problem, found, steps)
    assert tests.noise == pytest.approx(1e-8, rel=0.05)
    assert tests.chi_square == pytest.approx(1.0, abs=0.2)
    assert tests.whiteness > 1e-3


def test_a_wrong_model_shows_where_the_axis_moves():
    problem, steps = stepped(0.0005)
    static = fit(problem, Structure(0, 0, False), [np.empty(0)])
    tests = residual_tests(problem, static, steps)
    assert tests.chi_square > 5


@pytest.mark.parametrize("noise", [0.5e-9, 1.5e-9])
def test_rounding_masked_in_stationary_segments_is_no_misfit(noise):
    """Readings in steps of 10 nm scatter by 2.9 nm where they move, and hardly where they rest."""
    quantum, (problem, steps) = 10e-9, stepped(0.0005, noise)
    rounded = np.round(problem.output / quantum) * quantum
    resting = np.where(steps.moving, -1, 0)
    problem = replace(problem, output=rounded, plateau=resting, shared=1e-18)
    found = fit(problem, Structure(0, 0, True), [np.array([0.1])])
    tests = residual_tests(problem, found, steps)
    assert tests.noise == pytest.approx(quantum / np.sqrt(12), rel=0.15)
    assert tests.chi_square == pytest.approx(1.0, abs=0.25)


def test_fig_9_of_the_paper():
    chirp, plant = Chirp(), Plant(PAPER_EQ_12)
    moved = respond(plant, chirp, 25_000, 1e-3)
    predicted = respond(Plant(PAPER_EQ_12.normalised()), chirp, 25_000, 1e-3).probe
    check = check_path(moved.slide, -moved.probe, predicted, PAPER_EQ_12.dc_gain, 1e-3)
    fast = (check.frequency > 13) & (check.frequency < 14.5)
    assert np.degrees(np.median(check.lag_before[fast])) == pytest.approx(1.69, abs=0.1)
    assert abs(np.degrees(np.median(check.lag_after[fast]))) < 0.02
    # 0.262 µm over the run with the static gain taken out.
    assert check.rms_before == pytest.approx(0.262e-6, rel=0.03)
    assert check.rms_after < 1e-9


def test_the_response_without_a_model_agrees_with_the_truth_and_not_with_another():
    """Also for a mode that rings on from one window into the next."""
    rng = np.random.default_rng(7)
    time = np.arange(60_000) * 1e-3
    motion = np.sum([np.sin(2 * np.pi * f * time + f) for f in (3.1, 17.3, 44.9)], axis=0) * 1e-6
    motion += np.where(np.mod(time, 0.7) < 0.3, 1e-6, 0.0)

    def through(frequency):
        omega = 2 * np.pi * frequency
        mode = TransferFunction.from_ascending([1.0], [1.0, 0.04 / omega, omega**-2])
        response = mode.response(np.fft.rfftfreq(len(time), 1e-3))
        return np.fft.irfft(np.fft.rfft(motion) * response, len(time))

    seen = through(60.0) + rng.normal(0, 2e-9, len(motion))

    def agreement(modelled):
        problem = SimpleNamespace(
            input=motion, period=1e-3, shared=0.0, on_grid=lambda residual, elsewhere: residual
        )
        return response_difference(problem, SimpleNamespace(residual=seen - modelled), 80.0)

    assert agreement(through(60.0)) == pytest.approx(1.0, abs=0.4)
    assert agreement(through(60.1)) > 10


@pytest.mark.parametrize("memory", [0.0, 0.5])
def test_the_colour_of_noise_at_rest_is_that_of_its_filter(memory):
    """The density of e(k) = a e(k-1) + w(k) at 0 Hz is (1 + a)/(1 - a) times its mean."""
    problem, steps = stepped(0.0005, noise=0.0)
    white = np.random.default_rng(8).normal(0, 1e-8, len(problem.output))
    noise = signal.lfilter([1.0], [1.0, -memory], white)
    problem = replace(problem, output=problem.output + noise)
    found = fit(problem, Structure(0, 0, True), [np.array([0.1])])
    colour = noise_colour(problem, found, steps)
    assert colour == pytest.approx((1 + memory) / (1 - memory), rel=0.25)
