"""Test timing jitter: noise in proportion to the rate of the axis."""

import numpy as np
import pytest
from scipy import signal
from soaked import soaked

from benchmarks.recorded import record_from_arrays
from benchmarks.step_test import StepTest
from omsm_ros.core.estimation.noise import motion_scatter, timing_variance
from omsm_ros.core.identification.identify import identify

PERIOD, LAG_S, SCATTER_S = 1e-3, 0.34e-3, 50e-6
TEST = StepTest()
TIME = np.arange(0.0, TEST.duration, PERIOD)
RATE = np.gradient(TEST.positions(TIME).z, PERIOD)


def test_the_scatter_is_distinguished_from_noise():
    rng = np.random.default_rng(1)
    noise = rng.normal(0, 10e-9, len(TIME))
    late = noise + RATE * rng.normal(0, SCATTER_S, len(TIME))
    late[100] = np.nan
    assert np.sqrt(timing_variance(late, RATE)) == pytest.approx(SCATTER_S, rel=0.15)


@pytest.mark.parametrize("seed", [0, *soaked(*range(1, 10))])
def test_noise_alone_shows_none(seed):
    noise = np.random.default_rng(seed).normal(0, 10e-9, len(TIME))
    assert timing_variance(noise, RATE) == 0.0


@pytest.mark.parametrize("seed", [0, *soaked(*range(1, 20))])
def test_a_motion_that_hardly_ever_rests_shows_none(seed):
    """The few readings at its turning points know the noise to a few per cent only."""
    rate = 1e-3 * np.sin(2 * np.pi * 3.0 * TIME)
    noise = np.random.default_rng(seed).normal(0, 10e-9, len(TIME))
    assert timing_variance(noise, rate) == 0.0


def test_a_lag_that_the_model_misses_is_no_scatter():
    noise = np.random.default_rng(2).normal(0, 10e-9, len(TIME))
    assert timing_variance(noise + 50e-6 * RATE, RATE) == 0.0
    # It is not identifiable either without a stationary segment.
    assert timing_variance(noise, np.ones(len(TIME))) == 0.0


@pytest.mark.parametrize("seed", [1, *soaked(2)])
def test_a_probe_that_scatters_is_accepted_with_a_warning(seed):
    rng = np.random.default_rng(seed)
    z = TEST.positions(TIME).z + rng.normal(0, 0.3e-9, len(TIME))
    when = TIME - LAG_S + rng.normal(0, SCATTER_S, len(TIME))
    seen = TEST.positions(when).z + rng.normal(0, 10e-9, len(TIME))
    certificate = identify(record_from_arrays(PERIOD, z, -seen)).calibration.certificate
    assert str(certificate.verdict).startswith("accepted with reservations")
    assert certificate.residual.timing_scatter_s == pytest.approx(SCATTER_S, rel=0.2)
    (reported,) = map(str, certificate.reservations)
    assert "scatter in time by" in reported
    assert certificate.residual.chi_square < 1.2


@pytest.mark.parametrize("scatter", [10e-6, 50e-6])
def test_the_axis_itself_shows_how_its_readings_scatter(scatter):
    rng = np.random.default_rng(3)
    z = TEST.positions(TIME + rng.normal(0, scatter, len(TIME))).z
    z = z + rng.normal(0, 0.3e-9, len(TIME))
    assert motion_scatter(z, np.gradient(z, PERIOD)) == pytest.approx(scatter, rel=0.15)


@pytest.mark.parametrize("rise", [3e-3, 5e-3, 10e-3, 20e-3])
def test_edges_however_sharp_are_no_scatter(rise):
    rng = np.random.default_rng(4)
    z = StepTest(rise=rise).positions(TIME).z + rng.normal(0, 0.3e-9, len(TIME))
    assert motion_scatter(z, np.gradient(z, PERIOD)) < 3e-6


def test_an_axis_that_scatters_is_named_as_the_cause():
    """Behind a structure what its readings scatter by lasts, and looks like a loose mount."""
    rng = np.random.default_rng(1)
    z = TEST.positions(TIME + rng.normal(0, SCATTER_S, len(TIME))).z
    omega = 2 * np.pi * 62.0
    system = signal.cont2discrete(([omega**2], [1, 0.16 * omega, omega**2]), PERIOD, "foh")
    seen = signal.lfilter(system[0].ravel(), system[1], TEST.positions(TIME).z)
    record = record_from_arrays(PERIOD, z, -seen + rng.normal(0, 10e-9, len(TIME)))
    certificate = identify(record).calibration.certificate
    assert certificate.residual.axis_timing_scatter_s == pytest.approx(SCATTER_S, rel=0.2)
    reported = [*map(str, certificate.reasons), *map(str, certificate.reservations)]
    assert any("readings of the axis scatter in time" in text for text in reported)
    assert not any("loose" in text for text in map(str, certificate.reasons))


def staircase(time, starts):
    """Positions (n,) [m] of ten steps of 10 µm up and ten down, each from one of ``starts`` on."""
    phase = np.clip((time[:, np.newaxis] - starts) / 20e-3, 0, 1)
    heights = np.where(np.arange(len(starts)) < len(starts) / 2, 10e-6, -10e-6)
    return (phase**3 * (10 - 15 * phase + 6 * phase**2)) @ heights


@pytest.mark.parametrize("seed", [0, *soaked(1, 2)])
@pytest.mark.parametrize("place", [0.4, *soaked(0.25, 0.45)])
def test_counts_that_every_plateau_rounds_alike_are_no_machine_error(place, seed):
    """Steps of whole counts: at rest all readings are wrong by the same part of a count."""
    rng = np.random.default_rng(seed)
    starts = 0.4 + 0.52 * np.arange(20) + rng.uniform(0, PERIOD, 20)
    time = np.arange(0.0, starts[-1] + 0.5, PERIOD)
    z = 10e-9 * np.round(staircase(time, starts) / 10e-9 + place)
    seen = staircase(time - LAG_S, starts) + rng.normal(0, 5e-9, len(time))
    calibration = identify(record_from_arrays(PERIOD, z, -seen)).calibration
    assert str(calibration.certificate.verdict) == "accepted"
    assert calibration.certificate.reservations == ()
    late = calibration.dynamics.low_frequency_delay
    assert abs(late - LAG_S) < 2 * calibration.low_frequency_delay_uncertainty
