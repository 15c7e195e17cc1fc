"""Each check by numbers made up to be good or bad in one respect."""

from itertools import chain

import numpy as np
import pytest

from omsm_ros.core.calibration.certificate import REJECTS, RESERVATION, WARNING
from omsm_ros.core.calibration.intended_use import PAPER_USE, IntendedUse
from omsm_ros.core.identification.checks import (
    accuracy,
    inter_sample_motion,
    late,
    misfit,
    requested_order,
    scale,
    separable_gain,
    trusted_range,
    two_clocks,
    usable,
)
from omsm_ros.core.lti.frequency_response import ResponseLimits
from omsm_ros.core.lti.transfer_function import TransferFunction

LIMITS = ResponseLimits(gain=0.01, phase=0.02)
SLOW = TransferFunction.from_ascending([1.0], [1.0, 1e-2])
FAST = TransferFunction.from_ascending([1.0], [1.0, 1e-4])
LEAST_HZ, HARMLESS_S = PAPER_USE.least_valid_up_to_hz, PAPER_USE.harmless_delay_s


def only(findings, severity):
    """The sentence of the one finding, which has this severity."""
    (finding,) = findings
    assert finding.severity == severity
    return str(finding)


def test_two_clocks_are_a_reservation():
    assert not list(two_clocks(False))
    assert "part of the lag" in only(two_clocks(True), RESERVATION)


def test_a_probe_that_is_later_than_probes_are_is_reserved():
    assert not list(late(60e-3, 1e-3))
    assert not list(late(0.3, 0.1))
    said = only(late(1.00034, 1e-3), RESERVATION)
    assert "1.00 s after the encoder, 1.00 · 10³ samples" in said


@pytest.mark.parametrize("gain", [0.902, 1.1])
def test_a_scale_that_no_probe_has_is_reserved(gain):
    assert not list(scale(0.992))
    assert "counts_per_unit of Z" in only(scale(gain), RESERVATION)


def test_good_evidence_gives_no_finding():
    good = [
        misfit(1.0, 1e-8, None),
        separable_gain(1e-5, 0.01),
        trusted_range(80.0, LIMITS, LEAST_HZ),
        requested_order(3, 1.0),
        inter_sample_motion(1e-8, 1e-6, HARMLESS_S),
        accuracy(PAPER_USE, 1.0),
    ]
    assert not list(chain.from_iterable(good))


@pytest.mark.parametrize(
    ("findings", "reason"),
    [
        (misfit(2.0, 1e-8, None), "misses something"),
        (misfit(0.1, 1e-8, None), "not quiet"),
        (trusted_range(1.0, LIMITS, LEAST_HZ), "more or larger steps"),
        (inter_sample_motion(20e-6, 1e-6, HARMLESS_S), "may shift the lag by 20.0 µs"),
        (separable_gain(0.02, 0.01), "uncertain by 3.9 %"),
    ],
    ids=["residual", "rest", "band", "edges", "gain"],
)
def test_bad_evidence_is_a_reason_by_name(findings, reason):
    assert reason in only(findings, REJECTS)


def test_the_band_of_the_gain_is_95_percent():
    """A standard uncertainty of 0.0051 has a half-width of 0.01 at 1.96 sigma."""
    assert list(separable_gain(0.00515, 0.01))
    assert not list(separable_gain(0.00505, 0.01))


def test_a_bias_below_five_nanometres_on_the_intended_scan_is_harmless():
    """A delay times the rms speed of Z is the error: on half the speed twice the delay is."""
    assert HARMLESS_S * PAPER_USE.speed_m_s == pytest.approx(5e-9)
    half = IntendedUse(tuple((f, rms / 2) for f, rms in PAPER_USE.spectrum))
    assert half.harmless_delay_s == pytest.approx(2 * HARMLESS_S)
    assert not list(inter_sample_motion(6.8e-6, 1e-9, HARMLESS_S))
    assert list(inter_sample_motion(7.1e-6, 1e-9, HARMLESS_S))
    assert not list(inter_sample_motion(7.1e-6, 1e-9, half.harmless_delay_s))


def test_a_faster_scan_needs_a_wider_band():
    fast = IntendedUse(((10.0, 1e-6),))
    assert not list(trusted_range(20.0, LIMITS, LEAST_HZ))
    said = only(trusted_range(20.0, LIMITS, fast.least_valid_up_to_hz), REJECTS)
    assert "need 33 Hz" in said


def test_an_accuracy_that_is_not_reached_is_reserved():
    use = IntendedUse(PAPER_USE.spectrum, accuracy_m=20e-9)
    assert not list(accuracy(use, 9.9e-9))
    assert "uncertainty of 20.2 nm (k = 2)" in only(accuracy(use, 10.1e-9), RESERVATION)


def test_a_wrong_order_asked_for_is_the_cause():
    text = only(misfit(2.0, 1e-8, 4), REJECTS)
    assert "the order asked for is wrong, 4 poles" in text
    assert "backlash" not in text


def test_widened_uncertainties_are_warned_of():
    text = only(requested_order(2, 6.3), WARNING)
    assert "order 2" in text
    assert "6.3 times as large" in text


def test_what_a_corrector_refuses_is_rejected():
    """No record determines a pole that decays for a day, and no filter can have it."""
    never = TransferFunction.from_ascending([1.0, 1e5], [1.0, 1e5 + 1e-3, 1e2])
    known = np.zeros((5, 5))
    assert not list(usable(SLOW, np.zeros((3, 3)), 20.0, 1e-3))
    text = only(usable(never, known, 20.0, 1e-3), REJECTS)
    assert "a model of order 2 cannot correct (" in text
    assert "expected a number from 1e-10 to 1000 s" in text
    assert "ask for fewer" in text


def test_a_finding_carries_the_limit_that_it_exceeds():
    """A reader must be able to repeat the verdict from the certificate alone."""
    (large,), (small,) = misfit(2.0, 1e-8, None), misfit(0.1, 1e-8, None)
    (narrow,) = trusted_range(1.0, LIMITS, LEAST_HZ)
    greatest, least = large.limits["chi_square_greatest"], small.limits["chi_square_least"]
    assert not list(misfit(0.999 * greatest, 1e-8, None))
    assert list(misfit(1.001 * greatest, 1e-8, None))
    assert list(misfit(0.999 * least, 1e-8, None))
    assert narrow.limits == {
        "gain": LIMITS.gain,
        "phase_rad": LIMITS.phase,
        "valid_up_to_least_hz": LEAST_HZ,
    }
