"""Test models of any two sampled quantities: covariance, validity, verdict against truth."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from omsm_ros.core.estimation.model_structure import Structure
from omsm_ros.core.estimation.output_error import fit
from omsm_ros.core.estimation.sampled_choice import SampledCandidate
from omsm_ros.core.estimation.sampled_fit import ZeroOrderHoldProblem
from omsm_ros.core.estimation.sampled_model import Discrete
from omsm_ros.core.identification.sampled_identification import (
    HOLDS,
    _Known,
    identify_samples,
    sampled_certificate,
    widest_valid_range,
)
from omsm_ros.core.lti.frequency_response import Band, ResponseLimits
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.errors import ConfigurationError, IdentificationError

PERIOD = 0.05
TRUTH = TransferFunction.from_ascending([2.0, 0.05], [1.0, 0.05, 0.02])
METHODS = {"zero-order": "zoh", "first-order": "foh"}
LINES = np.array([0.05, 0.3, 1.0, 2.0])


def recorded(hold, noise=0.05, seed=1, samples=800):
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([-1.0, 1.0], samples // 5), 5) + 4.0
    b, a, _ = signal.cont2discrete(
        (TRUTH.numerator[::-1], TRUTH.denominator[::-1]), PERIOD, METHODS[hold]
    )
    return u, signal.lfilter(np.ravel(b), a, u) + 30.0 + rng.normal(0, noise, samples)


@pytest.mark.parametrize("hold", METHODS)
def test_the_continuous_system_behind_the_hold_is_found(hold):
    model = identify_samples(*recorded(hold), PERIOD, hold=hold)
    ratio = model.continuous.response(LINES) / TRUTH.response(LINES)
    assert np.max(np.abs(ratio - 1)) < 0.02
    assert model.certificate["verdict"].startswith("accepted")
    assert model.valid_from < 0.3 < 2.0 < model.valid_up_to
    input_there, output_there = model.working_point
    assert input_there == pytest.approx(4.0, abs=0.3)
    assert output_there == pytest.approx(30.0 + 2.0 * input_there, abs=0.05)


def test_the_wrong_hold_finds_another_system():
    model = identify_samples(*recorded("zero-order"), PERIOD, hold="first-order")
    ratio = model.continuous.response(LINES) / TRUTH.response(LINES)
    assert np.max(np.abs(ratio - 1)) > 0.1


def test_stated_uncertainties_hold_over_many_records():
    """Errors of the response over stated, of 60 records: their rms is 1 within its scatter."""
    pulls, structure = [], Structure(2, 2, False)
    b, a, _ = signal.cont2discrete((TRUTH.numerator[::-1], TRUTH.denominator[::-1]), PERIOD, "zoh")
    true = Discrete(numerator=np.ravel(b), denominator=a, delay=0, covariance=np.zeros((5, 5)))
    for seed in range(60):
        u, y = recorded("zero-order", seed=seed, samples=400)
        used = np.ones(400, bool)
        problem = ZeroOrderHoldProblem(
            u - u.mean(), y, used, PERIOD, np.ones((400, 1)), 0.5 / PERIOD
        )
        start = problem.parametrised(structure).of_discrete(np.roots(a))
        found = fit(problem, structure, [start])
        known = _Known.of(SampledCandidate(problem, found, 2, False, np.empty(0)), 0, PERIOD)
        error = np.log(known.discrete.response(LINES, PERIOD) / true.response(LINES, PERIOD))
        band = known.discrete.band(LINES, PERIOD)
        pulls.append(np.concatenate([error.real / band.gain, error.imag / band.phase]))
    rms = np.sqrt(np.mean(np.square(pulls), axis=0))
    assert rms == pytest.approx(1.0, abs=0.3)


def test_units_do_not_matter():
    u, y = recorded("zero-order")
    plain, scaled = (
        identify_samples(1e-6 * factor * u, 1e9 * factor * y, PERIOD) for factor in (1.0, 1e5)
    )
    assert plain.certificate["order"] == scaled.certificate["order"]
    np.testing.assert_allclose(
        plain.discrete.numerator, scaled.discrete.numerator, rtol=1e-4, atol=1e9
    )


@pytest.mark.soak
def test_an_order_asked_for_is_known_no_better_than_the_free_choice_leaves_open():
    record = recorded("zero-order", noise=0.02)
    free, low = (identify_samples(*record, PERIOD, order=order) for order in (0, 1))
    assert free.certificate["order"] >= 2
    assert low.certificate["order"] == 1
    assert low.certificate["free_order"] == free.certificate["order"]
    assert any("was asked for" in text for text in low.certificate["warnings"])


def test_what_does_not_follow_the_input_is_rejected():
    rng = np.random.default_rng(3)
    u, y = rng.normal(size=600), np.cumsum(rng.normal(size=600))
    for hold in ("zero-order", "band-limited"):
        model = identify_samples(u, y, PERIOD, hold=hold)
        assert model.certificate["verdict"] == "rejected"


def smooth_record(noise=1e-3, samples=6000):
    rng = np.random.default_rng(5)
    numerator, denominator = signal.butter(4, 0.15)
    u = signal.lfilter(numerator, denominator, rng.normal(size=samples + 500))
    spectrum = np.fft.rfft(u) * TRUTH.response(np.fft.rfftfreq(len(u), PERIOD))
    y = np.fft.irfft(spectrum, len(u))
    return u[250:-250], y[250:-250] + rng.normal(0, noise, samples)


def test_a_smooth_input_is_taken_as_band_limited():
    """A part cut out of a longer motion; every other hold would be wrong for it."""
    u, y = smooth_record()
    model = identify_samples(u, y, PERIOD, hold="band-limited")
    lines = np.array([0.1, 0.5, 1.0])
    ratio = model.continuous.response(lines) / TRUTH.response(lines)
    assert np.max(np.abs(ratio - 1)) < 0.01
    assert model.discrete is None
    assert model.certificate["verdict"].startswith("accepted")
    assert model.valid_up_to <= 0.5 / PERIOD


def test_the_pace_of_the_record_only_scales_the_model():
    u, y = smooth_record(samples=2000)
    fast, slow = (identify_samples(u, y, period, hold="band-limited") for period in (1e-3, 10.0))
    np.testing.assert_allclose(
        slow.continuous.response(LINES / 1e4), fast.continuous.response(LINES), rtol=1e-6
    )
    assert slow.valid_up_to == pytest.approx(fast.valid_up_to / 1e4)
    assert np.diag(slow.covariance)[-1] == pytest.approx(1e8 * np.diag(fast.covariance)[-1])


@pytest.mark.parametrize("hold", HOLDS)
def test_bad_records_are_one_clear_error(hold):
    with pytest.raises(IdentificationError, match="the input changes by 0 in all"):
        identify_samples(np.ones(500), np.arange(500.0), PERIOD, hold=hold)
    with pytest.raises(IdentificationError):
        identify_samples(np.arange(9.0), np.arange(9.0), PERIOD, hold=hold)
    with pytest.raises(IdentificationError):
        identify_samples(np.full(500, np.nan), np.arange(500.0), PERIOD, hold=hold)


def test_another_hold_is_refused():
    with pytest.raises(ConfigurationError, match="'second-order'"):
        identify_samples(*recorded("zero-order"), PERIOD, hold="second-order")


class TestVerdict:
    LIMITS = ResponseLimits(gain=0.1, phase=0.1)

    def certified(self, **changed):
        given = {
            "order": 2,
            "free_order": 2,
            "widened": 1.0,
            "valid": (0.1, 3.0),
            "limits": self.LIMITS,
            "entries": {"predicted": 0.9, "independence_p": 0.5},
        }
        return sampled_certificate(**(given | changed))

    def test_good_evidence_is_accepted_within_its_range(self):
        assert self.certified()["verdict"] == "accepted from 0.100 Hz to 3.00 Hz"
        assert self.certified()["warnings"] == []

    def test_the_widest_range_in_octaves_is_taken(self):
        frequency = np.array([1.0, 2.0, 3.0, 4.0, 8.0, 16.0, 32.0])
        gain = np.array([0.01, 0.01, 1.0, 0.01, 0.01, 0.01, 1.0])
        band = Band(frequency, gain, np.zeros(7))
        assert widest_valid_range(band, self.LIMITS) == (4.0, 16.0)
        assert widest_valid_range(replace(band, phase=np.ones(7)), self.LIMITS) == (1.0, 1.0)


def sines(frequencies, samples=4000):
    time = np.arange(samples) * 1e-3
    return sum(np.sin(2 * np.pi * f * time + f) for f in frequencies)


def second_order(u, noise=0.01):
    exact = signal.lfilter([0.0, 0.1, 0.1], [1.0, -1.5, 0.7], u)
    return exact + np.random.default_rng(2).normal(0, noise, len(u))


def test_a_model_is_valid_between_the_frequencies_of_the_input():
    u = sines([5.0, 17.0, 60.0])
    model = identify_samples(u, second_order(u), 1e-3)
    # A third of an octave around a line counts as seen.
    assert 5 / 1.3 < model.valid_from < 5
    assert 60 < model.valid_up_to < 60 * 1.3


@pytest.mark.parametrize(("lines", "order"), [([16.0], 0), ([16.0, 40.0], 2)])
def test_more_poles_than_the_input_excites_are_refused_with_what_to_do(lines, order):
    u = sines(lines)
    excites = rf"excites {2 * len(lines)} parameters only.*steps, noise, or more"
    with pytest.raises(IdentificationError, match=excites):
        identify_samples(u, second_order(u), 1e-3, order=order)


def test_a_square_wave_that_follows_two_sines_is_known_at_those():
    """Its harmonics are none of any linear answer."""
    u = sines([16.0, 23.0])
    model = identify_samples(u, np.sign(np.roll(u, 3)), 1e-3)
    assert model.valid_from >= 16 / 1.3
    assert model.valid_up_to < 23 * 1.3
