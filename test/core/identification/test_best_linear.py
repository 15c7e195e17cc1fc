"""Best linear approximation of machines in plain numpy: linear, cubic and Wiener-Hammerstein."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from benchmarks.recorded import record_from_arrays
from omsm_ros.core.identification.best_linear import best_linear_approximation
from omsm_ros.core.kinematics.trajectories import plan_multisine
from omsm_ros.errors import IdentificationError

PERIOD = 1e-3
UNIT = 50e-6


def one_pole(values, corner):
    """Return ``values`` through one pole at ``corner`` [Hz]."""
    keep = np.exp(-2 * np.pi * corner * PERIOD)
    return signal.lfilter([1 - keep], [1.0, -keep], values)


def wiener_hammerstein(z, cubic):
    """Return two poles with x + cubic x³ between them, x in units of half the range."""
    inner = one_pole(z, 60.0) / UNIT
    return -UNIT * one_pole(inner + cubic * inner**3, 90.0)


def plan(seed, **options):
    return plan_multisine(
        sample_period=PERIOD, resolution=1.0, up_to=40.0, realisations=6, seed=seed, **options
    )


def recorded(plan, cubic, noise, seed):
    z = plan.z(PERIOD * np.arange(plan.samples))
    rng = np.random.default_rng(seed)
    distance = wiener_hammerstein(z, cubic) + rng.normal(0, noise, len(z))
    distance += 3e-6 + 1e-9 * np.arange(len(z))
    padded = [np.pad(v, (700, 300), mode="edge") for v in (z, distance)]
    return record_from_arrays(PERIOD, *padded)


def test_the_motion_stays_within_range_speed_and_acceleration_and_leaves_lines_out():
    one = plan(3, half_range=20e-6, speed=1e-3, acceleration=0.1)
    z = one.z(PERIOD * np.arange(one.samples))
    rate = np.diff(z) / PERIOD
    assert np.max(np.abs(z)) < 20e-6
    assert np.max(np.abs(rate)) < 1e-3
    assert 0.09 < np.max(np.abs(np.diff(rate))) / PERIOD < 0.1
    spectrum = np.abs(np.fft.rfft(z[one.period : 2 * one.period]))
    lines = np.asarray(one.lines)
    others = np.setdiff1d(np.arange(1, 41), lines)
    assert np.all(lines % 2 == 1)
    assert np.sum(others % 2 == 1) == 5
    assert np.max(spectrum[others]) < 1e-9 * np.min(spectrum[lines])


def test_a_linear_machine_shows_no_distortion_and_its_own_response():
    one = plan(1)
    found = best_linear_approximation(recorded(one, 0.0, 2e-9, 5), one)
    z = np.exp(2j * np.pi * found.frequency * PERIOD)
    keep = np.exp(-2 * np.pi * np.array([[60.0], [90.0]]) * PERIOD)
    true = -np.prod((1 - keep) / (1 - keep / z), axis=0)
    assert np.mean(np.abs(found.response - true) < found.radius) > 0.8
    assert found.total_distortion < 1e-9
    # White noise of 2 nm over 3000 samples of three periods, √2 rms amplitude for each line.
    expected = np.sqrt(2) * 2e-9 / np.sqrt(3 * one.period)
    assert np.sqrt(np.mean(found.noise**2)) == pytest.approx(expected, rel=0.25, abs=0)


def test_neither_a_transient_nor_lost_readings_count_as_noise():
    """A mode of 40 Hz decays by e^-4 in a period of 1 s, so the last two periods show the noise."""
    one = plan(1, periods=4)
    record = recorded(one, 0.0, 2e-9, 5)
    pole = np.exp((-4.0 + 2j * np.pi * 40.0) * PERIOD)
    ringing = [1.0, -2 * pole.real, abs(pole) ** 2]
    distance = signal.lfilter([sum(ringing)], ringing, record.z - record.z[0])
    distance += np.random.default_rng(6).normal(0, 2e-9, len(distance))
    lost = np.random.default_rng(7).random(len(distance)) < 0.005
    ringing = replace(record, ok=~lost, distance=np.where(lost, np.nan, distance))
    found = best_linear_approximation(ringing, one)
    expected = np.sqrt(2) * 2e-9 / np.sqrt(4 * one.period)
    assert np.sqrt(np.mean(found.noise**2)) == pytest.approx(expected, rel=0.25, abs=0)
    # Each realisation but the first has it in the period after the phases changed.
    assert np.sqrt(np.sum(found.transient**2)) > 20e-9


def test_circles_of_a_wiener_hammerstein_machine_contain_its_best_linear_approximation():
    """The truth is the mean over many realisations of other phases."""
    inside, distortion, cubic = [], [], 0.3
    many = plan_multisine(
        sample_period=PERIOD, resolution=1.0, up_to=40.0, realisations=150, periods=2, seed=0
    )
    true = best_linear_approximation(recorded(many, cubic, 0.0, 0), many)
    for seed in range(1, 13):
        # The same lines and amplitudes, phases of its own.
        one = replace(many, realisations=6, seed=1000 + seed)
        found = best_linear_approximation(recorded(one, cubic, 1e-9, seed), one)
        distortion.append(found.total_distortion)
        inside.append(np.abs(found.response - true.response) < found.radius)
    coverage = np.mean(inside)
    print("coverage", coverage, "distortion", distortion, true.total_distortion)
    assert 0.90 <= coverage <= 0.99
    assert found.odd[1].max() > 5 * found.even[1].max()
    rms = np.sqrt(np.mean(np.square(distortion)))
    assert rms == pytest.approx(true.total_distortion, rel=0.2, abs=0)


def test_another_motion_is_refused():
    one, other = plan(1), plan(2)
    with pytest.raises(IdentificationError, match="plan"):
        best_linear_approximation(recorded(other, 0.0, 1e-9, 1), one)
