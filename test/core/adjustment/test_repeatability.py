"""Repeated step tests of the twin: alike where nothing changed, and not where it did."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from certified import certified_by
from scipy import stats

from benchmarks.step_test import StepTest
from omsm_ros.cli.calibration import repeatability_text
from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.calibration.certificate import Certificate
from omsm_ros.core.calibration.repeatability import repeatability
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.streams.motion_record import assemble
from omsm_ros.core.surface.nominal import Flat
from omsm_ros.errors import CalibrationError
from omsm_ros.twin.cell import Cell, record
from omsm_ros.twin.plant import PAPER_STATIC_GAIN, Plant

COUNT = 6


@lru_cache(maxsize=16)
def calibrated(seed, later=0.0):
    truth = Plant().dynamics
    plant = Plant(TransferFunction(truth.numerator, truth.denominator, truth.delay + later))
    recording = record(
        Cell(plant=plant, seed=seed), StepTest(count=5), Flat(), stand_off=-4.9e-6 * 5
    )
    return identify(assemble([recording.axes], [recording.distance])).calibration


def drawn(seed, count=COUNT, scale=1.0):
    """One-pole calibrations that scatter ``scale`` times what they state."""
    rng = np.random.default_rng(seed)
    lag, gain = 2e-6, 4e-6
    covariance = np.diag([0.0, lag**2, 0.0])
    return [
        Calibration(
            dynamics=TransferFunction([1.0], [1.0, 3e-3 + scale * lag * rng.normal()]),
            static_gain=0.99 + scale * gain * rng.normal(),
            sample_period=1e-3,
            valid_up_to=60.0,
            covariance=covariance,
            certificate=certified_by({"static_gain_uncertainty": gain}),
        )
        for _ in range(count)
    ]


@pytest.mark.soak
def test_an_unchanged_twin_repeats_as_well_as_it_states():
    found = repeatability([calibrated(seed) for seed in range(COUNT)])
    assert found.repeatable
    assert found.count == COUNT
    assert repeatability_text(found).startswith("6 calibrations as repeatable as stated")
    # The standard deviation of six is known to 32 %: three of its sigmas.
    assert 0.2 < found.delay.ratio < 2.0
    assert 0.2 < found.static_gain.ratio < 2.0
    assert np.all(found.phase_deviation < 2.0 * found.phase_stated)
    assert found.static_gain.mean == pytest.approx(PAPER_STATIC_GAIN, abs=3e-5)
    assert found.delay.mean == pytest.approx(Plant().dynamics.low_frequency_delay, abs=5e-6)


@pytest.mark.soak
def test_a_probe_whose_delay_wanders_does_not_repeat():
    wandering = [calibrated(seed, later=20e-6 * (seed % 2)) for seed in range(COUNT)]
    found = repeatability(wandering)
    assert not found.repeatable
    assert "scatter more" in repeatability_text(found)
    # Half at 0, half at 20 µs: 10 µs apart from their mean, n - 1.
    assert found.delay.deviation == pytest.approx(10e-6 * np.sqrt(6 / 5), rel=0.35)


def test_the_p_value_is_uniform_for_a_machine_that_repeats():
    values = [repeatability(drawn(seed)).p_value for seed in range(200)]
    assert stats.kstest(values, "uniform").pvalue > 1e-3


def test_twice_the_stated_scatter_is_found():
    found = [repeatability(drawn(seed, 10, scale=2.0)) for seed in range(50)]
    assert np.mean([f.delay.ratio for f in found]) == pytest.approx(2.0, rel=0.1)
    assert np.mean([f.static_gain.ratio for f in found]) == pytest.approx(2.0, rel=0.1)
    # Nine degrees of freedom of the lag and nine of the gain; 50 runs tell to 0.04.
    power = stats.chi2.sf(stats.chi2.isf(1e-3, 18) / 2.0**2, 18)
    assert np.mean([not f.repeatable for f in found]) == pytest.approx(power, abs=0.12)


def test_scatter_of_the_response_is_that_of_its_lag():
    """Well below the pole the phase is -ω times the lag."""
    found = repeatability(drawn(1, 20))
    expected = 2 * np.pi * found.frequency[0] * found.delay.deviation
    assert found.phase_deviation[0] == pytest.approx(expected, rel=1e-3)
    assert np.all(np.diff(found.frequency) > 0)


def test_without_a_stated_gain_uncertainty_its_ratio_is_unknown():
    found = repeatability([replace(c, certificate=Certificate()) for c in drawn(3)])
    assert np.isnan(found.static_gain.ratio)
    assert "nan" not in repeatability_text(found)
    assert repeatability_text(found).count("of stated") == 1
    assert 0 < found.p_value <= 1


def test_two_are_no_series():
    with pytest.raises(CalibrationError, match="three or more"):
        repeatability(drawn(1, 2))


def test_all_must_know_a_band():
    *most, last = drawn(1)
    with pytest.raises(CalibrationError, match="no common band"):
        repeatability([*most, replace(last, valid_up_to=0.01)])
