"""What is left of a recording is what the fit left, and shows what a model misses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from omsm_ros.core.dynamics.transfer_function import TransferFunction
from omsm_ros.core.identification.explained import autocorrelation, explain, mean_at_edges
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.samples.motion_record import MotionRecord, assemble
from omsm_ros.errors import IdentificationError, StepTestError


@pytest.fixture(scope="module")
def record(step_test):
    return assemble([step_test.axes], [step_test.distance])


@pytest.fixture(scope="module")
def calibration(record):
    return identify(record, order=2)


@pytest.fixture(scope="module")
def explained(record, calibration):
    return explain(record, calibration)


def rms(values):
    return float(np.sqrt(np.nanmean(values**2)))


def test_the_residual_is_the_one_that_was_certified(explained, calibration):
    certificate = calibration.certificate
    assert rms(explained.residual) == pytest.approx(certificate["residual_rms_m"], rel=1e-6)
    compared = int(np.sum(np.isfinite(explained.residual)))
    assert compared == certificate["samples"]["compared"]


def test_seen_is_the_motion_of_the_carriage_late(explained):
    """Over a millimetre the two differ by the lag and the probe's noise, not by gain or sign."""
    difference = explained.seen - explained.carriage
    assert np.ptp(explained.carriage) > 90e-6
    assert rms(explained.seen - explained.modelled) < 11e-9
    assert 100e-9 < np.nanmax(np.abs(difference)) < 1e-6


def test_modelled_agrees_with_a_recursive_filter(explained, calibration):
    """A second method: the bilinear transform in time, where the motion is slow for it."""
    g = calibration.dynamics
    b, a = signal.bilinear(g.numerator[::-1], g.denominator[::-1], 1 / explained.sample_period)
    z = explained.carriage
    filtered = signal.lfilter(b, a, z - z[0]) + z[0]
    settled = slice(100, -100)
    assert np.max(np.abs(filtered - explained.modelled)[settled]) < 5e-9


def test_a_wrong_model_shows_at_the_edges_far_below_the_noise(record, calibration, explained):
    """10 µs of lag on 0.9 mm/s are 9 nm, less than the noise of one reading."""
    late = replace(calibration, dynamics=_delayed(calibration.dynamics, 10e-6), **_uncertain(2))
    right, wrong = (mean_at_edges(e, 30e-3, 60e-3) for e in (explained, explain(record, late)))
    assert right.edges == wrong.edges == 20
    at_edge = np.abs(right.time) < 5e-3
    speed = np.max(np.abs(np.diff(explained.carriage))) / explained.sample_period
    missed = np.mean((wrong.mean - right.mean)[at_edge])
    # The model is later than the probe: the probe is ahead, in the direction of motion.
    assert missed == pytest.approx(10e-6 * speed, rel=0.35)
    assert rms(right.mean) == pytest.approx(rms(explained.residual) / np.sqrt(20), rel=0.25)


def _delayed(dynamics, delay):
    return TransferFunction(dynamics.numerator, dynamics.denominator, dynamics.delay + delay)


def _uncertain(poles):
    size = 2 * poles + 1
    return {"covariance": np.zeros((size, size))}


def test_a_motion_without_edges_has_no_mean_edge(explained):
    assert mean_at_edges(replace(explained, edges=()), 30e-3, 60e-3) is None


def test_edges_too_near_the_end_are_left_out(explained):
    assert mean_at_edges(explained, 30e-3, 60.0) is None


def test_the_estimate_without_a_model_follows_the_model(explained, calibration):
    seen = explained.measured
    low = (seen.frequency >= 1) & (seen.frequency <= 20)
    ratio = seen.response[low] / calibration.dynamics.response(seen.frequency[low])
    assert np.abs(ratio - 1) == pytest.approx(np.zeros(np.sum(low)), abs=2e-3)


def test_a_short_recording_has_no_such_estimate(record, calibration):
    samples = 1500
    short = MotionRecord.from_arrays(
        record.sample_period, record.z[:samples], record.distance[:samples]
    )
    assert explain(short, calibration).measured is None


def test_from_the_reference_sensor(record, calibration):
    with pytest.raises(IdentificationError, match="reference"):
        explain(record, calibration, "reference")
    both = replace(record, reference=record.z)
    assert rms(explain(both, calibration, "reference").residual) < 11e-9


def test_a_recording_at_rest_is_refused(record, calibration):
    still = MotionRecord.from_arrays(1e-3, np.zeros(1000), np.zeros(1000))
    with pytest.raises(StepTestError):
        explain(still, calibration)


class TestAutocorrelation:
    def test_of_a_first_order_process_is_a_power(self):
        noise = np.random.default_rng(1).normal(size=200_000)
        coloured = signal.lfilter([1.0], [1.0, -0.6], noise)
        coloured[::7] = np.nan
        expected = 0.6 ** np.arange(1, 6)
        assert autocorrelation(coloured, 5) == pytest.approx(expected, abs=0.015)

    def test_of_white_noise_stays_within_its_band(self):
        noise = np.random.default_rng(2).normal(size=10_000)
        outside = np.abs(autocorrelation(noise, 200)) > 1.96 / np.sqrt(10_000)
        assert np.mean(outside) == pytest.approx(0.05, abs=0.04)

    def test_of_nothing_is_nothing(self):
        assert np.array_equal(autocorrelation(np.zeros(10), 3), np.zeros(3))
        assert np.array_equal(autocorrelation(np.full(10, np.nan), 3), np.zeros(3))
