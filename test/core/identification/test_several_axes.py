"""Several recordings, and several axes that move the probe, of a machine in plain numpy.

The machine is a sum of responses in the frequency domain over one period, so it shares nothing
with the product. Corrected heights of another motion are compared with the truth.
"""

from dataclasses import replace

import numpy as np
import pytest
from soaked import soaked

from benchmarks.recorded import record_from_arrays
from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.correction.motion_filter import MOVED, SENSITIVITIES, MotionFilter, MotionFilters
from omsm_ros.core.estimation.preparation import joined_recordings
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.streams.pairing import SampleRun
from omsm_ros.errors import DataError, StepTestError

PERIOD = 1e-3
MODE, DAMPING, DELAY = 2 * np.pi * 90.0, 0.15, 0.4e-3


def staircase(rng, samples, height, every):
    """Return smooth steps up and down; the middle of each edge lies anywhere between samples."""
    time = np.arange(samples) * PERIOD
    position = np.zeros(samples)
    for k, start in enumerate(np.arange(every, samples * PERIOD - every, every)):
        phase = np.clip((time - start - rng.uniform(0, PERIOD)) / 0.03, 0, 1)
        sign = (-1) ** (k // 3)
        position += (
            sign * height * rng.uniform(0.3, 1) * phase**3 * (10 - 15 * phase + 6 * phase**2)
        )
    return position


def answer(z, x, c, lag=DELAY):
    """Return the motion of the probe: each axis through the mode with a numerator of its own."""
    padded = 4 * len(z)
    s = 2j * np.pi * np.fft.rfftfreq(padded, PERIOD)
    below = np.exp(-lag * s) / (1 + 2 * DAMPING * s / MODE + (s / MODE) ** 2)
    total = 0
    for motion, numerator in ((z, 1 + 1e-4 * s), (x, 0.02 + 2e-4 * s), (c, 3e-6 + 1e-7 * s)):
        line = np.concatenate([motion, np.linspace(motion[-1], motion[0], padded - len(motion))])
        total = total + numerator * np.fft.rfft(line)
    moved = np.fft.irfft(below * total, padded)
    return moved[: len(z)]


def recording(seed, noise=5e-9, samples=8_000, lag=DELAY):
    rng = np.random.default_rng(seed)
    z = staircase(rng, samples, 9e-6, 0.45)
    x = staircase(rng, samples, 2e-4, 0.62)
    c = staircase(rng, samples, 0.5, 0.81)
    distance = -1.002 * answer(z, x, c, lag) + rng.normal(0, noise, samples) + seed * 1e-6
    record = record_from_arrays(PERIOD, z, distance)
    return replace(record, further={"x": x, "c": c})


def alone(record, lag=DELAY):
    """Return the record of a machine at which X and C do not reach the probe."""
    zero = np.zeros(len(record))
    moved = answer(record.z, record.further["x"], record.further["c"], lag)
    only = answer(record.z, zero, zero, lag)
    return replace(record, distance=record.distance + 1.002 * (moved - only), further={})


def errors_of(calibration, seed):
    """Return errors of corrected heights over those that noise explains, of another motion."""
    rng = np.random.default_rng(seed)
    time = np.arange(6000) * PERIOD
    z, x, c = (
        size * sum(np.sin(2 * np.pi * f * time + rng.uniform(0, 6)) for f in rng.uniform(1, 12, 4))
        for size in (5e-6, 2e-4, 0.3)
    )
    axes = np.array([x, np.zeros(len(z)), z, np.zeros(len(z)), c])
    run = SampleRun(0, 0, 0, 10**6, np.zeros(len(z), np.uint8), axes)
    filters = MotionFilters.of(calibration, PERIOD)
    (out,) = MotionFilter(filters).push(run)
    noise = len(filters.dynamics) - filters.undetected
    error = out.values[MOVED] - answer(z, x, c)
    stated = np.sqrt(np.sum(out.values[SENSITIVITIES:][:noise] ** 2, axis=0))
    return (error / stated)[1500:4000:50], error[1500:4000]


@pytest.mark.parametrize("seeds", [[0], *soaked(range(2))])
def test_heights_of_all_axes_are_right_within_the_noise_of_the_step_test(seeds):
    ratios = []
    for seed in seeds:
        identified = identify(recording(seed)).calibration
        calibration = Calibration.from_content(identified.content())
        assert set(calibration.further) == {"x", "c"}
        ratio, error = errors_of(calibration, 100 + seed)
        ratios.append(ratio)
        assert np.max(np.abs(error)) < 5e-9
    # Each test has few independent directions, so its ratios are alike.
    assert 0.4 < np.sqrt(np.mean(np.square(ratios))) < 1.7


@pytest.mark.soak
def test_several_recordings_give_one_model_and_name_the_one_that_differs():
    lag = DELAY + 2 * DAMPING / MODE - 1e-4
    two = [alone(recording(seed)) for seed in range(2)]
    both = identify(joined_recordings(two)).calibration
    spread = both.low_frequency_delay_uncertainty
    assert abs(both.dynamics.low_frequency_delay - lag) < 3 * spread
    assert spread < identify(two[0]).calibration.low_frequency_delay_uncertainty
    assert not both.certificate.reservations
    late = alone(recording(2, lag=DELAY + 40e-6), DELAY + 40e-6)
    apart = identify(joined_recordings([*two, late]), order=2).calibration
    (reservation,) = apart.certificate.reservations
    assert reservation.code == "identification.recordings_differ"
    assert "recording 3 against the others" in str(reservation)
    assert apart.low_frequency_delay_uncertainty > 20e-6


def test_an_axis_that_only_has_noise_is_refused():
    first = recording(0)
    noise = np.random.default_rng(1).normal(0, 1e-9, len(first))
    with pytest.raises(StepTestError, match="axis 'x'"):
        identify(replace(first, further={"x": noise}))


def test_recordings_of_other_rates_are_refused():
    first = alone(recording(0))
    with pytest.raises(DataError, match="recording 2"):
        joined_recordings([first, replace(first, sample_period=2e-3)])


def test_a_long_stretch_out_of_range_parts_a_recording():
    """Nothing compared is lost, and motion and readings keep their relation within each part."""
    first, second = (alone(recording(seed)) for seed in range(2))
    z = np.concatenate([first.z, np.full(50_000, first.z[-1]), first.z[-1] + second.z])
    unread = np.full(50_000, np.nan)
    whole = record_from_arrays(PERIOD, z, np.concatenate([first.distance, unread, second.distance]))
    whole = replace(whole, counts={"out of range": 50_000})
    found = joined_recordings([whole])
    assert len(found) < len(first) + len(second) + 2500
    assert found.counts == whole.counts
    for part, start in zip((first, second), (0, len(found) - len(second)), strict=True):
        place = slice(start, start + len(part))
        assert np.all(found.ok[place] == part.ok)
        assert np.allclose(np.diff(found.z[place]), np.diff(part.z), atol=1e-18)
        assert np.allclose(np.diff(found.distance[place]), np.diff(part.distance), atol=1e-15)
    short = replace(whole, ok=whole.ok | (np.arange(len(whole)) % 100 == 0))
    assert joined_recordings([short]) is short
