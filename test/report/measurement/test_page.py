"""The page is whole, self-contained, escaped, and shows what it is given."""

from __future__ import annotations

import re
from base64 import b64decode
from dataclasses import replace

import pytest
from certified import certified_by
from parsed_page import Page

from omsm_ros.report.measurement.page import CAPTIONS, Report, headlines, render
from omsm_ros.report.page_parts import typeset

ATTACK = "<script>alert('x')</script>\"><img src=x onerror=alert(1)>"


@pytest.fixture
def figures():
    return {name: f"picture of {name}".encode() for name in CAPTIONS}


@pytest.fixture
def report(summary, certified, figures):
    return Report("Mirror 7", "2025-01-31", summary, certified, figures)


def test_is_well_formed_and_has_all_parts(report):
    page = Page(render(report))
    for text in (
        "Mirror 7", "2025-01-31", "Valid", "Surface", "Profiles", "Dynamic error",
        "Dynamics of the probe", "Samples", "Calibration", "Settings", "Versions",
        "exposure 1 ms", "0.1.0", "settling", report.calibration.id,
    ):  # fmt: skip
        assert page.says(text), text


def test_carries_every_picture_whole(report):
    html = render(report)
    found = [b64decode(data) for data in re.findall(r"data:image/png;base64,([^\"]+)", html)]
    assert sorted(found) == sorted(report.figures.values())


def test_fetches_nothing(report):
    html = render(report)
    page = Page(html)
    assert "script" not in page.tags
    assert "link" not in page.tags
    addresses = [v for k, v in page.attributes if k in ("src", "href", "srcset", "action", "data")]
    assert all(a.startswith("data:image/png;base64,") for a in addresses)
    assert not re.search(r"https?://|url\(|@import", html)
    assert ("content", "default-src 'none'; img-src data:; style-src 'unsafe-inline'") in (
        page.attributes
    )


def test_every_picture_has_a_text_for_those_who_do_not_see_it(report):
    page = Page(render(report))
    texts = [value for key, value in page.attributes if key == "alt"]
    assert len(texts) == page.tags.count("img") == len(CAPTIONS)
    assert all(texts)


def test_everything_from_outside_is_escaped(summary, certified):
    summary |= {
        "warnings": [ATTACK],
        "settings": {ATTACK: ATTACK, "list": [ATTACK]},
        "versions": {"omsm_ros": ATTACK},
    }
    summary["samples"]["distance"]["counted"] = {ATTACK: 40}
    summary["samples"][ATTACK] = summary["samples"].pop("axes")
    certificate = {"verdict": "rejected", "warnings": [ATTACK], "reasons": [ATTACK]}
    hostile = replace(certified, settings={ATTACK: ATTACK}, certificate=certified_by(certificate))
    page = Page(render(Report(ATTACK, ATTACK, summary, hostile)))
    assert "script" not in page.tags
    assert "img" not in page.tags
    assert not any(key.startswith("on") for key, _ in page.attributes)
    assert page.says("<script>alert('x')</script>")


def test_a_measurement_of_which_nothing_is_known_still_gives_a_page():
    page = Page(render(Report("Bag", "today", {})))
    assert page.says("Not verified")
    assert "img" not in page.tags
    assert "dl" not in page.tags


def test_a_correction_without_truth_and_step_test(summary, certified):
    del summary["dynamic_error_after"], summary["deviation"]
    page = Page(render(Report("Bag", "today", summary, certified, {"error_map": b"picture"})))
    assert page.says("Dynamic error removed, rms")
    assert not page.says("Dynamics of the probe")
    assert not page.says("deviation from nominal")
    assert page.tags.count("figure") == 1


def test_settings_that_are_those_of_the_calibration_are_said_once(summary, certified):
    same = replace(certified, settings=summary["settings"])
    assert render(Report("a", "b", summary, same)).count(typeset("exposure 1 ms")) == 1


@pytest.mark.parametrize(
    ("code", "word"), [("verified", "✓ Verified"), ("invalid", "✕ Measurement not valid")]
)
def test_the_verdict_is_a_sign_and_a_word_before_all_else(summary, certified, code, word):
    summary["verdict"] |= {"code": code, "text": word[2:]}
    text = Page(render(Report("a", "b", summary, certified))).text
    assert word in text
    assert text.index(word) < text.index("Samples")


def test_headlines_are_the_numbers_of_the_summary(summary):
    found = {
        h.name: (h.value + " | " + h.detail).replace("\u202f", " ") for h in headlines(summary)
    }
    assert found["Dynamic error, rms"].startswith("246 nm → 1.20 nm")
    # Twice the standard uncertainty.
    assert found["Expanded uncertainty"].startswith("22.0 nm")
    assert found["Surface points"] == "40 000 | of 40 040 samples received"
