"""Covariance and band, against Monte Carlo and finite differences."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from omsm_ros.core.estimation.covariance import (
    autoregression,
    noise_before_fit,
    noise_spectrum,
    parameter_covariance,
    weighted_gram,
)
from omsm_ros.core.estimation.output_error import Problem
from omsm_ros.core.lti.frequency_response import (
    COVERAGE_FACTOR,
    Band,
    ResponseLimits,
    excited_up_to,
    low_frequency_delay_uncertainty,
    relative_response_jacobian,
    response_band,
    trusted_up_to,
    widening,
)
from omsm_ros.core.lti.transfer_function import TransferFunction

G = TransferFunction([1.0, -2e-4, 1e-7], [1.0, 1e-4, 4e-8, 1e-12], 1e-4)


def problem_for(samples, used=None):
    used = np.ones(samples, bool) if used is None else used
    return Problem(np.zeros(samples), np.zeros(samples), used, 1e-3, np.ones((samples, 1)), 1.0)


def coloured(rng, samples, pole):
    return signal.lfilter([1.0], [1.0, -pole], rng.normal(size=samples + 200))[200:]


@pytest.mark.parametrize("pole", [0.0, 0.8])
def test_covariance_is_that_of_repeated_fits(pole):
    samples, rng = 800, np.random.default_rng(1)
    used = rng.random(samples) > 0.1
    time = np.linspace(0, 1, samples)
    columns = np.column_stack([np.ones(samples), np.sin(2 * np.pi * 3 * time)])[used]
    fits, stated = [], []
    for _ in range(300):
        noise = coloured(rng, samples, pole)[used]
        solved = np.linalg.lstsq(columns, noise, rcond=None)[0]
        fits.append(solved)
        residual = noise - columns @ solved
        stated.append(np.diag(parameter_covariance(problem_for(samples, used), columns, residual)))
    np.testing.assert_allclose(np.mean(stated, axis=0), np.var(fits, axis=0), rtol=0.3)


def test_noise_of_the_motion_counts_where_a_resonance_lifts_it():
    """1.7 % of the residual's variance, in the very line that tells the resonance."""
    samples, period, omega = 8192, 1e-3, 2 * np.pi * 60
    resonance = TransferFunction.from_ascending([1.0], [1.0, 0.04 / omega, omega**-2])
    rng, time = np.random.default_rng(6), period * np.arange(samples)
    # Response to a step, and its derivative with respect to the frequency.
    ringing = np.exp(-0.02 * omega * (time % 1.0)) * np.array([np.cos(omega * time), time % 1.0])
    ringing[1] *= np.sin(omega * time)
    columns, motion = ringing.T, 1e3 * np.sign(np.sin(2 * np.pi * time))
    problem = replace(problem_for(samples), input=motion, noise=0.06)
    through = resonance.response(np.fft.rfftfreq(samples, period))
    fits, stated, without = [], [], []
    for _ in range(100):
        passed = np.fft.irfft(through * np.fft.rfft(rng.normal(0, 0.06, samples)), samples)
        noise = passed + rng.normal(size=samples)
        solved = np.linalg.lstsq(columns, noise, rcond=None)[0]
        fits.append(solved)
        residual = noise - columns @ solved
        stated.append(np.diag(parameter_covariance(problem, columns, residual, resonance)))
        without.append(np.diag(parameter_covariance(problem, columns, residual)))
    scatter = np.var(fits, axis=0)
    # The variance of 100 is known to 14 %.
    np.testing.assert_allclose(np.mean(stated, axis=0), scatter, rtol=0.3)
    assert np.all(np.mean(without, axis=0) < 0.7 * scatter)


def test_what_the_data_cannot_tell_apart_is_not_known():
    """Two columns that are one: their sum is known as before, their difference not at all."""
    rng = np.random.default_rng(3)
    column, residual = rng.normal(size=4000), rng.normal(0, 0.1, 4000)
    once = parameter_covariance(problem_for(4000), column[:, np.newaxis], residual)
    twice = parameter_covariance(problem_for(4000), np.column_stack([column, column]), residual)
    together, apart = np.array([1.0, 1.0]), np.array([1.0, -1.0])
    assert together @ twice @ together == pytest.approx(once[0, 0], rel=1e-3)
    assert apart @ twice @ apart > 1e9 * once[0, 0]


def test_white_noise_needs_no_autoregression():
    orders = [len(autoregression(np.random.default_rng(s).normal(size=2000))[0]) for s in range(20)]
    assert np.sum(np.array(orders) > 1) <= 2


def test_an_autoregression_is_recognised():
    filter_, variance = autoregression(coloured(np.random.default_rng(2), 20_000, 0.7))
    assert filter_[1] == pytest.approx(-0.7, abs=0.03)
    assert variance == pytest.approx(1.0, rel=0.05)


def test_noise_spectrum_has_the_variance_of_the_noise():
    noise = coloured(np.random.default_rng(3), 20_000, 0.7)
    spectrum = noise_spectrum(noise, 4096)
    mean = (2 * np.sum(spectrum[1:-1]) + spectrum[0] + spectrum[-1]) / 4096
    assert mean == pytest.approx(np.var(noise), rel=0.05)


def test_no_residual_means_no_variance():
    assert np.all(noise_spectrum(np.zeros(100), 64) == 0)


def test_response_jacobian_is_that_of_finite_differences():
    frequency = np.array([1.0, 30.0, 200.0])
    jacobian = relative_response_jacobian(G, frequency)
    start = np.concatenate([G.numerator, G.denominator[1:], [G.delay]])

    def log_response(vector):
        g = TransferFunction(vector[:3], np.concatenate([[1.0], vector[3:6]]), vector[6])
        return np.log(g.response(frequency))

    for k, value in enumerate(start):
        step = np.zeros(7)
        step[k] = 1e-3 * abs(value)
        slope = (log_response(start + step) - log_response(start - step)) / (2 * step[k])
        found = jacobian[0, :, k] + 1j * jacobian[1, :, k]
        assert np.all(np.abs(found - slope) < 1e-3 * np.abs(slope))


def test_an_uncertain_delay_is_an_uncertain_phase_only():
    covariance = np.zeros((7, 7))
    covariance[6, 6] = (1e-6) ** 2
    band = response_band(G, covariance, np.array([10.0, 100.0]))
    np.testing.assert_allclose(band.phase, 2 * np.pi * np.array([10.0, 100.0]) * 1e-6)
    np.testing.assert_allclose(band.gain, 0, atol=1e-15)


def test_trust_ends_where_the_band_leaves_its_limits():
    frequency = np.linspace(1, 100, 100)
    band = Band(frequency, 1e-4 * frequency, np.zeros(100))
    limits = ResponseLimits(gain=1e-4 * 50 * 1.959964 + 1e-9)
    assert trusted_up_to(band, limits) == 50
    assert trusted_up_to(band, ResponseLimits(gain=1.0)) == 100
    assert trusted_up_to(band, ResponseLimits(gain=1e-9)) == 0


def test_a_known_disagreement_narrows_the_trust():
    frequency = np.linspace(1, 100, 100)
    quiet = Band(frequency, np.zeros(100), np.zeros(100))
    other = Band(frequency, 1e-3 * frequency, np.zeros(100))
    assert trusted_up_to(quiet, ResponseLimits(gain=0.02001), other) == 20


def test_a_widened_band_just_holds_the_other():
    lines = np.array([1.0, 10.0])
    own = Band(lines, np.array([0.0, 1e-3]), np.array([1e-3, 2e-3]))
    other = Band(lines, np.array([0.0, 2e-3]), np.array([1e-3, 2e-3]))
    apart = np.array([0.0, 5e-3 - 1e-3j])
    factor = widening(own, other, apart)
    # The gain at 10 Hz asks for most: 5e-3 and twice its own uncertainty.
    assert 1.96 * factor * 1e-3 == pytest.approx(5e-3 + 1.96 * 2e-3, rel=1e-3)


def test_a_band_that_holds_the_other_is_not_narrowed():
    broad, narrow = (Band(np.ones(1), np.full(1, u), np.full(1, u)) for u in (1e-2, 1e-3))
    assert widening(broad, narrow, np.zeros(1, complex)) == 1.0


@pytest.mark.parametrize(("noise", "expected"), [(1e-8, 40.0), (3e-4, 0.0)])
def test_a_motion_shows_the_response_as_far_as_it_goes(noise, expected):
    """m lines of power a² at noise s know gain and phase to √(s / 2 m a²): here to 3e-5 or 5e-3."""
    frequency = np.arange(501.0)
    answer = np.where(frequency <= 40, 1.0, 0.0).astype(complex)
    found = excited_up_to(frequency, answer, np.full(501, noise), ResponseLimits())
    # The band of a third of an octave still reaches down to 40 Hz from 45 Hz.
    assert expected <= found <= expected * 2 ** (1 / 6)


def test_the_deviation_that_shows_is_that_of_a_fit():
    """The threshold, found by least squares for a deviation of G over simulated noise."""
    frequency, centre = np.arange(501.0), 100.0
    near = np.abs(np.log2(np.maximum(frequency, 1e-9) / centre)) <= 1 / 6
    answer = np.where(near, 1.0 + 0.5j, 0.0)
    random = np.random.default_rng(4)
    shape = (4000, 501)
    noise = (random.normal(size=shape) + 1j * random.normal(size=shape)) / np.sqrt(2)
    fitted = (noise @ np.conj(answer)) / np.sum(np.abs(answer) ** 2)
    spread = COVERAGE_FACTOR * np.std(fitted.real)
    for factor, shown in ((1.1, True), (0.9, False)):
        limits = ResponseLimits(gain=factor * spread, phase=1.0)
        at_centre = np.where(np.arange(501) <= 112, answer, 0.0)
        found = excited_up_to(frequency, at_centre, np.ones(501), limits)
        assert (found > 95.0) is shown


def test_without_motion_nothing_is_shown():
    assert (
        excited_up_to(np.arange(10.0), np.zeros(10, complex), np.zeros(10), ResponseLimits()) == 0.0
    )


def test_uncertainty_of_the_low_frequency_delay_follows_by_perturbation():
    rng = np.random.default_rng(5)
    g = TransferFunction.from_ascending([1.27, 2e-4, 1e-8], [1.27, 8e-4, 6e-8, 1e-12])
    values = np.concatenate([g.numerator, g.denominator[1:], [1e-4]])
    mixing = rng.normal(size=(7, 7))
    covariance = 1e-12 * np.outer(values, values) * (mixing @ mixing.T)
    draws = values + rng.multivariate_normal(np.zeros(7), mixing @ mixing.T, 4000) * 1e-6 * values
    delays = [TransferFunction(d[:3], np.r_[1.0, d[3:6]], d[6]).low_frequency_delay for d in draws]
    stated = low_frequency_delay_uncertainty(g, covariance)
    assert stated == pytest.approx(np.std(delays), rel=0.05)


def test_a_pure_delay_is_as_uncertain_as_it_is_stated():
    covariance = np.diag([0.0, 4e-12])
    pure = TransferFunction([1.0], [1.0], 1e-4)
    assert low_frequency_delay_uncertainty(pure, covariance) == pytest.approx(2e-6)


def test_either_limit_alone_costs_about_the_same():
    """A phase off by φ misses as much of a motion as a gain off by φ."""
    limits = ResponseLimits()
    missed_by_phase = abs(np.exp(1j * limits.phase) - 1)
    assert 0.5 < missed_by_phase / limits.gain < 2


def test_a_known_disagreement_of_the_phase_alone_narrows_the_trust():
    lines = np.array([1.0, 10.0, 100.0])
    limits, quiet = ResponseLimits(gain=0.01, phase=0.02), np.zeros(3)
    band = Band(lines, quiet, np.full(3, 0.009))
    assert trusted_up_to(band, limits) == 100.0
    other = Band(lines, quiet, np.array([0.0, 0.001, 0.01]))
    assert trusted_up_to(band, limits, other) == 10.0
    assert trusted_up_to(band, limits, Band(lines, quiet, np.full(3, 0.01))) == 0.0


def test_uncertainty_of_the_low_frequency_delay_with_a_gain_at_rest():
    """Finite differences, for a numerator that does not begin with 1."""
    g = TransferFunction([2.0, -3e-3], [1.0, 5e-3], 1e-3)
    values = np.array([2.0, -3e-3, 5e-3, 1e-3])

    def delay(v):
        return TransferFunction(v[:2], [1.0, v[2]], v[3]).low_frequency_delay

    gradient = []
    for k in range(4):
        step = np.zeros(4)
        step[k] = 1e-6 * abs(values[k])
        gradient.append((delay(values + step) - delay(values - step)) / (2 * step[k]))
    mixing = np.random.default_rng(3).normal(size=(4, 4)) * np.abs(values)[:, np.newaxis] * 1e-3
    covariance = mixing @ mixing.T
    expected = np.sqrt(np.array(gradient) @ covariance @ np.array(gradient))
    assert low_frequency_delay_uncertainty(g, covariance) == pytest.approx(expected, rel=1e-6)


def test_a_pole_and_a_delay_that_do_the_same_leave_no_frequency_without_uncertainty():
    """Each known to minutes, both together to 1 µs: at least what that alone would leave."""
    mode = 2 * np.pi * 8.0
    light = np.array([1.0, 0.01 / mode, mode**-2])
    numerator = [1.0, 0.0099 / mode, 0.9999 * mode**-2]
    dynamics = TransferFunction(numerator, np.convolve(light, [1.0, 1e-10]), 5e-5)
    # The pole more, the delay less.
    alike = 300.0 * np.array([0.0, 0.0, 0.0, *light, -1.0])
    apart = np.array([0.0, 0.0, 0.0, 1e-6, 0.0, 0.0, 0.0])
    frequency = np.geomspace(0.1, 50.0, 500)
    band, least = (
        response_band(dynamics, covariance, frequency)
        for covariance in (np.outer(alike, alike) + np.outer(apart, apart), np.outer(apart, apart))
    )
    assert np.all(band.gain >= 0.9 * least.gain)
    assert np.all(band.phase >= 0.9 * least.phase)
    both = np.outer(alike, alike) + np.outer(apart, apart)
    assert low_frequency_delay_uncertainty(dynamics, both) >= 0.9e-6


def test_what_is_known_exactly_has_no_uncertainty():
    nothing = np.zeros((7, 7))
    band = response_band(G, nothing, np.array([1.0, 10.0]))
    assert not np.any(band.gain)
    assert not np.any(band.phase)
    assert low_frequency_delay_uncertainty(G, nothing) == 0.0


@pytest.mark.parametrize("length", [90, 96, 101])
def test_white_noise_through_rows_has_their_gram_matrix_times_its_variance(length):
    rows = np.random.default_rng(9).normal(size=(7, 90))
    found = weighted_gram(np.fft.rfft(rows, length), length, np.full(length // 2 + 1, 2.5))
    np.testing.assert_allclose(found, 2.5 * rows @ rows.T, atol=1e-9)


def test_a_fit_takes_noise_where_its_columns_have_power():
    """Sixty slow columns of 600 samples leave less of slow noise than of other noise."""
    rng, length = np.random.default_rng(4), 1024
    slow = signal.butter(4, 0.5)
    basis = np.linalg.qr(signal.lfilter(*slow, rng.normal(size=(60, 600))).T)[0].T
    z = np.exp(-2j * np.pi * np.fft.rfftfreq(length))
    truth = np.abs(1 + 0.8 * z + 0.3 * z**2) ** 2
    low, by_leverage, by_degrees = slice(10, 200), [], []
    for _ in range(60):
        noise = signal.lfilter([1.0, 0.8, 0.3], [1.0], rng.normal(size=620))[20:]
        left = noise - basis.T @ (basis @ noise)
        found = noise_before_fit(left, basis.copy(), np.full(600, True), length)
        by_leverage.append(np.mean((found / truth)[low]))
        one_factor = np.sqrt(600 / (600 - 60))
        by_degrees.append(np.mean((noise_spectrum(one_factor * left, length) / truth)[low]))
    assert np.mean(by_leverage) == pytest.approx(1.0, abs=0.03)
    assert np.mean(by_degrees) < 0.95


@pytest.mark.parametrize(("pole", "rate"), [(0.9, 0.0), (0.0, 3e-4)])
def test_a_slow_walk_is_noise_and_correlated_noise_is_no_walk(pole, rate):
    """Spectra of 40 residuals of a fit, at two periods in a record, over that of their noise."""
    rng, length, found = np.random.default_rng(5), 2048, []
    angle = 2 * np.pi * 2 / length
    truth = 1 / abs(1 - pole * np.exp(-1j * angle)) ** 2 + rate / (2 * np.sin(angle / 2)) ** 2
    basis = np.linalg.qr(signal.lfilter([1.0], [1.0, -0.9], rng.normal(size=(8, 2000))).T)[0].T
    for _ in range(40):
        noise = signal.lfilter([1.0], [1.0, -pole], rng.normal(size=2100))[100:]
        noise += np.sqrt(rate) * np.cumsum(rng.normal(size=2000))
        noise -= np.mean(noise)
        left = noise - basis.T @ (basis @ noise)
        found.append(noise_before_fit(left, basis.copy(), np.full(2000, True), length)[2] / truth)
    # An autoregression alone has half of the walk.
    assert np.mean(found) == pytest.approx(1.0, abs=0.3)
