"""The certificate is whole, self-contained, escaped, and says what the calibration says."""

from __future__ import annotations

import re
from base64 import b64decode
from dataclasses import replace

import numpy as np
import pytest
from certified import certified_by
from parsed_page import Page

from omsm_ros.core.calibration.certificate import Certificate
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.errors import CalibrationError
from omsm_ros.report import style
from omsm_ros.report.certificate import figures as certificate_figures
from omsm_ros.report.certificate.figures import CAPTIONS
from omsm_ros.report.certificate.page import render, sections, verdict_on_calibration
from omsm_ros.report.page_parts import Issue
from omsm_ros.report.verdict import verdict_text

from .certificates import ATTACK, bare, by_name, certified, range_detail


class TestPage:
    def test_says_all_that_the_certificate_says(self, page, calibration):
        entries = calibration.certificate
        for text in (
            "Calibration certificate", "steps.mcap", "2025-01-31 12:00 UTC", "plate <3>",
            calibration.id, "omsm-calibration/2", "0.1.0", *map(str, entries.warnings),
            "Low-frequency delay", "Static gain", "χ²", "Noise of one reading", "k = 1",
            "Tests of the residual", "whiteness, p", "Candidates", "lowest BIC", "✓ chosen",
            "Modes", "Coefficients", "Shape of the response", "backlash", "none found",
            "falls when Z rises", "compared", "10 442", "1.000 ms", "500.0 Hz",
        ):  # fmt: skip
            assert text in page.text, text

    def test_the_verdict_comes_before_all_else(self, page, calibration):
        stated = verdict_text(calibration)
        word = f"✓ {stated.capitalize().replace('hz', 'Hz')}"
        assert word in page.text
        assert page.text.index(word) < page.text.index("Low-frequency delay")

    def test_carries_every_picture_whole(self, certificate):
        html = render(*certificate)
        found = [b64decode(data) for data in re.findall(r"data:image/png;base64,([^\"]+)", html)]
        assert set(certificate[1].figures) == set(CAPTIONS)
        assert sorted(found) == sorted(certificate[1].figures.values())

    def test_fetches_nothing(self, certificate, page):
        assert not {"script", "link", "iframe", "object"} & set(page.tags)
        addresses = [v for k, v in page.attributes if k in ("src", "href", "srcset", "action")]
        assert all(a.startswith("data:image/png;base64,") for a in addresses)
        assert not re.search(r"https?://|url\(|@import", render(*certificate))
        policy = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
        assert ("content", policy) in page.attributes

    def test_every_entry_without_a_place_is_shown_all_the_same(self, calibration):
        more = certified_by({"humidity": 0.41}, calibration.certificate)
        text = Page(render(*bare(replace(calibration, certificate=more)))).text
        assert "Further entries" in text
        assert "humidity 0.41" in text

    def test_no_entry_of_an_identification_is_without_a_place(self, page):
        assert "Further entries" not in page.text

    def test_everything_from_outside_is_escaped(self, calibration):
        hostile = replace(
            calibration,
            settings={ATTACK: ATTACK, "list": [ATTACK]},
            certificate=certified_by({
                "verdict": "rejected", "reasons": [ATTACK], "warnings": [ATTACK], ATTACK: ATTACK,
                "samples": {ATTACK: 3}, "self_calibration": {ATTACK: ATTACK}, "input": ATTACK,
            }),
        )  # fmt: skip
        page = Page(render(hostile, Issue(date=ATTACK, source=ATTACK, version=ATTACK)))
        assert not {"script", "img"} & set(page.tags)
        assert not any(key.startswith("on") for key, _ in page.attributes)
        assert "<script>alert('x')</script>" in page.text


class TestOlderCertificates:
    @pytest.fixture(params=[{}, {"verdict": "accepted"}, {"candidates": [], "modes": []}])
    def older(self, request, calibration):
        return certified(calibration, **request.param)

    def test_what_is_absent_leaves_no_hole(self, older):
        page = Page(render(*bare(older)))
        assert "–" not in page.text
        assert "None" not in page.text
        titles = [section.title for section in sections(*bare(older))]
        assert titles[:2] == ["Results", "Statements"]
        assert titles[2:] == ["Dynamics", "Static gain and background", "Records"]
        assert set(by_name(older)) == {
            "Low-frequency delay", "Latency in it", "Static gain, probe per encoder", "Valid up to",
            "Structure",
        }  # fmt: skip

    def test_each_entry_may_be_missing(self, calibration):
        content = calibration.certificate.content()
        assert len(content) > 10
        for name in content:
            rest = Certificate.from_content({k: v for k, v in content.items() if k != name})
            altered = bare(replace(calibration, certificate=rest))
            assert Page(render(*altered)).text

    def test_an_entry_of_another_kind_is_refused(self, calibration):
        content = calibration.certificate.content()
        for name in content.keys() - {"schema"}:
            with pytest.raises(CalibrationError, match=f"certificate.{name} is"):
                Certificate.from_content({**content, name: 5})

    def test_the_response_is_drawn_from_the_coefficients_alone(self, older):
        gain, *_ = certificate_figures.response_with_band(older).get_axes()
        assert [line for line in gain.get_lines() if line.get_label() == "identified"]

    def test_a_model_without_dynamics(self, calibration):
        still = replace(
            certified(calibration),
            dynamics=TransferFunction([1.0], [1.0], 1e-4),
            covariance=np.zeros((2, 2)),
        )
        figures = {"band": style.png(certificate_figures.response_with_band(still))}
        assert (
            "0 poles, 0 zeros, delay"
            in Page(render(still, Issue(date="today", figures=figures))).text
        )


class TestVerdict:
    @pytest.mark.parametrize(
        ("stated", "level", "word"),
        [
            ("accepted", "good", "Accepted, valid up to 500 Hz"),
            ("accepted up to 81 Hz", "good", "Accepted, valid up to 500 Hz"),
            ("rejected", "bad", "Rejected"),
            (None, "unknown", "Not judged"),
        ],
    )
    def test_is_the_certificates(self, calibration, stated, level, word):
        made = replace(certified(calibration, verdict=stated), valid_up_to=500.0)
        verdict = verdict_on_calibration(made)
        assert (verdict.level, verdict.word) == (level, word)
        assert verdict.reasons

    def test_rejected_says_why_and_claims_no_validity(self, calibration):
        bad = certified(calibration, verdict="rejected", reasons=["too sharp"])
        assert verdict_on_calibration(bad).reasons == ("too sharp",)
        assert "Valid up to" not in by_name(bad)
        text = Page(render(*bare(bad))).text
        assert "✕ Rejected too sharp" in text
        assert "rejected: not to be used" in text

    @pytest.mark.parametrize(
        ("valid", "shown", "why"),
        [
            (60.0, 80.0, "the band exceeds its limits"),
            (60.0, 60.0, "the motion excites too little"),
        ],
    )
    def test_accepted_says_why_no_further(self, calibration, valid, shown, why):
        short = replace(certified(calibration, shown_up_to_hz=shown), valid_up_to=valid)
        assert range_detail(short).startswith(f"beyond it {why}; half the")

    def test_accepted_to_the_end_has_no_beyond(self, calibration):
        whole = replace(certified(calibration, shown_up_to_hz=500.0), valid_up_to=500.0)
        assert range_detail(whole) == "half the sampling rate is 500 Hz"

    def test_accepted_names_the_evidence(self, calibration):
        reasons = " ".join(verdict_on_calibration(calibration).reasons)
        assert f"χ² = {calibration.certificate.residual.chi_square:.2f}" in reasons
        # The band, by a second way: drawing coefficients from their covariance. A twentieth
        # of it, for the band is linear and single coefficients are known to their size only.
        found = re.search(r"±([\d.]+) % in gain", reasons)
        random = np.random.default_rng(5)
        place = np.flatnonzero(np.diag(calibration.covariance))
        block = calibration.covariance[np.ix_(place, place)]
        numerator, denominator = calibration.dynamics.numerator, calibration.dynamics.denominator
        s = 2j * np.pi * calibration.valid_up_to
        gains = []
        for step in random.multivariate_normal(np.zeros(len(place)), block, size=4000):
            row = np.r_[numerator, denominator[1:], 0.0]
            row[place] += step / 20
            top, bottom = row[: len(numerator)], np.r_[1.0, row[len(numerator) : -1]]
            value = np.polynomial.polynomial.polyval
            gains.append(abs(value(s, top) / value(s, bottom)))
        assert float(found[1]) == pytest.approx(20 * 196 * np.std(gains) / np.mean(gains), rel=0.05)
