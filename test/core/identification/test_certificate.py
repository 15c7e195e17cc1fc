"""The verdict, from evidence made up to be good or bad in one respect."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from omsm_ros.core.dynamics.response_band import ResponseLimits
from omsm_ros.core.dynamics.transfer_function import TransferFunction
from omsm_ros.core.fitting.model_structure import Structure
from omsm_ros.core.fitting.order_choice import Candidate
from omsm_ros.core.fitting.order_estimate import HankelVote
from omsm_ros.core.identification.certificate import Evidence, certify

GOOD = Evidence(
    chi_square=1.0,
    residual_rms=1e-8,
    noise=1e-8,
    whiteness=0.5,
    independence=0.5,
    valid_up_to=80.0,
    limits=ResponseLimits(gain=0.01, phase=0.02),
    nyquist=500.0,
    delay_noise=1e-6,
    delay_uncertainty=1e-6,
    inter_sample_delay_bound=1e-8,
    gain_apart=1e-5,
    edges=20,
)
SLOW = TransferFunction.from_ascending([1.0], [1.0, 1e-2])
FAST = TransferFunction.from_ascending([1.0], [1.0, 1e-4])


def certificate(evidence, dynamics=SLOW):
    fit = SimpleNamespace(structure=Structure(1, 0, False), rms=1e-8)
    chosen = Candidate(fit, -1.0, 1e-8)
    vote = HankelVote(np.array([2.0, 0.5]), 1, np.empty(0, complex))
    return certify(dynamics, chosen, [chosen], vote, evidence, {"polarity": 1})


def test_good_evidence_is_accepted_as_far_as_it_goes():
    assert certificate(GOOD)["verdict"] == "accepted up to 80 Hz"
    assert certificate(replace(GOOD, valid_up_to=500.0))["verdict"] == "accepted"
    assert certificate(GOOD)["reasons"] == []


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"chi_square": 2.0}, "misses something"),
        ({"chi_square": 0.1}, "not quiet"),
        ({"valid_up_to": 1.0}, "more or larger steps"),
        ({"inter_sample_delay_bound": 5e-6}, "between samples"),
        ({"gain_apart": 0.02}, "uncertain by 3.9 %"),
    ],
)
def test_bad_evidence_is_rejected_by_name(changed, reason):
    rejected = certificate(replace(GOOD, **changed))
    assert rejected["verdict"] == "rejected"
    (text,) = rejected["reasons"]
    assert reason in text


def test_a_pole_beyond_the_trusted_band_is_warned_of():
    (text,) = certificate(GOOD, FAST)["warnings"]
    assert "1592 Hz" in text
    assert certificate(GOOD, SLOW)["warnings"] == []


def test_a_wrong_order_asked_for_is_the_cause():
    (text,) = certificate(replace(GOOD, chi_square=2.0, clearly_better=4))["reasons"]
    assert "the order asked for is wrong, 4 poles" in text
    assert "backlash" not in text


def test_widened_uncertainties_are_warned_of():
    (text,) = certificate(replace(GOOD, widened=6.3))["warnings"]
    assert "6.3 times as large" in text


def test_further_values_are_kept():
    assert certificate(GOOD)["polarity"] == 1


def test_the_limits_of_the_verdict_are_written_down():
    """A reader must be able to repeat the verdict from the certificate alone."""
    limits = certificate(GOOD)["limits"]
    assert limits["gain"] == 0.01
    assert limits["phase_rad"] == 0.02
    just_below = replace(GOOD, chi_square=0.999 * limits["chi_square_greatest"])
    just_above = replace(GOOD, chi_square=1.001 * limits["chi_square_greatest"])
    assert certificate(just_below)["verdict"] != "rejected"
    assert certificate(just_above)["verdict"] == "rejected"
    quiet = replace(GOOD, chi_square=0.999 * limits["chi_square_least"])
    assert certificate(quiet)["verdict"] == "rejected"
    short = replace(GOOD, valid_up_to=0.999 * limits["valid_up_to_least_hz"])
    assert certificate(short)["verdict"] == "rejected"
