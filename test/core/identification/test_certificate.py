"""Findings become one certificate, and any reason rejects."""

from dataclasses import replace

import pytest

from omsm_ros.core.calibration.finding import Finding
from omsm_ros.core.estimation.preparation import prepare
from omsm_ros.core.identification.evidence import IdentificationEvidence
from omsm_ros.core.identification.identify import certificate_of, verdict
from omsm_ros.core.identification.model_choice import choose_model
from omsm_ros.core.identification.model_error_search import SearchResult
from omsm_ros.core.identification.response_uncertainty import response_uncertainty
from omsm_ros.core.lti.frequency_response import ResponseLimits
from omsm_ros.core.model_errors.residual_diagnostics import ResidualDiagnostics
from omsm_ros.core.streams.motion_record import assemble


@pytest.fixture(scope="module")
def evidence(step_test):
    record, limits = assemble([step_test.axes], [step_test.distance]), ResponseLimits()
    prepared = prepare(record, "encoder")
    model = choose_model(prepared, order=1)
    diagnostics = ResidualDiagnostics(prepared.problem, model.chosen.fit, prepared.steps)
    known = response_uncertainty(prepared, model, limits)
    return IdentificationEvidence(
        record, prepared, model, known, limits, SearchResult(prepared, model, diagnostics)
    )


def test_the_verdict_says_what_the_data_support():
    assert verdict([], [], 0.015, 80.0) == "accepted, supported by data from 0.015 Hz to 80.0 Hz"
    kept = verdict([], ["creep"], 0.015, 80.0)
    assert kept == "accepted with reservations, supported by data from 0.015 Hz to 80.0 Hz"
    assert verdict(["sharp edges"], ["creep"], 0.015, 80.0) == "rejected"


def test_what_every_check_found_stands_in_it(evidence):
    findings = [
        Finding({"chi_square": 1.0}, {"chi_square_greatest": 1.3}, warnings=("a warning",)),
        Finding({"creep_ppm": 12.0}, {"creep_ppm_greatest": 100.0}, ("first", "second")),
    ]
    certificate = certificate_of(evidence, findings, None)
    assert certificate["chi_square"] == 1.0
    assert certificate["creep_ppm"] == 12.0
    assert certificate["limits"] == {"chi_square_greatest": 1.3, "creep_ppm_greatest": 100.0}
    assert certificate["warnings"] == ["a warning"]
    assert certificate["reasons"] == ["first", "second"]
    assert certificate["verdict"] == "rejected"


def test_without_a_reason_it_is_accepted(evidence):
    accepted = certificate_of(evidence, [Finding(warnings=("a warning",))], None)
    assert accepted["verdict"].startswith("accepted")


def test_a_finding_may_say_more_than_the_description(evidence):
    """What a check found last is what is written: a check knows better than the plain value."""
    changed = certificate_of(evidence, [Finding({"backlash_m": 1e-9})], None)
    assert changed["backlash_m"] == 1e-9


def test_the_samples_are_accounted_for(evidence):
    counts = certificate_of(evidence, [], None)["samples"]
    assert counts["compared"] == evidence.fit.samples


def test_the_uncertainty_of_the_delay_grows_with_the_covariance(evidence):
    def stated(known):
        entries = certificate_of(replace(evidence, known=known), [], None)
        return entries["low_frequency_delay_uncertainty_s"]

    wider = replace(evidence.known, covariance=9 * evidence.known.covariance)
    assert stated(wider) == pytest.approx(3 * stated(evidence.known))
