"""Every page: its tags nest, it fetches nothing, and no name or comment becomes part of it."""

from __future__ import annotations

import json
import re
from base64 import b64decode, b64encode
from dataclasses import replace
from hashlib import sha256

import numpy as np
import pytest
from certified import certified_by
from page_tables import PageTables
from parsed_page import Page
from sections_of_polynomials import from_polynomials

from omsm_ros.core.estimation.sampled_model import SampledModel, free_run
from omsm_ros.core.ripple.source_hypotheses import KINDS
from omsm_ros.live_page.server import render as render_live
from omsm_ros.report.campaign import CampaignEntry
from omsm_ros.report.campaign import render as render_campaign
from omsm_ros.report.certificate.page import render as render_certificate
from omsm_ros.report.certificate.page import render_model
from omsm_ros.report.experiments import Compared, done
from omsm_ros.report.measurement.page import CAPTIONS, Report
from omsm_ros.report.measurement.page import render as render_report
from omsm_ros.report.measurement.surface_map import Layer, embedded
from omsm_ros.report.page_parts import Issue, Section, fill_study
from omsm_ros.report.spectrum import render as render_spectrum
from omsm_ros.report.tables import Table
from omsm_ros.report.verdict import PageVerdict

# One for each place that text can stand in: an element, an attribute, a script, a comment, a
# template. No digit with a minus before it, and none with a unit behind: those are typeset.
ATTACKS = (
    "<script>alert(x)</script>", "\"><img src=x onerror=alert(y)>", "' onload='alert(z)",
    "--><!--", "{{ self.__init__ }}{% raw %}", "&lt;b&gt; &amp; &#60;", "</title></style></td>",
    "javascript:alert(w)", "µ≤ ü 面 \u202etxt",
)  # fmt: skip
ATTACK = " ".join(ATTACKS)
MODEL = SampledModel(
    sections=from_polynomials(
        "zero-order", 0.1, np.array([0.0, 0.4]), np.array([1.0, -0.6]), 0.1
    ),
    valid=[(0.01, 4.0)], working_point=(4.0, 30.0), certificate={"verdict": "accepted"},
)  # fmt: skip
PNG = b"\x89PNG\r\n\x1a\n"


def report(text, calibration):
    x = np.linspace(-1e-3, 1e-3, 30)
    layer = Layer(text, *(v.ravel() for v in np.meshgrid(x, x)), np.arange(900) * 1e-9, "nm")
    summary = {
        "bag": text, "calibration": text, "files": {text: text}, "warnings": [text],
        "settings": {text: text, "list": [text, {text: 1.5}]}, "versions": {text: text},
        "samples": {text: {"received": 7, "corrected": 4, "counted": {text: 3}}},
        "verdict": {"code": "contradicted", "text": text,
                    "reasons": [{"code": "recording", "text": text}],
                    "add": {"text": text, "reached": 1e-9}},
        "admission": {"overridden": True},
        "budget": {"sources": [{
            "source": text, "says": text, "kind": text, "status": text, "unit": "m",
            "reason": text, "standard_uncertainty": 1e-9, "height": 1e-9}]},
        "prediction": {"binding": text, "not_evaluated": [text], "limits": [
            {"name": text, "unit": "m", "value": 1.0, "allowed": 2.0, "speed_factor": 2.0}]},
    }  # fmt: skip
    form = {
        "deviation": {text: {"value": 1e-9, "uncertainty": 1e-10}},
        "removed": {"fitted": [text], "notes": [text], "held": {text: text},
                    "not_determined": {text: text}},
        "pose": {text: {"value": 1.0, "uncertainty": 0.1}},
    }  # fmt: skip
    return render_report(
        Report(text, text, summary, calibration, dict.fromkeys(CAPTIONS, PNG), form, {},
               embedded([layer]))
    )  # fmt: skip


def spectrum(text, _):
    reported = {
        "kind": text, "frequency": 1.0, "wavelength_along_path": 1.0, "amplitude": 1.0,
        "amplitude_on_part": 1.0,
        "wavelength_along_radius": None, "significance": 4.0, "true_frequency": None,
        "true_wavelength": None, "order": text, "evidence": [text], "needs": text,
    }  # fmt: skip
    line = {"axis": text, "frequency": 1.0, "acceleration": 1.0, "displacement": 1.0,
            "significance": 4.0}  # fmt: skip
    scan = {
        "name": text, "duration": 1.0, "spindle_speed_rpm": 1.0, "path_length": 1.0,
        "samples": {"analysed": 1}, "form": {"rms_removed": 1.0}, "sampling": [],
        "noise": {"rms": 1.0, "amplitude": 1.0}, "motion": {"outside_band_rms": None},
        "accelerometer": {"lines": [line]}, "peaks": [reported], "band_stop": None,
        "vibration_removed": [],
    }  # fmt: skip
    counts = dict.fromkeys(KINDS, 1)
    return render_spectrum(
        {"scans": [scan], "counts": counts, "normalisation": text, "exposure": None}, {"time": PNG}
    )


def study(text, _):
    table = Table(text, (text,), [(text, text)], prose=text)
    sections = (Section(text, ("a",), (table,), text),)
    verdict = PageVerdict("good", text, (text,))
    return fill_study(text, text, verdict, sections, {"a": text}, {"a": PNG}, footer=text)


def experiment(text, _):
    rows = [Compared(text, text, text, text, text)]
    return done(text, text, rows, {}, {}, (Table(text, (), [(text, text)]),)).page


def campaign(text, calibration):
    def one(k, state):
        summary = {"warnings": [text]} if state == "done" else {}
        return CampaignEntry(f"{text}{'abcdef'[k]}", state, text, None, text, summary)

    return render_campaign(
        text, [one(0, "done"), one(1, "refused"), one(2, "crashed")], calibration
    )


def certificate(text, calibration):
    entries = {
        "verdict": "rejected", "reasons": [text], "warnings": [text], "reservations": [text],
        "input": text, text: text, "samples": {text: 4}, "assumed": [text],
        "departures": [{"family": text, "size_m": 1e-9, "modelled": text}],
        "consistency": [{"parts": text}],
    }  # fmt: skip
    hostile = replace(calibration, settings={text: text}, certificate=certified_by(entries))
    return render_certificate(hostile, Issue(date=text, source=text, version=text))


def model(text, _):
    rng = np.random.default_rng(0)
    entries = {"verdict": text, "warnings": [text], "limits": {text: 1.0}, "order": text}
    hostile = replace(MODEL, certificate=entries)
    run = free_run(hostile, rng.normal(size=60), rng.normal(size=60))
    return render_model(hostile, run, Issue(date=text, source=text, version=text))


def live(text, _):
    return render_live(text)


PAGES = (report, spectrum, study, experiment, campaign, certificate, model, live)


@pytest.fixture(scope="module")
def clean(true_calibration):
    """Return each page with harmless words as long as the attack, as long cells are wider."""
    words = ("word " * 99)[: len(ATTACK) - 1] + "s"
    return {kind: kind(words, true_calibration) for kind in PAGES}


@pytest.mark.parametrize("kind", PAGES)
def test_text_from_outside_changes_no_tag_and_no_attribute(kind, clean, true_calibration):
    """The page of an attack has the same tags as the harmless page, and the attack as text."""
    hostile = Page(kind(ATTACK, true_calibration))
    harmless = Page(clean[kind])
    assert hostile.tags == harmless.tags
    assert [key for key, _ in hostile.attributes] == [key for key, _ in harmless.attributes]
    for part in ATTACKS:
        assert " ".join(part.split()) in hostile.text, part


@pytest.mark.parametrize("kind", PAGES)
def test_a_page_is_one_file(kind, clean):
    """Nothing is fetched, no element has an action, and the policy allows only its own script."""
    page = Page(clean[kind])
    for key, value in page.attributes:
        assert not key.startswith("on"), key
        if key in ("src", "href") and kind is not campaign:
            assert value.startswith("data:image/png;base64,")
            assert b64decode(value.partition(",")[2]) == PNG
    assert not {"iframe", "object", "embed", "form", "link", "base"} & set(page.tags)
    (policy,) = (v for k, v in page.attributes if k == "content" and v.startswith("default-src"))
    assert policy.startswith("default-src 'none'")
    html = clean[kind]
    assert html.startswith("<!DOCTYPE html>\n<html lang")
    assert html.count("<title>") == html.count("</html>") == 1
    assert "utf-8" in [v for k, v in page.attributes if k == "charset"]
    assert not re.search(r"@import|url\(", html)


@pytest.mark.parametrize("kind", PAGES)
def test_every_script_is_one_that_the_policy_names(kind, clean):
    """The script is allowed by its hash; data are no script."""
    html = clean[kind]
    (policy,) = re.findall(r'content="(default-src[^"]*)"', html)
    allowed = set(re.findall(r"'sha256-([^']+)'", policy.replace("&#39;", "'")))
    run = {
        b64encode(sha256(text.encode()).digest()).decode()
        for text in re.findall(r"<script>(.*?)</script>", html, re.DOTALL)
    }
    assert run == allowed
    assert bool(run) is (kind in (report, live))


@pytest.mark.parametrize("kind", [p for p in PAGES if p is not live])
def test_every_row_of_a_table_has_the_cells_of_its_head(kind, clean):
    page = PageTables(clean[kind])
    assert page.tables
    for table in page.tables:
        lengths = {len(row) for row in table["rows"]}
        assert len(lengths) == 1, table["title"]
        if table["columns"]:
            assert lengths == {len(table["columns"])}, table["title"]


def test_a_map_in_a_page_is_json_whatever_its_layer_is_called(true_calibration):
    html = report(ATTACK, true_calibration)
    (found,) = re.findall(r'<script type="application/json">(.*?)</script>', html, re.DOTALL)
    (layer,) = json.loads(found)["layers"]
    assert layer["name"] == ATTACK


def test_a_link_of_a_campaign_leads_where_the_page_lies(true_calibration):
    """A name that begins with a minus must not be typeset in its link."""
    names = ["-5", "a/-12.5", "-30%20mm", "b 7 mm", 'q"uote']
    rows = [CampaignEntry(n, "done", "", None, f"{n}/report.html", {}) for n in names]
    page = Page(render_campaign("Campaign", rows, true_calibration))
    assert [v for k, v in page.attributes if k == "href"] == [f"{n}/report.html" for n in names]
