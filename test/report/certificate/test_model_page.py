"""The page of a model states the model and its simulation of the record."""

from dataclasses import replace

import numpy as np
import pytest
from sections_of_polynomials import from_polynomials

from omsm_ros.core.estimation.sampled_model import SampledModel, free_run
from omsm_ros.report.certificate.figures import model_figures_of, response
from omsm_ros.report.certificate.page import render_model, verdict_on_model
from omsm_ros.report.page_parts import Issue

HELD = SampledModel(
    sections=replace(
        from_polynomials("zero-order", 0.1, np.array([0.0, 0.4]), np.array([1.0, -0.6]), 0.1),
        covariance=np.diag([4e-6, 1e-6, 0.0, 1e-8, 0.0, 0.0]),
    ),
    valid=[(0.01, 4.0)],
    working_point=(4.0, 30.0),
    certificate={
        "verdict": "accepted from 0.01 Hz to 4 Hz",
        "order": 1,
        "predicted": 0.91,
        "warnings": [],
        "reasons": [],
        "limits": {"gain": 0.1},
        "samples": {"received": 400, "compared": 390},
    },
)
SMOOTH = replace(HELD, sections=replace(HELD.sections, hold="band-limited"))


@pytest.fixture(scope="module")
def record():
    rng = np.random.default_rng(1)
    return 4.0 + rng.normal(size=400), 30.0 + rng.normal(size=400)


def page_of(model, record, **parts):
    run = free_run(model, *record)
    figures = model_figures_of(model, *record, run)
    return model, run, Issue(date="today", figures=figures, **parts)


@pytest.mark.parametrize("model", [HELD, SMOOTH])
def test_all_parts_are_there(model, record):
    page = render_model(*page_of(model, record, source="<b>.csv", version="1.2"))
    for text in ("Accepted from", "91.00", "Poles", "Working point".lower(), "&lt;b&gt;.csv"):
        assert text in page, text
    assert "<b>.csv" not in page
    assert page.count("<figure>") == 3
    assert f"input: {model.sections.hold}" in page


def test_a_pole_that_the_data_do_not_resolve_has_a_bound(record):
    poles = [{"frequency_hz": 2.5, "damping": 0.07}, {"faster_than_hz": 4.0}]
    made = replace(HELD, certificate=HELD.certificate | {"poles": poles})
    page = render_model(*page_of(made, record))
    row = page[page.index(">2.50") :]
    assert row.index("0.0700") < row.index("not resolved (faster")


def test_the_verdict_is_the_models():
    assert verdict_on_model(HELD).level == "good"
    warned = replace(HELD, certificate=HELD.certificate | {"warnings": ["w"]})
    assert verdict_on_model(warned).level == "care"
    rejected = replace(HELD, certificate={"verdict": "rejected", "reasons": ["too short"]})
    assert verdict_on_model(rejected).reasons == ("too short",)
    assert verdict_on_model(replace(HELD, certificate={})).level == "unknown"


def test_the_curve_is_the_models_response_and_the_rest_of_the_axis_is_grey():
    made = response(HELD)
    gain, phase = made.get_axes()
    line = next(line for line in gain.get_lines() if len(line.get_xdata()) > 2)
    frequency = np.asarray(line.get_xdata())
    value = HELD.sections.response(frequency)[0]
    assert line.get_ydata() == pytest.approx(np.abs(value))
    # A first-order lag of one sample behind a hold: at 1 Hz its phase is that of H(z) itself.
    q = np.exp(-2j * np.pi * 0.1)
    expected = np.degrees(np.angle(0.4 * q**2 / (1 - 0.6 * q)))
    assert np.interp(1.0, frequency, phase.get_lines()[0].get_ydata()) == pytest.approx(
        expected, abs=0.1
    )
    greys = [patch.get_extents() for patch in phase.patches]
    assert len(greys) == 2
