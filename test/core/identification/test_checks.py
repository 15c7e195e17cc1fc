"""Each check by numbers made up to be good or bad in one respect."""

from itertools import chain

import pytest

from omsm_ros.core.identification.checks import (
    late,
    misfit,
    poles_beyond_valid_range,
    requested_order,
    scale,
    separable_gain,
    trusted_range,
    two_clocks,
)
from omsm_ros.core.identification.covariance_terms import inter_sample_motion_finding
from omsm_ros.core.lti.frequency_response import ResponseLimits
from omsm_ros.core.lti.transfer_function import TransferFunction

LIMITS = ResponseLimits(gain=0.01, phase=0.02)
SLOW = TransferFunction.from_ascending([1.0], [1.0, 1e-2])
FAST = TransferFunction.from_ascending([1.0], [1.0, 1e-4])


def test_two_clocks_are_a_reservation():
    assert not two_clocks(False).reservations
    (said,) = two_clocks(True).reservations
    assert "part of the lag" in said


def test_a_probe_that_is_later_than_probes_are_is_reserved():
    assert not late(60e-3, 1e-3).reservations
    assert not late(0.3, 0.1).reservations
    (said,) = late(1.00034, 1e-3).reservations
    assert "1.00 s after the encoder, 1.00 · 10³ samples" in said


@pytest.mark.parametrize("gain", [0.902, 1.1])
def test_a_scale_that_no_probe_has_is_reserved(gain):
    assert not scale(0.992).reservations
    (said,) = scale(gain).reservations
    assert "counts_per_unit of Z" in said


def test_good_evidence_gives_no_reason_and_no_warning():
    good = [
        misfit(1.0, 1e-8, None),
        separable_gain(1e-5, 0.01),
        trusted_range(80.0, LIMITS),
        requested_order(3, 1.0),
        poles_beyond_valid_range(SLOW, 80.0, 500.0),
        inter_sample_motion_finding(1e-8, 1e-6),
    ]
    assert not list(chain.from_iterable(f.reasons + f.warnings for f in good))


@pytest.mark.parametrize(
    ("finding", "reason"),
    [
        (misfit(2.0, 1e-8, None), "misses something"),
        (misfit(0.1, 1e-8, None), "not quiet"),
        (trusted_range(1.0, LIMITS), "more or larger steps"),
        (inter_sample_motion_finding(20e-6, 1e-6), "between samples may shift the lag by 20.0 µs"),
        (separable_gain(0.02, 0.01), "uncertain by 3.9 %"),
    ],
)
def test_bad_evidence_is_a_reason_by_name(finding, reason):
    (text,) = finding.reasons
    assert reason in text


def test_the_band_of_the_gain_is_95_percent():
    """A standard uncertainty of 0.0051 has a half-width of 0.01 at 1.96 sigma."""
    assert separable_gain(0.00515, 0.01).reasons
    assert not separable_gain(0.00505, 0.01).reasons


def test_a_bias_below_five_nanometres_of_a_scan_is_held_by_the_band():
    """It is 3 mdeg at 15 Hz: a lag known even better need not be rejected for it."""
    assert not inter_sample_motion_finding(6.9e-6, 1e-9).reasons
    assert inter_sample_motion_finding(7.1e-6, 1e-9).reasons


def test_a_pole_beyond_the_trusted_band_is_warned_of():
    (text,) = poles_beyond_valid_range(FAST, 80.0, 500.0).warnings
    assert "1.59 kHz" in text


def test_a_wrong_order_asked_for_is_the_cause():
    (text,) = misfit(2.0, 1e-8, 4).reasons
    assert "the order asked for is wrong, 4 poles" in text
    assert "backlash" not in text


def test_widened_uncertainties_are_warned_of():
    (text,) = requested_order(2, 6.3).warnings
    assert "order 2" in text
    assert "6.3 times as large" in text


def test_the_limits_are_written_down():
    """A reader must be able to repeat the verdict from the certificate alone."""
    limits = misfit(1.0, 1e-8, None).limits | trusted_range(80.0, LIMITS).limits
    assert limits["gain"] == LIMITS.gain
    assert limits["phase_rad"] == LIMITS.phase
    assert not misfit(0.999 * limits["chi_square_greatest"], 1e-8, None).reasons
    assert misfit(1.001 * limits["chi_square_greatest"], 1e-8, None).reasons
    assert misfit(0.999 * limits["chi_square_least"], 1e-8, None).reasons
    assert trusted_range(0.999 * limits["valid_up_to_least_hz"], LIMITS).reasons
