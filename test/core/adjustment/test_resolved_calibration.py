"""Update of a calibration by scans: against series, differences and the rules of covariances."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from certified import certified_by

from omsm_ros.core.adjustment.resolved_calibration import (
    after_step_test,
    from_scans_alone,
    resolved,
    undetermined,
    unit_calibration,
    without_step_test,
)
from omsm_ros.core.adjustment.self_calibration import (
    CURVATURE,
    GAIN,
    LAG,
    LATENCY,
    ScanConsistency,
    SelfCalibration,
)
from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.calibration.latency import REVERSAL, SPEEDS
from omsm_ros.core.lti.transfer_function import TransferFunction, slow_motion_jacobian
from omsm_ros.core.streams.blocks import FloatArray

PERIOD = 1e-3
MIXING = np.random.default_rng(8).normal(size=(4, 4))
UNITS = np.array([1e-6, 1e-8, 1e-4, 2e-6])
COVARIANCE = UNITS[:, np.newaxis] * (MIXING @ MIXING.T) * UNITS
VALUES = np.array([3.1e-4, 2.0e-7, 0.0, 1.2e-4])


def found_by(values: FloatArray = VALUES, **other: object) -> SelfCalibration:
    """Return the result of a fit, by default with all parameters known and no contradiction."""
    stated: dict[str, object] = {
        "values": np.asarray(values, np.float64),
        "covariance": COVARIANCE,
        "known": np.ones(4, np.bool_),
        "speeds": (np.pi, 2 * np.pi),
        "residual": 10e-9,
        "followed": 1e-9,
        "agreement": ScanConsistency(ratio=1.0, disagreement=0.1e-9, noise=10e-9),
        "prior_conflict": 1.0,
        "own": np.array([[1e-7, 2e-7, 3e-7, 4e-7, 5e-7]]),
        "own_uncertainty": np.array([[1e-8, 2e-8, 3e-8, 4e-8, 5e-8]]),
        "amplitudes": np.array([1e-6, 1e-6, 1e-15]),
        "points": 20_000,
    }
    return SelfCalibration(**(stated | other))  # type: ignore[arg-type]


def calibration(
    numerator: list[float],
    denominator: list[float],
    delay: float = 0.0,
    covariance: FloatArray | None = None,
    certificate: Mapping[str, object] | None = None,
) -> Calibration:
    p = len(numerator) + len(denominator)
    return Calibration(
        dynamics=TransferFunction(np.array(numerator), np.array(denominator), delay),
        static_gain=0.98,
        sample_period=PERIOD,
        valid_up_to=50.0,
        covariance=np.zeros((p, p)) if covariance is None else covariance,
        certificate=certified_by(certificate or {"verdict": "accepted"}),
    )


def slow_series(g: TransferFunction) -> tuple[float, float]:
    """Return L and κ of G = 1 - L s + κ s², from its values on a small circle about s = 0."""
    circle = 20.0 * np.exp(2j * np.pi * np.arange(16) / 16)
    series = np.fft.fft(g.at(circle)) / 16 / 20.0 ** np.arange(16)
    return float(-series[1].real), float(series[2].real)


def of_scans(values: FloatArray = VALUES, **other: object) -> Calibration:
    return from_scans_alone(found_by(values, **other), PERIOD, 0.98, {"probe.rate": 1000})


@pytest.mark.parametrize("latency", [0.0, 1.2e-4, 3.1e-4, -2e-5])
def test_the_model_of_scans_alone_has_the_lag_and_curvature_found(latency: float) -> None:
    made = of_scans(np.array([3.1e-4, 2e-7, 0.0, latency]))
    assert slow_series(made.dynamics) == pytest.approx((3.1e-4, 2e-7), rel=1e-6, abs=0)
    assert made.dynamics.dc_gain == 1.0
    # A probe that would be early is taken as prompt.
    assert made.dynamics.delay == max(latency, 0.0)
    assert made.dynamics.is_stable
    assert made.settings == {"probe.rate": 1000}
    assert (made.static_gain, made.sample_period) == (0.98, PERIOD)


def test_its_poles_are_fast_for_any_sampling() -> None:
    for period in (1e-4, 1e-3, 5e-3):
        made = from_scans_alone(found_by(), period, 1.0, {})
        slowest = np.min(np.abs(made.dynamics.poles()))
        assert np.pi / (20 * period) < slowest < np.pi / period
        assert np.all(made.dynamics.poles().imag == 0)


def test_its_covariance_follows_by_differences() -> None:
    def parameters(values: FloatArray) -> FloatArray:
        g = of_scans(values).dynamics
        return np.concatenate([g.numerator, g.denominator[1:], [g.delay]])

    columns = []
    for k in range(4):
        step = np.zeros(4)
        step[k] = 1e-3 * UNITS[k]
        columns.append((parameters(VALUES + step) - parameters(VALUES - step)) / (2 * step[k]))
    jacobian = np.stack(columns, axis=1)
    expected = jacobian @ COVARIANCE @ jacobian.T
    scale = np.sqrt(np.maximum(np.diag(expected), 1e-300))
    got = of_scans().covariance
    assert np.allclose(got / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-4)


def test_the_lag_of_scans_alone_is_as_uncertain_as_found() -> None:
    made = of_scans()
    lag = np.sqrt(COVARIANCE[LAG, LAG])
    assert made.low_frequency_delay_uncertainty == pytest.approx(lag, rel=1e-6)
    assert made.certificate.response.low_frequency_delay_uncertainty_s == pytest.approx(lag)
    assert made.certificate.response.low_frequency_delay_s == pytest.approx(3.1e-4)
    gain = np.sqrt(COVARIANCE[GAIN, GAIN]) * 0.98
    assert made.certificate.static_gain.uncertainty == pytest.approx(gain)


def test_scans_alone_pass_the_door_for_calibrations() -> None:
    made = of_scans()
    again = Calibration.from_content(made.content())
    assert again.id == made.id


def test_faster_scans_reach_as_much_further() -> None:
    slow = of_scans().valid_up_to
    fast = of_scans(speeds=(2 * np.pi, -4 * np.pi)).valid_up_to
    assert fast == pytest.approx(2 * slow)
    # Two harmonics of the surface are a micrometre, the third a femtometre.
    assert slow == pytest.approx(2.0)


def test_the_reach_ends_at_one_turn_and_at_half_the_sample_rate() -> None:
    assert of_scans(amplitudes=np.full(3, 1e-15)).valid_up_to == pytest.approx(1.0)
    assert of_scans(speeds=(np.pi, 2000 * np.pi)).valid_up_to == 500.0


def test_the_unit_calibration_corrects_nothing() -> None:
    unit = unit_calibration(2e-3, 0.97)
    assert np.array_equal(unit.dynamics.response(np.array([0.0, 7.0, 200.0])), np.ones(3))
    assert (unit.static_gain, unit.valid_up_to) == (0.97, 250.0)
    assert unit.low_frequency_delay_uncertainty == 0.0
    assert Calibration.from_content(unit.content()).id == unit.id


def test_without_a_step_test_next_to_nothing_is_known() -> None:
    broad, reported = without_step_test().covariance, without_step_test(2e-4).covariance
    assert reported[GAIN, GAIN] == pytest.approx(4e-8, abs=0)
    others = [LAG, CURVATURE, LATENCY]
    assert np.array_equal(broad[np.ix_(others, others)], reported[np.ix_(others, others)])
    assert np.count_nonzero(broad - np.diag(np.diag(broad))) == 0
    # Longer than the lag of any structure: the paper's is 0.34 ms.
    assert broad[LAG, LAG] ** 0.5 > 1e-3 < broad[LATENCY, LATENCY] ** 0.5


def test_after_a_step_test_lag_and_gain_are_known_as_it_says() -> None:
    covariance = np.diag([0.0, 4e-12, 9e-12])
    reported = {"static_gain_uncertainty": 4.9e-5}
    prior = after_step_test(calibration([1.0], [1.0, 3e-4], 1e-4, covariance, reported)).covariance
    assert prior[LAG, LAG] == pytest.approx(13e-12, abs=0)
    # ln(1/(1 + d s)) = -d s + d² s²/2 - …: the curvature moves by d for a unit of d.
    assert prior[CURVATURE, CURVATURE] == pytest.approx((3e-4) ** 2 * 4e-12, abs=0)
    assert prior[LAG, CURVATURE] == pytest.approx(3e-4 * 4e-12, abs=0)
    # Stated of the gain itself, and asked for as a share of it.
    assert prior[GAIN, GAIN] == pytest.approx((4.9e-5 / 0.98) ** 2, abs=0)
    assert prior[LATENCY, LATENCY] == without_step_test().covariance[LATENCY, LATENCY]
    silent = after_step_test(calibration([1.0], [1.0, 3e-4], 1e-4, covariance))
    assert silent.covariance[GAIN, GAIN] == 0.0
    assert not np.any(prior[LATENCY, :LATENCY])


G2 = ([1.0, -1e-4, 2e-8], [1.0, 3e-4, 6e-8], 1e-4)
SPREAD = np.array([0.0, 2e-6, 1e-9, 3e-6, 2e-9, 4e-6])
TURN = np.random.default_rng(3).normal(size=(6, 6))
SIGMA = SPREAD[:, np.newaxis] * (TURN @ TURN.T) * SPREAD


def slow_part(dynamics: TransferFunction, covariance: FloatArray) -> FloatArray:
    jacobian = slow_motion_jacobian(dynamics)
    return np.asarray(jacobian @ covariance @ jacobian.T)


def reported(left: FloatArray, values: tuple[float, float] = (0.0, 0.0)) -> SelfCalibration:
    covariance = np.zeros((4, 4))
    covariance[:GAIN, :GAIN] = left
    covariance[LATENCY, LATENCY] = 1e-12
    return found_by(np.array([*values, 0.0, 1e-4]), covariance=covariance)


def test_scans_that_say_nothing_new_leave_the_covariance() -> None:
    before = calibration(*G2, covariance=SIGMA)
    after = resolved(before, reported(slow_part(before.dynamics, SIGMA)))
    assert np.allclose(after.covariance, SIGMA, rtol=1e-9, atol=1e-9 * np.max(SIGMA))
    assert after.dynamics.response(np.array([3.0]))[0] == pytest.approx(
        before.dynamics.response(np.array([3.0]))[0], rel=1e-12
    )


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5])
def test_slow_motion_is_known_afterwards_as_the_scans_say(share: float) -> None:
    before = calibration(*G2, covariance=SIGMA)
    prior = slow_part(before.dynamics, SIGMA)
    after = resolved(before, reported(share * prior))
    left = slow_part(after.dynamics, after.covariance)
    assert np.allclose(left, share * prior, rtol=1e-6, atol=1e-9 * np.max(np.abs(prior)))
    # Nothing is known worse than before, and no combination better than possible.
    scale = np.where(SPREAD > 0, SPREAD, 1.0)
    for matrix in (SIGMA - after.covariance, after.covariance):
        least = np.linalg.eigvalsh(matrix / np.outer(scale, scale))[0]
        assert least > -1e-9
    assert np.array_equal(after.covariance, after.covariance.T)


def test_the_lag_found_is_added_to_that_of_the_step_test() -> None:
    before = calibration(*G2, covariance=SIGMA)
    after = resolved(before, reported(1e-3 * slow_part(before.dynamics, SIGMA), (2e-6, 3e-10)))
    lag, curvature = slow_series(before.dynamics)
    # (1 - L s + κ s²)(1 - δ s + k s²)
    expected = lag + 2e-6, curvature + 2e-6 * lag + 3e-10
    assert slow_series(after.dynamics) == pytest.approx(expected, rel=1e-6, abs=0)
    assert np.array_equal(after.dynamics.poles(), before.dynamics.poles())
    assert after.certificate.response.low_frequency_delay_s == pytest.approx(lag + 2e-6)
    assert after.static_gain == before.static_gain


def test_a_numerator_that_is_none_grows_to_hold_the_lag() -> None:
    before = calibration([1.0], [1.0, 3e-4], 1e-4, np.diag([0.0, 4e-12, 9e-12]))
    after = resolved(before, reported(np.diag([1e-14, 1e-22]), (5e-6, 0.0)))
    assert len(after.dynamics.numerator) == 2
    assert after.covariance.shape == (4, 4)
    assert after.dynamics.low_frequency_delay == pytest.approx(4.05e-4)
    assert after.dynamics.delay == 1e-4
    # The coefficient that is new brings no doubt of its own.
    assert not np.any(after.covariance[1])


@pytest.mark.parametrize(("found", "left"), [(5e-6, 1.05e-4), (-2e-5, 8e-5), (-3e-4, 0.0)])
def test_a_pure_delay_takes_the_lag_and_ends_at_none(found: float, left: float) -> None:
    before = calibration([1.0], [1.0], 1e-4, np.diag([0.0, 9e-12]))
    after = resolved(before, reported(np.diag([1e-14, 0.0]), (found, 0.0)))
    assert after.dynamics.delay == pytest.approx(left)
    assert len(after.dynamics.numerator) == 1


def test_a_curvature_that_has_no_room_counts_as_doubt() -> None:
    """A numerator of the first degree stays one: what it cannot hold widens what is stated."""
    before = calibration([1.0, -1e-4], [1.0, 3e-4, 6e-8], 1e-4, np.diag([0, 4e-12, 4e-12, 0, 0]))
    quiet, curved = (
        resolved(before, reported(np.diag([1e-14, 1e-22]), (0.0, k))) for k in (0.0, 4e-10)
    )
    without, withal = (slow_part(c.dynamics, c.covariance)[1, 1] for c in (quiet, curved))
    assert withal - without == pytest.approx((4e-10) ** 2, rel=1e-6, abs=0)


def test_latency_is_stated_with_its_speeds_and_its_share() -> None:
    before = calibration(*G2, covariance=SIGMA)
    latency = resolved(before, found_by(np.array([0.0, 0.0, 0.0, 1.5e-4]))).latency
    assert latency.source == SPEEDS
    assert latency.delay_s == 1.5e-4
    assert latency.uncertainty_s == pytest.approx(np.sqrt(COVARIANCE[LATENCY, LATENCY]))
    assert latency.share == pytest.approx(1.5e-4 / before.dynamics.low_frequency_delay)
    assert "2 scans of one part at 30, 60 rpm" in latency.reason
    # The part in common with the lag of Z must not count twice.
    two = [LAG, LATENCY]
    apart = [1, -1] @ COVARIANCE[np.ix_(two, two)] @ [1, -1] - COVARIANCE[LAG, LAG]
    assert latency.unshared_s == pytest.approx(np.sqrt(max(apart, 0.0)))


@pytest.mark.parametrize(
    ("speeds", "source"),
    [
        ((3.0, -3.0), REVERSAL),
        ((3.0, -3.002), REVERSAL),
        ((3.0, 6.0), SPEEDS),
        ((3.0, -3.0, 6.0), SPEEDS),
    ],
)
def test_equal_speeds_are_a_reversal(speeds: tuple[float, ...], source: str) -> None:
    assert of_scans(speeds=speeds).latency.source == source


def test_what_the_scans_do_not_tell_is_said() -> None:
    (everything,) = undetermined(found_by())
    assert "only a reference determines it" in str(everything)
    known = np.array([True, False, True, False])
    words = undetermined(found_by(known=known))
    assert [str(text).split(":")[0] for text in words[:2]] == ["latency", "curvature of the gain"]
    assert words[2:] == [everything]
    made = of_scans(known=known)
    latency = made.latency
    assert (latency.delay_s, latency.uncertainty_s, latency.share) == (0.0, None, None)
    assert made.certificate.warnings[0].code == "adjustment.latency_scope"
    assert of_scans().certificate.warnings == ()


def test_what_was_fitted_besides_is_in_the_certificate() -> None:
    entry = of_scans().certificate.self_calibration
    assert isinstance(entry, dict)
    (between,) = entry["between_scans"]
    assert between["clocking"] == {"value": 1e-7, "uncertainty": 1e-8}
    assert between["tilt_y"] == {"value": 5e-7, "uncertainty": 5e-8}
    assert entry["speeds_rad_s"] == pytest.approx([np.pi, 2 * np.pi])
    assert entry["points"] == 20_000
    assert entry["agreement"]["noise"] == 10e-9


BAD_AGREEMENT = ScanConsistency(ratio=9.0, disagreement=31e-9, noise=10e-9)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"agreement": BAD_AGREEMENT}, "contradict each other by 31.0 nm rms, 9.0 times"),
        ({"prior_conflict": 40.0}, "scans and step test contradict each other"),
        ({"values": np.array([0.0, 0.0, 0.0, -1e-4])}, "100 µs early"),
    ],
)
def test_contradictions_reject_with_their_reason(wrong: dict[str, object], said: str) -> None:
    stated: dict[str, object] = {"verdict": "accepted", "reasons": ["an old one"]}
    before = calibration(*G2, covariance=SIGMA, certificate=certified_by(stated))
    after = resolved(before, replace(found_by(), **wrong))  # type: ignore[arg-type]
    assert after.certificate.verdict == "rejected"
    old, new = map(str, after.certificate.reasons)
    assert old == "an old one"
    assert said in new
    assert before.certificate.verdict == "accepted"


def test_all_contradictions_are_reported_at_once() -> None:
    before = calibration(*G2, covariance=SIGMA)
    early = np.array([0.0, 0.0, 0.0, -1e-4])
    after = resolved(before, found_by(early, agreement=BAD_AGREEMENT, prior_conflict=40.0))
    assert len(after.certificate.reasons) == 3  # type: ignore[arg-type]


def test_a_latency_below_zero_within_its_uncertainty_is_none() -> None:
    slightly = -2 * float(np.sqrt(COVARIANCE[LATENCY, LATENCY]))
    before = calibration(*G2, covariance=SIGMA)
    after = resolved(before, found_by(np.array([0.0, 0.0, 0.0, slightly])))
    assert after.certificate.verdict == "accepted"
    assert after.latency.delay_s == 0.0
