"""Each check by numbers made up to be good or bad in one respect."""

from itertools import chain
from types import SimpleNamespace

import numpy as np
import pytest

from omsm_ros.core.calibration.certificate import REJECTS, RESERVATION, WARNING
from omsm_ros.core.calibration.intended_use import PAPER_USE, IntendedUse
from omsm_ros.core.identification import checks
from omsm_ros.core.identification.checks import (
    accuracy,
    inter_sample_motion,
    latency,
    misfit,
    recording,
    requested_order,
    separable_gain,
    trusted_range,
    usable,
)
from omsm_ros.core.lti.frequency_response import ResponseLimits
from omsm_ros.core.lti.transfer_function import TransferFunction

LIMITS = ResponseLimits(gain=0.01, phase=0.02)
SLOW = TransferFunction.from_ascending([1.0], [1.0, 1e-2])
FAST = TransferFunction.from_ascending([1.0], [1.0, 1e-4])
LEAST_HZ, HARMLESS_S = PAPER_USE.least_valid_up_to_hz, PAPER_USE.harmless_delay_s


def has_lag(lag, uncertainty=1e-6):
    """The dynamics of a lag [s], negative for a lead, and the covariance of its coefficients."""
    covariance = np.zeros((5, 5))
    covariance[-1, -1] = uncertainty**2
    return TransferFunction(np.array([1.0, 2.0 - lag]), np.array([1.0, 2.0, 1.0])), covariance


GOOD_LAG = has_lag(0.3e-3)


def evidence(
    lag=GOOD_LAG,
    gain=1.0,
    uncertain=1e-5,
    bound=1e-8,
    delay_noise=1e-6,
    reached=1.0,
    use=PAPER_USE,
    period=1e-3,
    noises=(1e-9, 1e-8),
    by_stamps=False,
    **known,
):
    """Evidence of a good record but for what is stated."""
    residual = {"chi_square": 1.0, "noise": noises[1], "timing": 0.0, "axis_timing": 0.0}
    residual |= {name: known.pop(name) for name in residual if name in known}
    dynamics, covariance = lag
    problem = SimpleNamespace(period=period, errors_in_variables=None)
    return SimpleNamespace(
        prepared=SimpleNamespace(
            problem=problem, axis_spikes=0, steps=SimpleNamespace(noise=noises[0])
        ),
        record=SimpleNamespace(sample_period=period, by_stamps=by_stamps),
        residual=SimpleNamespace(**residual),
        known=SimpleNamespace(
            **{
                "covariance": covariance,
                "from_noise": has_lag(0.0, delay_noise)[1],
                "clearly_better": None,
                "valid_up_to": 80.0,
                "widened": 1.0,
            }
            | known
        ),
        fit=SimpleNamespace(gain=gain, uncertain=uncertain, structure=SimpleNamespace(poles=2)),
        dynamics=dynamics,
        lag_in_residual=(0.0, 0.0),
        inter_sample_delay=bound,
        limits=LIMITS,
        use=use,
        reached=reached,
    )


@pytest.fixture(autouse=True)
def computed(monkeypatch):
    """Stated numbers stand for those computed from a fit."""
    monkeypatch.setattr(checks, "gain_uncertainty_alone", lambda problem, fit: fit.uncertain)
    monkeypatch.setattr(checks, "accuracy_on", lambda stated: stated.reached)


def only(findings, severity):
    """The sentence of the one finding, which has this severity."""
    (finding,) = findings
    assert finding.severity == severity
    return str(finding)


def test_two_clocks_are_a_reservation():
    assert not list(recording(evidence()))
    assert "part of the lag" in only(recording(evidence(by_stamps=True)), RESERVATION)


def test_a_probe_that_is_later_than_probes_are_is_reserved():
    assert not list(latency(evidence(has_lag(60e-3))))
    assert not list(latency(evidence(has_lag(0.3), period=0.1)))
    said = only(latency(evidence(has_lag(1.00034))), RESERVATION)
    assert "1.00 s after the encoder, 1.00 · 10³ samples" in said


@pytest.mark.parametrize(
    ("lag", "uncertainty", "noises", "reported"),
    [
        (0.3e-3, 1e-6, (1e-9, 1e-8), ""),
        (-3e-6, 1e-7, (1e-9, 1e-8), ""),
        (-30e-6, 1e-5, (1e-9, 1e-8), ""),
        (-30e-6, 1e-6, (1e-9, 1e-8), "the encoder is read late"),
        (-30e-6, 1e-6, (1e-8, 1e-9), "channels are exchanged"),
    ],
)
def test_a_probe_that_leads(lag, uncertainty, noises, reported):
    found = list(latency(evidence(has_lag(lag, uncertainty), noises=noises)))
    assert reported in " ".join(map(str, found))
    assert len(found) == bool(reported)
    assert [f.severity == REJECTS for f in found] == [("exchanged" in reported)] * len(found)


@pytest.mark.parametrize("gain", [0.902, 1.1])
def test_a_scale_that_no_probe_has_is_reserved(gain):
    assert not list(recording(evidence(gain=-0.992)))
    assert "counts_per_unit of Z" in only(recording(evidence(gain=gain)), RESERVATION)


def test_good_evidence_gives_no_finding():
    every = (latency, misfit, recording, separable_gain, trusted_range, requested_order)
    every = (*every, inter_sample_motion, accuracy)
    assert not list(chain.from_iterable(check(evidence()) for check in every))


@pytest.mark.parametrize(
    ("check", "stated", "reason"),
    [
        (misfit, {"chi_square": 2.0}, "misses something"),
        (misfit, {"chi_square": 0.1}, "not quiet"),
        (trusted_range, {"valid_up_to": 1.0}, "more or larger steps"),
        (inter_sample_motion, {"bound": 20e-6}, "may shift the lag by 20.0 µs"),
        (separable_gain, {"uncertain": 0.02}, "uncertain by 3.9 %"),
    ],
    ids=["residual", "rest", "band", "edges", "gain"],
)
def test_bad_evidence_is_a_reason_by_name(check, stated, reason):
    assert reason in only(check(evidence(**stated)), REJECTS)


def test_the_band_of_the_gain_is_95_percent():
    """A standard uncertainty of 0.0051 has a half-width of 0.01 at 1.96 sigma."""
    assert list(separable_gain(evidence(uncertain=0.00515)))
    assert not list(separable_gain(evidence(uncertain=0.00505)))


def test_a_bias_below_five_nanometres_on_the_intended_scan_is_harmless():
    """A delay times the rms speed of Z is the error: on half the speed twice the delay is."""
    assert HARMLESS_S * PAPER_USE.speed_m_s == pytest.approx(5e-9)
    half = IntendedUse(tuple((f, rms / 2) for f, rms in PAPER_USE.spectrum))
    assert half.harmless_delay_s == pytest.approx(2 * HARMLESS_S)
    assert not list(inter_sample_motion(evidence(bound=6.8e-6, delay_noise=1e-9)))
    assert list(inter_sample_motion(evidence(bound=7.1e-6, delay_noise=1e-9)))
    assert not list(inter_sample_motion(evidence(bound=7.1e-6, delay_noise=1e-9, use=half)))


def test_a_faster_scan_needs_a_wider_band():
    fast = IntendedUse(((10.0, 1e-6),))
    assert not list(trusted_range(evidence(valid_up_to=20.0)))
    said = only(trusted_range(evidence(valid_up_to=20.0, use=fast)), REJECTS)
    assert "need 33 Hz" in said


def test_an_accuracy_that_is_not_reached_is_reserved():
    use = IntendedUse(PAPER_USE.spectrum, accuracy_m=20e-9)
    assert not list(accuracy(evidence(use=use, reached=9.9e-9)))
    assert "uncertainty of 20.2 nm (k = 2)" in only(
        accuracy(evidence(use=use, reached=10.1e-9)), RESERVATION
    )


def test_a_wrong_order_asked_for_is_the_cause():
    text = only(misfit(evidence(chi_square=2.0, clearly_better=4)), REJECTS)
    assert "the order asked for is wrong, 4 poles" in text
    assert "backlash" not in text


def test_widened_uncertainties_are_warned_of():
    text = only(requested_order(evidence(widened=6.3)), WARNING)
    assert "order 2" in text
    assert "6.3 times as large" in text


def test_what_a_corrector_refuses_is_rejected():
    """No record determines a pole that decays for a day, and no filter can have it."""
    never = TransferFunction.from_ascending([1.0, 1e5], [1.0, 1e5 + 1e-3, 1e2])
    known = np.zeros((5, 5))
    assert not list(usable(evidence((SLOW, np.zeros((3, 3))))))
    text = only(usable(evidence((never, known))), REJECTS)
    assert "a model of order 2 cannot correct (" in text
    assert "expected a number from 1e-10 to 1000 s" in text
    assert "ask for fewer" in text


def test_a_finding_carries_the_limit_that_it_exceeds():
    """A reader must be able to repeat the verdict from the certificate alone."""
    (large,), (small,) = (misfit(evidence(chi_square=each)) for each in (2.0, 0.1))
    (narrow,) = trusted_range(evidence(valid_up_to=1.0))
    greatest, least = large.limits["chi_square_greatest"], small.limits["chi_square_least"]
    assert not list(misfit(evidence(chi_square=0.999 * greatest)))
    assert list(misfit(evidence(chi_square=1.001 * greatest)))
    assert list(misfit(evidence(chi_square=0.999 * least)))
    assert narrow.limits == {
        "gain": LIMITS.gain,
        "phase_rad": LIMITS.phase,
        "valid_up_to_least_hz": LEAST_HZ,
    }
