"""The verdict states every reason and is never better than the worst one."""

from __future__ import annotations

from dataclasses import replace

import pytest
from certified import certified_by

from omsm_ros.core.calibration.certificate import Certificate
from omsm_ros.report.verdict import verdict_on_measurement


def test_an_accepted_calibration_and_a_full_account_are_trusted(summary, certified):
    verdict = verdict_on_measurement(summary, certified)
    assert verdict.level == "good"
    assert "calibration accepted, valid up to 100 Hz" in verdict.reasons


def test_a_rejected_calibration_is_not_trusted_and_says_why(summary, certified):
    rejected = {"verdict": "rejected", "reasons": ["residual is not white"]}
    verdict = verdict_on_measurement(
        summary, replace(certified, certificate=certified_by(rejected))
    )
    assert verdict.level == "bad"
    assert "residual is not white" in verdict.reasons


@pytest.mark.parametrize("stream", ["axes", "distance"])
@pytest.mark.parametrize("change", [-3, 3])
def test_a_lost_or_invented_sample_is_not_trusted(summary, certified, stream, change):
    summary["samples"][stream]["received"] += change
    verdict = verdict_on_measurement(summary, certified)
    assert verdict.level == "bad"
    assert verdict.reasons == (f"{stream}: 3 samples unaccounted for",)


def test_what_waits_is_accounted_for(summary, certified):
    summary["samples"]["axes"] |= {"received": 40_045, "pending": 5}
    assert verdict_on_measurement(summary, certified).level == "good"


def test_warnings_of_the_measurement_are_reservations(summary, certified):
    summary["warnings"] = ["motion beyond 100 Hz"]
    verdict = verdict_on_measurement(summary, certified)
    assert verdict.level == "care"
    assert verdict.reasons == ("motion beyond 100 Hz",)


def test_many_missing_points_are_a_reservation(summary, certified):
    lost = {"received": 100, "corrected": 90, "pending": 0, "counted": {"invalid": 10}}
    summary["samples"]["distance"] = lost
    verdict = verdict_on_measurement(summary, certified)
    assert verdict.level == "care"
    assert verdict.reasons == ("distance: 10 samples (10 %) gave no point",)


def test_warnings_of_an_accepted_calibration_do_not_count(summary, certified):
    warned = certified_by(
        {"warnings": ["a pole stands for all that is faster"]}, certified.certificate
    )
    assert verdict_on_measurement(summary, replace(certified, certificate=warned)).level == "good"


def test_without_a_certificate_nothing_is_judged(summary, certified):
    assert (
        verdict_on_measurement(summary, replace(certified, certificate=Certificate())).level
        == "unknown"
    )
    verdict = verdict_on_measurement(summary, None)
    assert verdict.level == "unknown"
    assert "no calibration is given" in verdict.reasons


def test_the_worst_decides(summary, certified):
    summary["warnings"] = ["late"]
    summary["samples"]["axes"]["received"] += 1
    assert (
        verdict_on_measurement(summary, replace(certified, certificate=Certificate())).level
        == "bad"
    )


def test_nothing_at_all_is_not_judged():
    assert verdict_on_measurement({}, None).level == "unknown"


def test_a_lag_that_nothing_divides_is_a_reservation_with_its_remedy(summary, certified):
    unresolved = {"verdict": "accepted"}
    verdict = verdict_on_measurement(
        summary, replace(certified, certificate=certified_by(unresolved))
    )
    assert verdict.level == "care"
    (reason,) = verdict.reasons
    assert "339.7 µs" in reason
    assert "omsm selfcal" in reason
    assert "omsm reversal" in reason
