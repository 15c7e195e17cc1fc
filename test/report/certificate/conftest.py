"""One identification of the twin, drawn once."""

from __future__ import annotations

import pytest
from parsed_page import Page

from omsm_ros.core.identification.fitted_record import fitted_record
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.streams.motion_record import assemble
from omsm_ros.report.certificate.figures import certificate_figures_of
from omsm_ros.report.certificate.page import render
from omsm_ros.report.page_parts import Issue


@pytest.fixture(scope="session")
def record(step_test):
    return assemble([step_test.axes], [step_test.distance])


@pytest.fixture(scope="session")
def identified(record):
    return identify(record, order=2, settings={"fixture": "plate <3>"})


@pytest.fixture(scope="session")
def calibration(identified):
    return identified.calibration


@pytest.fixture(scope="session")
def fitted(identified):
    return fitted_record(identified)


@pytest.fixture(scope="session")
def figures(calibration, fitted):
    return certificate_figures_of(calibration, fitted)


@pytest.fixture(scope="session")
def certificate(calibration, figures):
    return calibration, Issue(
        date="2025-01-31 12:00 UTC", source="steps.mcap", version="0.1.0", figures=figures
    )


@pytest.fixture(scope="session")
def page(certificate):
    return Page(render(*certificate))
