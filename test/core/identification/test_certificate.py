"""Evidence and findings become one certificate, and any reason rejects."""

import json
from dataclasses import replace

import pytest

from omsm_ros.core.calibration.certificate import (
    ACCEPTED,
    NOTE,
    REJECTED,
    REJECTS,
    RESERVATION,
    RESERVED,
    WARNING,
    Certificate,
    Finding,
    Origin,
)
from omsm_ros.core.calibration.intended_use import PAPER_USE
from omsm_ros.core.estimation.preparation import prepare
from omsm_ros.core.identification.identify import certificate_of
from omsm_ros.core.identification.model_choice import choose_model
from omsm_ros.core.identification.model_error_search import SearchResult
from omsm_ros.core.identification.response_uncertainty import (
    IdentificationEvidence,
    response_uncertainty,
)
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


ORIGIN = Origin(operator="A. Meyer")


def finding(severity):
    return Finding("calibration.text", severity, {"text": severity})


@pytest.mark.parametrize(
    ("severities", "verdict"),
    [
        ((), ACCEPTED),
        ((NOTE, WARNING), ACCEPTED),
        ((WARNING, RESERVATION), RESERVED),
        ((RESERVATION, REJECTS, WARNING), REJECTED),
    ],
)
def test_the_gravest_finding_decides(evidence, severities, verdict):
    findings = [finding(severity) for severity in severities]
    certificate = certificate_of(evidence, findings, ORIGIN, None)
    assert certificate.verdict == verdict
    assert list(certificate.findings) == findings


def test_it_says_who_measured_and_what_it_was_compared_with(evidence):
    certificate = certificate_of(evidence, [], ORIGIN, None)
    assert certificate.origin.operator == "A. Meyer"
    assert certificate.limits["valid_up_to_least_hz"] == 5.0
    assert certificate.validity.use == PAPER_USE


def test_it_comes_back_from_json_as_it_was(evidence):
    certificate = certificate_of(evidence, [finding(REJECTS)], ORIGIN, None)
    text = json.dumps(certificate.content(), allow_nan=False)
    assert Certificate.from_content(json.loads(text)) == certificate


def test_the_samples_are_accounted_for(evidence):
    counts = certificate_of(evidence, [], ORIGIN, None).residual.samples
    assert counts["compared"] == evidence.fit.samples


def test_the_uncertainty_of_the_delay_grows_with_the_covariance(evidence):
    def stated(known):
        made = certificate_of(replace(evidence, known=known), [], ORIGIN, None)
        return made.response.low_frequency_delay_uncertainty_s

    wider = replace(evidence.known, covariance=9 * evidence.known.covariance)
    assert stated(wider) == pytest.approx(3 * stated(evidence.known))
