"""Test noise of the encoder that the probe follows or does not, on simulated machines."""

import numpy as np
import pytest
from linear_segments import through
from scipy import signal
from soaked import soaked

from benchmarks.recorded import record_from_arrays
from omsm_ros.core.estimation.model_order import StartingPoints, fit
from omsm_ros.core.estimation.noise import correct_errors_in_variables, smoothed
from omsm_ros.core.estimation.preparation import prepare
from omsm_ros.core.estimation.steps import Edge, find_steps
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.lti.transfer_function import Structure

PERIOD, FINER, RAMP, STEP, READING = 1e-3, 5, 20, 9.8e-6, 10e-9
# A lightly damped mode of 5 %, which amplifies white noise of the axis.
FREQUENCY, DAMPING = 60.0, 0.05
OMEGA = 2 * np.pi * FREQUENCY
MODE = [OMEGA**-2, 2 * DAMPING / OMEGA, 1.0]


def staircase(rest, edges=20):
    """Positions (n,) of steps up, and down again, with limited jerk."""
    phase = np.arange(1, RAMP + 1) / RAMP
    edge = phase**3 * (10 - 15 * phase + 6 * phase**2)
    heights = np.where(np.arange(edges) < edges // 2, STEP, -STEP)
    z, at = [np.zeros(rest)], 0.0
    for height in heights:
        z += [at + height * edge, np.full(rest, at + height)]
        at += height
    return np.concatenate(z)


def seen_by_probe(moved):
    time = np.arange(len(moved) * FINER) * PERIOD / FINER
    fine = np.interp(time, np.arange(len(moved)) * PERIOD, moved)
    return through([1.0], MODE, fine, PERIOD / FINER)[::FINER]


def record_of(moved, noise, seed=2):
    """Return readings of axis and probe for ``moved``; noise: of the encoder alone [m]."""
    rng = np.random.default_rng(seed)
    z = moved + rng.normal(0, 1, len(moved)) * noise
    return record_from_arrays(
        PERIOD, z, 40e-6 - seen_by_probe(moved) + rng.normal(0, READING, len(moved))
    )


def jitter(count, size, band=None):
    """Noise (n,) of ``size`` [m] that the axis follows, below ``band`` [Hz]."""
    values = np.random.default_rng(7).normal(0, 1, count)
    if band is not None:
        values = signal.sosfilt(signal.butter(2, band * 2 * PERIOD, output="sos"), values)
    return size * values / np.std(values)


def cleaned(record):
    problem = prepare(record, "encoder").problem
    lag = fit(problem, Structure(0, 0, True), [np.array([0.1])])
    two = Structure(2, 0, True)
    return problem, correct_errors_in_variables(
        problem, fit(problem, two, StartingPoints(problem, lag).of(two, [lag]))
    )


def test_where_an_axis_rests_its_noise_is_averaged():
    noise = np.random.default_rng(1).normal(0, 1e-9, 20_000)
    smooth, left = smoothed(5e-3 + noise, 1e-9)
    assert np.std(smooth - 5e-3) < 0.12e-9
    assert left < 0.1e-9


def test_what_is_left_of_noise_is_stated():
    """Near edges fewer samples are averaged, so more noise remains than in a long plateau."""
    z = staircase(300)
    smooth, left = smoothed(z + np.random.default_rng(1).normal(0, 3e-9, len(z)), 3e-9)
    assert 0.5 < left / np.std(smooth - z) < 1.2


def test_an_edge_keeps_its_shape():
    """The mean of 40 records shows a repeated error; noise alone is reduced to a sixth."""
    z, rng = staircase(100, 2), np.random.default_rng(3)
    off = [smoothed(z + rng.normal(0, 1e-9, len(z)), 1e-9)[0] - z for _ in range(40)]
    assert np.sqrt(np.mean(np.mean(off, axis=0) ** 2)) < 0.2e-9
    assert np.max(np.abs(np.mean(off, axis=0))) < 0.7e-9


def test_a_motion_stays_as_it_is():
    t = np.arange(5000) * PERIOD
    z = 20e-6 * np.sin(2 * np.pi * 3.0 * t)
    noisy = z + np.random.default_rng(1).normal(0, 1e-9, len(z))
    assert np.std(smoothed(noisy, 1e-9)[0] - z) < 1.1e-9


def test_a_slow_drift_is_followed():
    z = 1e-9 * np.arange(20_000) * PERIOD
    noisy = z + np.random.default_rng(1).normal(0, 1e-9, len(z))
    assert np.std(smoothed(noisy, 1e-9)[0] - z) < 0.3e-9


def test_before_and_after_are_alike():
    """The estimate knows no direction of time."""
    z = staircase(80, 4) + np.random.default_rng(4).normal(0, 1e-9, 5 * 80 + 4 * RAMP)
    there, back = smoothed(z, 1e-9)[0], smoothed(z[::-1], 1e-9)[0][::-1]
    np.testing.assert_allclose(there, back, rtol=0, atol=1e-17)


def test_noise_of_the_encoder_is_taken_out():
    z = staircase(500)
    problem, quiet = cleaned(record_of(z, 3e-9))
    assert quiet is not None
    added = problem.input - (z - np.mean(z))
    rests = np.abs(np.gradient(z)) == 0
    taken = quiet.errors_in_variables[rests]
    assert taken @ added[rests] / (taken @ taken) == pytest.approx(1.0, abs=0.03)
    assert np.std(quiet.input[rests] - (z - np.mean(z))[rests]) < 0.5e-9


def test_what_the_probe_follows_stays():
    """Jitter of the axis itself, some of it too slow to tell from a rest, and hardly any noise."""
    z = staircase(500)
    _, quiet = cleaned(record_of(z + jitter(len(z), 3e-9, 120.0), 0.05e-9))
    assert quiet is None or np.std(quiet.errors_in_variables) < 0.3e-9


def test_half_followed_is_half_taken_out():
    """With noise and jitter of equal size the expected motion is half of the reading."""
    z = staircase(500)
    shaken = z + jitter(len(z), 3e-9, 400.0)
    problem, quiet = cleaned(record_of(shaken, 3e-9))
    assert quiet is not None
    rests = np.abs(np.gradient(z)) == 0
    shown, taken = (problem.input - (z - np.mean(z)))[rests], quiet.errors_in_variables[rests]
    assert shown @ taken / (shown @ shown) == pytest.approx(0.5, abs=0.12)


def test_what_moves_probe_and_axis_alike_passes_without_the_response():
    """Shaken together, axis and probe show the jitter at once, and G is that of the steps."""
    z, shaken = staircase(500), jitter(11_000, 5e-9)[: len(staircase(500))]
    record = record_of(z, 0.0)
    alike = record_from_arrays(PERIOD, record.z + shaken, record.distance - shaken)
    problem, quiet = cleaned(alike)
    assert quiet is not None
    rests = problem.used & (np.abs(np.gradient(z)) == 0)
    column = quiet.background[:, -1]
    assert column[rests] @ shaken[rests] / (column[rests] @ column[rests]) == pytest.approx(
        -1.0, abs=0.1
    )
    two = Structure(2, 0, True)
    start = StartingPoints(quiet, fit(quiet, Structure(0, 0, True), [np.array([0.1])]))
    found = fit(quiet, two, start.of(two, [start.pure_delay]))
    assert found.rms < 1.1 * READING
    assert np.min(np.abs(found.dynamics.poles())) == pytest.approx(OMEGA, rel=2e-3)


def test_real_hum_is_kept_while_encoder_noise_is_removed():
    z = staircase(500)
    time = np.arange(len(z)) * PERIOD
    hum = 3e-9 * np.sin(2 * np.pi * 48.0 * time)
    _, quiet = cleaned(record_of(z + hum, 2e-9))
    assert quiet is not None
    lines = np.abs(np.fft.rfft(quiet.errors_in_variables)) ** 2
    near = np.abs(np.fft.rfftfreq(len(z), PERIOD) - 48.0) < 0.2
    there = np.sum(np.abs(np.fft.rfft(hum)[near]) ** 2)
    assert np.sum(lines[near]) < 0.02 * there
    assert np.std(quiet.errors_in_variables) > 1.5e-9


def test_it_is_taken_out_once():
    _, quiet = cleaned(record_of(staircase(500), 3e-9))
    again = quiet.evaluated(Structure(0, 0, True), np.array([0.1]))
    assert correct_errors_in_variables(quiet, again) is None


@pytest.mark.parametrize(
    ("rest", "noise"), [(500, 1e-9), *soaked((500, 4e-9), (2000, 4e-9), (2000, 1e-9))]
)
def test_a_lightly_damped_mode_is_known_in_addition(rest, noise):
    """No backlash, further mode or scale error is reported, although each could fit the noise."""
    found = identify(record_of(staircase(rest), noise)).calibration
    certificate = found.certificate
    assert certificate.verdict == "accepted"
    assert certificate.reservations == ()
    assert certificate.residual.encoder_noise_m == pytest.approx(noise, rel=0.1)
    reported = any("did not follow" in warning for warning in map(str, certificate.warnings))
    assert reported == (noise > READING / 3)
    poles = found.dynamics.poles()
    mode = poles[np.argmin(np.abs(np.abs(poles) - OMEGA))]
    assert abs(mode) == pytest.approx(OMEGA, rel=1e-3)
    assert -mode.real / abs(mode) == pytest.approx(DAMPING, rel=0.01)


@pytest.mark.soak
def test_a_quiet_encoder_is_not_spoken_of():
    certificate = identify(record_of(staircase(500), 0.01e-9)).calibration.certificate
    assert certificate.residual.encoder_noise_m is None
    assert not any("did not follow" in warning for warning in map(str, certificate.warnings))


@pytest.mark.parametrize("tail", [1.0, 2.0, 6.0])
def test_how_an_axis_comes_to_rest_is_not_lost_in_its_noise(tail):
    """Steps that end as a servo does, by a power of e each ``tail`` samples: what is taken out of
    the positions averages to nothing. Lost, it would be a lag of its own."""
    rest, edges, noise = 480, 400, 0.4e-9
    phase = np.clip(np.arange(rest + RAMP) / RAMP, 0.0, 1.0)
    edge = phase**3 * (10 - 15 * phase + 6 * phase**2)
    edge = signal.lfilter([1 - np.exp(-1 / tail)], [1, -np.exp(-1 / tail)], edge)
    up = np.where(np.arange(edges) % 2 == 0, 1.0, -1.0)
    start = np.repeat((1 - up) / 2, len(edge))
    z = STEP * (start + np.repeat(up, len(edge)) * np.tile(edge, edges))
    noisy = z + np.random.default_rng(3).normal(0, noise, len(z))
    found = find_steps(noisy, PERIOD).edges
    lost = (z - smoothed(noisy, noise, found)[0]).reshape(edges, -1) * up[:, np.newaxis]
    after = lost[:, RAMP : RAMP + 160].sum(axis=1)
    # A mean of all that agree loses two to five times as much.
    assert abs(np.mean(after)) < noise * tail


def test_moves_that_come_back_to_where_they_were_are_no_steps():
    """Edges without a height: nothing is alike at them; each of their samples keeps its noise."""
    noisy = np.random.default_rng(5).normal(0, 1e-9, 1000)
    noisy[[300, 700]] = STEP
    edges = [Edge(290, 310, 0.0), Edge(690, 710, 0.0)]
    with_edges, without = smoothed(noisy, 1e-9, edges), smoothed(noisy, 1e-9)
    np.testing.assert_array_equal(with_edges[0], without[0])
    assert with_edges[1] ** 2 == pytest.approx(without[1] ** 2 + 4e-20, rel=0.05, abs=0)
