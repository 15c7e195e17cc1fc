"""Test the closing of a motion to a period, and which of its lines are motion."""

import numpy as np

from omsm_ros.core.estimation.output_error import denoised
from omsm_ros.core.estimation.parallel_sections import close_period


def test_the_period_closes_without_a_jump():
    motion = np.linspace(0.0, 1.0, 1000)
    closed = close_period(motion, 1e-3)
    steps = np.abs(np.diff(np.append(closed, closed[0])))
    assert np.max(steps[len(motion) - 1 :]) < 0.05
    np.testing.assert_array_equal(closed[:1000], motion)


def test_before_it_starts_anew_the_period_rests():
    """Longer than a mode of 60 Hz and 2 % takes to lose all but a thousandth."""
    motion = np.linspace(0.0, 1.0, 1000)
    closed = close_period(motion, 1e-3)
    assert np.log(1000) / (0.02 * 2 * np.pi * 60) < 1.0
    np.testing.assert_array_equal(closed[-1000:], motion[0])


def test_a_record_of_milliseconds_is_not_followed_by_a_second_of_rest():
    """At a megahertz that would be a million samples for three hundred."""
    motion = np.linspace(0.0, 1.0, 300)
    closed = close_period(motion, 1e-6)
    assert len(closed) < 7 * len(motion)
    np.testing.assert_array_equal(closed[-len(motion) :], motion[0])


def test_noise_is_taken_out_of_the_motion_and_motion_is_not():
    rng = np.random.default_rng(5)
    time, centres = np.arange(4000) * 1e-3, np.arange(0.5, 3.5, 0.45)
    bumps = [(-1) ** k * np.exp(-(((time - c) / 6e-3) ** 2)) for k, c in enumerate(centres)]
    motion = 1e-5 * np.sum(bumps, axis=0)
    noise = 4e-10
    clean = np.fft.rfft(motion)
    noisy = np.fft.rfft(motion + rng.normal(0, noise, len(motion)))
    kept = denoised(noisy, len(motion) * noise**2)
    assert len(kept) < 0.6 * len(noisy)
    # Lines are kept whole: the residual of a fit would follow a missing share.
    strong = np.abs(clean[: len(kept)]) > 20 * noise * np.sqrt(len(motion))
    np.testing.assert_array_equal(kept[strong], noisy[: len(kept)][strong])
    error = np.sum(np.abs(kept - clean[: len(kept)]) ** 2)
    assert error < 0.5 * np.sum(np.abs(noisy - clean) ** 2)
    assert np.sum(np.abs(clean[len(kept) :]) ** 2) < 1e-6 * np.sum(np.abs(clean) ** 2)


def test_motion_up_to_half_the_sampling_rate_is_kept_to_its_last_line():
    spectrum = np.full(200, 1.0 + 1.0j)
    kept = denoised(spectrum, 1e-12)
    np.testing.assert_allclose(kept, spectrum, rtol=1e-9)
