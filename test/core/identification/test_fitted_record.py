"""The drawn record is the one that was certified, and it shows unmodelled dynamics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from benchmarks.recorded import record_from_arrays
from benchmarks.step_test import StepTest
from omsm_ros.core.estimation.model_order import fit
from omsm_ros.core.estimation.model_structure import ScaledStructure
from omsm_ros.core.estimation.steps import find_steps
from omsm_ros.core.identification.fitted_record import autocorrelation, fitted_record, mean_at_edges
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.streams.motion_record import assemble
from omsm_ros.core.surface.nominal import Flat
from omsm_ros.twin.cell import Cell
from omsm_ros.twin.cell import record as recorded
from omsm_ros.twin.plant import Plant


@pytest.fixture(scope="module")
def record(step_test):
    return assemble([step_test.axes], [step_test.distance])


@pytest.fixture(scope="module")
def identified(record):
    return identify(record, order=2)


@pytest.fixture(scope="module")
def fitted(identified):
    return fitted_record(identified)


def rms(values):
    return float(np.sqrt(np.nanmean(values**2)))


def test_the_residual_is_the_one_that_was_certified(fitted, identified):
    certificate = identified.calibration.certificate
    assert rms(fitted.residual) == pytest.approx(certificate.residual.rms_m, rel=1e-12)
    compared = int(np.sum(np.isfinite(fitted.residual)))
    assert compared == certificate.residual.samples["compared"]


@pytest.fixture(scope="module")
def ringing():
    omega = 2 * np.pi * 60
    mode = TransferFunction.from_ascending([1.0], [1.0, 0.02 / omega, omega**-2])
    whole = recorded(Cell(plant=Plant(mode), seed=3), StepTest(), Flat(), stand_off=-49e-6)
    edges = find_steps(whole.axes.z, whole.axes.sample_period).edges
    later = slice(edges[0].stop + 40, None)
    return identify(
        record_from_arrays(
            whole.axes.sample_period, whole.axes.z[later], whole.distance.distance[later]
        )
    )


@pytest.mark.soak
class TestRecordThatStartsRinging:
    """A 60 Hz mode rings down from an edge that was before the first sample."""

    def test_it_is_not_still_at_the_start(self, ringing):
        """Without the initial-condition response the same model misses ten times the noise."""
        without = replace(ringing.prepared.problem, fits_initial_condition=False)
        fit_without = fit(without, ringing.fit.structure, [ringing.fit.nonlinear])
        assert fit_without.rms > 50e-9

    def test_the_page_draws_the_residual_that_is_certified(self, ringing):
        drawn = fitted_record(ringing).residual
        certified = ringing.calibration.certificate.residual.rms_m
        assert certified == pytest.approx(10e-9, rel=0.1)
        assert rms(drawn) == pytest.approx(certified, rel=1e-9)

    def test_the_initial_condition_is_no_part_of_the_output_that_is_drawn(self, ringing):
        """Output over input is the response from the first sample on; noise alone is between."""
        drawn = fitted_record(ringing)
        first_second = slice(0, 1000)
        assert rms((drawn.output - drawn.modelled)[first_second]) < 12e-9


def test_the_output_is_the_input_late(fitted):
    """Over a tenth of a millimetre they differ by lag and noise, not by gain or sign."""
    difference = fitted.output - fitted.input
    assert np.ptp(fitted.input) > 90e-6
    assert rms(fitted.output - fitted.modelled) < 11e-9
    assert 100e-9 < np.nanmax(np.abs(difference)) < 1e-6


def test_modelled_agrees_with_a_recursive_filter(fitted, identified):
    """A second method: the bilinear transform in time, where the motion is slow for it."""
    g = identified.calibration.dynamics
    b, a = signal.bilinear(g.numerator[::-1], g.denominator[::-1], 1 / fitted.sample_period)
    z = fitted.input
    filtered = signal.lfilter(b, a, z - z[0]) + z[0]
    settled = slice(100, -100)
    assert np.max(np.abs(filtered - fitted.modelled)[settled]) < 5e-9


def test_a_wrong_model_shows_at_the_edges_far_below_the_noise(identified, fitted):
    """10 µs of lag on 0.9 mm/s are 9 nm, less than the noise of one reading."""
    late = fitted_record(replace(identified, fit=later(identified, 10e-6)))
    right, wrong = (mean_at_edges(record, 30e-3, 60e-3) for record in (fitted, late))
    assert right.edges == wrong.edges == 20
    at_edge = np.abs(right.time) < 5e-3
    speed = np.max(np.abs(np.diff(fitted.input))) / fitted.sample_period
    missed = np.mean((wrong.mean - right.mean)[at_edge])
    # The model is later than the probe: the probe is ahead, in the direction of motion.
    assert missed == pytest.approx(10e-6 * speed, rel=0.35)
    assert rms(right.mean) == pytest.approx(rms(fitted.residual) / np.sqrt(20), rel=0.25)


def later(identified, delay):
    """The fit with ``delay`` [s] more, and the residual of that."""
    found, problem = identified.fit, identified.prepared.problem
    assert not found.structure.delay
    scaled = ScaledStructure(replace(found.structure, delay=True), problem.rate)
    nonlinear = np.append(found.nonlinear, delay * problem.rate)
    moved = replace(found, scaled=scaled, nonlinear=nonlinear)
    return replace(moved, residual=(problem.output - problem.modelled(moved))[problem.used])


def test_a_motion_without_edges_has_no_mean_edge(fitted):
    assert mean_at_edges(replace(fitted, edges=()), 30e-3, 60e-3) is None


def test_edges_too_near_the_end_are_left_out(fitted):
    assert mean_at_edges(fitted, 30e-3, 60.0) is None


def test_the_estimate_without_a_model_follows_the_model(fitted, identified):
    measured = fitted.measured
    low = (measured.frequency >= 1) & (measured.frequency <= 20)
    model = identified.calibration.dynamics.response(measured.frequency[low])
    assert np.abs(measured.response[low] / model - 1) == pytest.approx(0.0, abs=2e-3)


def test_a_short_recording_has_no_such_estimate(record):
    samples = 1500
    short = record_from_arrays(record.sample_period, record.z[:samples], record.distance[:samples])
    assert fitted_record(identify(short)).measured is None


def test_from_the_reference_sensor(record):
    both = identify(replace(record, reference=record.z), input="reference")
    assert rms(fitted_record(both).residual) < 11e-9


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
