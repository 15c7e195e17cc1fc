"""The certificate is whole, self-contained, escaped, and says what the calibration says."""

from __future__ import annotations

import re
from base64 import b64decode
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser

import numpy as np
import pytest

from omsm_ros.core.dynamics.frequency_response import FrequencyResponse
from omsm_ros.core.dynamics.transfer_function import TransferFunction
from omsm_ros.core.identification.fitted_record import fitted_record
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.samples.motion_record import assemble
from omsm_ros.errors import ConfigurationError
from omsm_ros.report.certificate import figures as certificate_figures
from omsm_ros.report.certificate.markdown import picture_name, render_markdown
from omsm_ros.report.certificate.page import (
    CAPTIONS,
    CertificatePage,
    certificate_figures_of,
    headlines,
    render,
    sections,
    verdict_on_calibration,
)
from omsm_ros.report.certificate.reading import mode_table, shape_table, two_mass_table
from omsm_ros.report.certificate.tables import order_table
from omsm_ros.report.common import style

VOID = {"meta", "img", "br"}
ATTACK = "<script>alert('x')</script>\"><img src=x onerror=alert(1)>"


class Page(HTMLParser):
    """Tags, attributes and text of a page; fails where tags do not nest."""

    def __init__(self, html):
        super().__init__()
        self.tags, self.attributes, self._parts, self._open = [], [], [], []
        self.feed(html)
        self.close()
        assert not self._open, f"never closed: {self._open}"
        self.text = " ".join(" ".join(self._parts).replace("\u202f", " ").split())

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += attrs
        if tag not in VOID:
            self._open.append(tag)

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        self._parts.append(data)


@pytest.fixture(scope="module")
def record(step_test):
    return assemble([step_test.axes], [step_test.distance])


@pytest.fixture(scope="module")
def identified(record):
    return identify(record, order=2, settings={"fixture": "plate <3>"})


@pytest.fixture(scope="module")
def calibration(identified):
    return identified.calibration


@pytest.fixture(scope="module")
def fitted(identified):
    return fitted_record(identified)


@pytest.fixture(scope="module")
def figures(calibration, fitted):
    return certificate_figures_of(calibration, fitted)


@pytest.fixture(scope="module")
def certificate(calibration, figures):
    return CertificatePage(calibration, "2025-01-31 12:00 UTC", "steps.mcap", "0.1.0", figures)


@pytest.fixture(scope="module")
def page(certificate):
    return Page(render(certificate))


def certified(calibration, **entries):
    return replace(calibration, certificate=entries)


def bare(calibration):
    return CertificatePage(calibration, "today")


def by_name(calibration):
    return {h.name: h.value.replace("\u202f", " ") for h in headlines(calibration)}


def range_detail(calibration):
    (detail,) = (h.detail for h in headlines(calibration) if h.name == "Valid up to")
    return detail.replace("\u202f", " ")


class TestPage:
    def test_says_all_that_the_certificate_says(self, page, calibration):
        entries = calibration.certificate
        for text in (
            "Calibration certificate", "steps.mcap", "2025-01-31 12:00 UTC", "plate <3>",
            calibration.id, "omsm-calibration/1", "0.1.0", *entries["warnings"],
            "Low-frequency delay", "Static gain", "χ²", "Noise of one reading", "k = 1",
            "Tests of the residual", "whiteness, p", "Candidates", "lowest BIC", "✓ chosen",
            "Modes", "Coefficients", "Shape of the response", "backlash", "none seen",
            "falls when Z rises", "compared", "10 442", "1.000 ms", "500.0 Hz",
        ):  # fmt: skip
            assert text in page.text, text

    def test_the_verdict_comes_before_all_else(self, page, calibration):
        stated = calibration.certificate["verdict"]
        word = f"✓ {stated.capitalize().replace('hz', 'Hz')}"
        assert word in page.text
        assert page.text.index(word) < page.text.index("Low-frequency delay")

    def test_carries_every_picture_whole(self, certificate):
        html = render(certificate)
        found = [b64decode(data) for data in re.findall(r"data:image/png;base64,([^\"]+)", html)]
        assert set(certificate.figures) == set(CAPTIONS)
        assert sorted(found) == sorted(certificate.figures.values())

    def test_fetches_nothing(self, certificate, page):
        assert not {"script", "link", "iframe", "object"} & set(page.tags)
        addresses = [v for k, v in page.attributes if k in ("src", "href", "srcset", "action")]
        assert all(a.startswith("data:image/png;base64,") for a in addresses)
        assert not re.search(r"https?://|url\(|@import", render(certificate))
        policy = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
        assert ("content", policy) in page.attributes

    def test_every_entry_without_a_place_is_shown_all_the_same(self, calibration):
        more = {**calibration.certificate, "humidity": 0.41}
        text = Page(render(bare(replace(calibration, certificate=more)))).text
        assert "Further entries" in text
        assert "humidity 0.41" in text

    def test_no_entry_of_an_identification_is_without_a_place(self, page):
        assert "Further entries" not in page.text

    def test_everything_from_outside_is_escaped(self, calibration):
        hostile = replace(
            calibration,
            settings={ATTACK: ATTACK, "list": [ATTACK]},
            certificate={
                "verdict": ATTACK, "reasons": [ATTACK], "warnings": [ATTACK], ATTACK: ATTACK,
                "samples": {ATTACK: 3}, "structure": {"poles": ATTACK}, "candidates": [ATTACK],
                "polarity": ATTACK, "shape": ATTACK, "static_gains": [ATTACK], "modes": ATTACK,
                "two_mass": {"model": ATTACK}, "noise_m": ATTACK, "modal_remainder": ATTACK,
            },
        )  # fmt: skip
        page = Page(render(CertificatePage(hostile, ATTACK, ATTACK, ATTACK)))
        assert not {"script", "img"} & set(page.tags)
        assert not any(key.startswith("on") for key, _ in page.attributes)
        assert "<script>alert('x')</script>" in page.text

    def test_a_figure_without_a_place_is_refused(self, calibration):
        with pytest.raises(ConfigurationError, match="'selfie'"):
            CertificatePage(calibration, "today", figures={"selfie": b""})


class TestOlderCertificates:
    @pytest.fixture(params=[{}, {"verdict": "accepted"}, {"candidates": [], "modes": []}])
    def older(self, request, calibration):
        return certified(calibration, **request.param)

    def test_what_is_absent_leaves_no_hole(self, older):
        page = Page(render(bare(older)))
        assert "–" not in page.text
        assert "None" not in page.text
        titles = [section.title for section in sections(bare(older))]
        assert titles == ["Dynamics", "Static gain and background", "Records"]
        assert set(by_name(older)) == {
            "Low-frequency delay", "Of it latency", "Static gain, probe per encoder", "Valid up to",
            "Structure",
        }  # fmt: skip

    def test_each_entry_may_be_missing_or_of_another_kind(self, calibration):
        for name in calibration.certificate:
            rest = {k: v for k, v in calibration.certificate.items() if k != name}
            for wrong in (rest, {**rest, name: "?"}, {**rest, name: [None]}, {**rest, name: {}}):
                altered = replace(calibration, certificate=wrong)
                Page(render(bare(altered)))
                render_markdown(bare(altered))

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
        certificate = CertificatePage(still, "today", figures=figures)
        assert "0 poles, 0 zeros, delay" in Page(render(certificate)).text


class TestVerdict:
    @pytest.mark.parametrize(
        ("stated", "level", "word"),
        [
            ("accepted", "good", "Accepted"),
            ("accepted up to 81 Hz", "good", "Accepted up to 81 Hz"),
            ("rejected", "bad", "Rejected"),
            ("", "unknown", "Not judged"),
            ("perhaps", "unknown", "Perhaps"),
        ],
    )
    def test_is_the_certificates(self, calibration, stated, level, word):
        verdict = verdict_on_calibration(certified(calibration, verdict=stated))
        assert (verdict.level, verdict.word) == (level, word)
        assert verdict.reasons

    def test_rejected_says_why_and_claims_no_validity(self, calibration):
        bad = certified(calibration, verdict="rejected", reasons=["too sharp"])
        assert verdict_on_calibration(bad).reasons == ("too sharp",)
        assert "Valid up to" not in by_name(bad)
        text = Page(render(bare(bad))).text
        assert "✕ Rejected too sharp" in text
        assert "rejected: not to be used" in text

    @pytest.mark.parametrize(
        ("valid", "shown", "why"),
        [(60.0, 80.0, "the band leaves its limits"), (60.0, 60.0, "the motion tells too little")],
    )
    def test_accepted_says_why_no_further(self, calibration, valid, shown, why):
        short = replace(certified(calibration, shown_up_to_hz=shown), valid_up_to=valid)
        assert range_detail(short).startswith(f"beyond it {why}; half the")

    def test_accepted_to_the_end_has_no_beyond(self, calibration):
        whole = replace(certified(calibration, shown_up_to_hz=500.0), valid_up_to=500.0)
        assert range_detail(whole) == "half the sampling rate is 500 Hz"

    def test_accepted_names_the_evidence(self, calibration):
        reasons = " ".join(verdict_on_calibration(calibration).reasons)
        assert f"χ² = {calibration.certificate['chi_square']:.2f}" in reasons
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


class TestNumbers:
    def test_headlines(self, calibration):
        entries, found = calibration.certificate, by_name(calibration)
        delay = re.fullmatch(r"([\d.]+) µs ± ([\d.]+) µs", found["Low-frequency delay"])
        assert float(delay[1]) == pytest.approx(1e6 * entries["low_frequency_delay_s"], abs=0.06)
        uncertainty = 1e6 * entries["low_frequency_delay_uncertainty_s"]
        assert float(delay[2]) == pytest.approx(uncertainty, rel=0.05)
        gain = re.fullmatch(r"([\d.]+) ± ([\d.]+)", found["Static gain, probe per encoder"])
        assert float(gain[1]) == pytest.approx(calibration.static_gain, abs=1e-6)
        assert float(gain[2]) == pytest.approx(entries["static_gain_uncertainty"], rel=0.05)
        assert found["Noise of one reading"] == f"{1e9 * entries['noise_m']:.1f} nm"
        assert found["Structure"].startswith("2 poles")

    def test_the_lowest_bic_has_none_below_it(self, calibration):
        rows = order_table(calibration.certificate).rows
        above = [float(row[1]) for row in rows]
        assert min(above) == 0
        assert [row[0] for row in rows if "lowest" in row[3]] == [rows[int(np.argmin(above))][0]]
        chosen = [row[0] for row in rows if "chosen" in row[3]]
        assert chosen == [by_name(calibration)["Structure"]]

    def test_modes_say_whether_the_band_reaches_them(self, calibration):
        for valid, word in ((1.0, "no"), (400.0, "yes")):
            rows = mode_table(replace(calibration, valid_up_to=valid)).rows
            below = [m.frequency <= valid for m in calibration.dynamics.modes()]
            assert [row[4] == "yes" for row in rows] == below
            assert word in {row[4] for row in rows}

    def test_a_mode_has_frequency_damping_and_residue_with_uncertainties(self, calibration):
        omega = 2 * np.pi * 60.0
        lone = replace(
            calibration,
            dynamics=TransferFunction.from_ascending([1.0], [1.0, 0.04 / omega, omega**-2]),
            # Of the stiffness alone, 0.2 %: half of it is the frequency's, all the residue's.
            covariance=np.diag([0.0, 0.0, (2e-3 * omega**-2) ** 2, 0.0]),
        )
        (row,) = mode_table(lone).rows
        frequency, damping, residue = (text.replace("\u202f", " ") for text in row[1:4])
        assert frequency == "60.000 Hz ± 0.060 Hz"
        assert damping == "0.020000 ± 0.000020"
        assert residue == "0.14212 ± 0.00028"

    def test_a_point_beyond_the_trusted_band_says_so(self, calibration):
        shape = {"minimum": 347.0, "minimum_gain": 0.882, "bandwidth_1_percent": 40.0}
        entries = certified(calibration, shape=shape, modal_remainder=0.0066)
        rows = shape_table(replace(entries, valid_up_to=100.0)).rows
        assert [row[2] for row in rows] == ["yes", "no", "yes"]
        assert rows[2][1] == "0.66 %"

    def two_mass_rows(self, mass):
        model = {"m1": mass or 1.0, "m2": 2.0, "k1": 3e7, "k2": 5e6, "c1": 900.0, "c2": 80.0}
        spreads = {"m2": 0.01, "k1": 0.02, "k2": 0.03, "c1": 0.04, "c2": 0.05}
        entry = {
            "table_mass_kg": mass, "model": model, "relative_uncertainty": spreads,
            "misfit": 0.9, "collocated": False,
        }  # fmt: skip
        table = two_mass_table({"two_mass": entry})
        return table.title, {name: text.replace("\u202f", " ") for name, text in table.rows}

    def test_a_two_mass_model_has_units_and_uncertainties(self):
        _, texts = self.two_mass_rows(40.0)
        assert texts["m1"] == "40.00 kg, as given"
        assert texts["m2"] == "2.000 kg ± 0.020 kg"
        assert texts["k2"] == "5.00 MN/m ± 0.15 MN/m"
        assert texts["c2"] == "80.0 N·s/m ± 4.0 N·s/m"
        assert "not the driven one" in texts["probe on the"]

    def test_without_the_mass_of_the_table_all_is_per_mass(self):
        title, texts = self.two_mass_rows(None)
        assert title.endswith("per mass of the table")
        assert "m1" not in texts
        assert texts["m2 / m1"] == "2.000 ± 0.020"
        assert texts["k2 / m1"] == "5.00 MN/(m·kg) ± 0.15 MN/(m·kg)"
        assert texts["c2 / m1"] == "80.0 N·s/(m·kg) ± 4.0 N·s/(m·kg)"


class TestMarkdown:
    def test_names_the_pictures_beside_it(self, certificate):
        found = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", render_markdown(certificate))
        assert sorted(found) == sorted(picture_name(name) for name in CAPTIONS)

    def test_says_what_the_page_says(self, certificate, calibration):
        text = render_markdown(certificate).replace("\\", "").replace("\u202f", " ")
        for section in sections(certificate):
            assert f"## {section.title}" in text
            for table in section.tables:
                for row in table.rows:
                    for cell in row:
                        assert cell.replace("\u202f", " ") in unescape(text)
        assert calibration.certificate["verdict"] in text.lower().replace("hz", "Hz")

    def test_every_table_has_as_many_cells_in_every_row(self, certificate):
        blocks = re.findall(r"(?:^\|.*\n)+", render_markdown(certificate), re.MULTILINE)
        assert len(blocks) > 6
        for block in blocks:
            rows = block.strip().splitlines()
            assert len({len(re.findall(r"(?<!\\)\|", row)) for row in rows}) == 1
            assert re.fullmatch(r"\|(---\|)+", rows[1])

    def test_text_from_outside_stays_text(self, calibration):
        attack = f"{ATTACK} | a | [l](javascript:x) ![i](x) *b* `c`\n# h\r\n|---|\u2028- item"
        hostile = replace(
            calibration,
            settings={attack: attack},
            certificate={"verdict": attack, "reasons": [attack], "warnings": [attack]},
        )
        text = render_markdown(CertificatePage(hostile, attack, attack, attack))
        assert "<script" not in text
        assert "<img" not in text
        assert not re.search(r"(?<!\\)\]\(", text)
        # One heading a section: none smuggled in, no line begun by what came from outside.
        headings = [line for line in text.splitlines() if line.startswith("#")]
        assert not any(line.strip("# ") == "h" for line in headings)
        assert not [line for line in text.splitlines() if line.startswith("- item")]
        row = next(line for line in text.splitlines() if line.startswith("| &lt;script"))
        assert len(re.findall(r"(?<!\\)\|", row)) == 3


class TestFigures:
    def test_the_band_carries_the_estimate_without_a_model(self, calibration, fitted):
        made = certificate_figures.response_with_band(calibration, fitted.measured)
        gain = made.get_axes()[0]
        labels = {text.get_text() for text in gain.get_legend().get_texts()}
        assert labels == {"95 % band", "identified", "without a model, 95 %"}

    def test_a_phase_beyond_half_a_turn_lies_on_the_curve(self, calibration):
        late = replace(
            calibration,
            dynamics=TransferFunction([1.0], [1.0], 10e-3),
            covariance=np.zeros((2, 2)),
        )
        frequency = np.array([5.0, 60.0, 130.0, 210.0])
        exact = np.full(4, 1e-4)
        seen = FrequencyResponse(frequency, late.dynamics.response(frequency), np.ones(4), exact)
        phase = certificate_figures.response_with_band(late, seen).get_axes()[1]
        points = phase.containers[0].lines[0]
        np.testing.assert_allclose(points.get_ydata(), -360.0 * frequency * 10e-3, atol=1e-6)

    def test_the_end_of_trust_is_written(self, calibration):
        def notes(valid):
            shown = replace(calibration, valid_up_to=valid)
            axes = certificate_figures.response_with_band(shown).get_axes()
            return [text.get_text() for text in axes[1].texts]

        assert notes(80.72) == ["80.7 Hz"]
        assert notes(500.0) == []

    def test_close_lines_are_averaged_and_better_known(self):
        frequency = np.arange(0.0, 500.0)
        random = np.random.default_rng(6)
        spread = np.where(frequency < 100, 0.01, 0.05)
        noise = spread * (random.normal(size=500) + 1j * random.normal(size=500))
        coherence = np.where(frequency < 400, 0.9, 0.1)
        seen = FrequencyResponse(frequency, 1 + noise, coherence, spread)
        thin = certificate_figures.thinned(seen)
        assert thin.frequency[0] == 1.0
        assert thin.frequency[-1] < 400
        assert len(thin.frequency) < 40
        pulls = np.abs(thin.response - 1) / thin.uncertainty
        assert np.mean(pulls**2) / 2 == pytest.approx(1.0, abs=0.5)
        assert thin.uncertainty[-1] < 0.05 / 3

    def test_the_mean_edge_is_missing_without_edges(self, fitted):
        def rows(shown):
            return len(certificate_figures.residual(shown, 10e-9).get_axes())

        assert (rows(fitted), rows(replace(fitted, edges=()))) == (3, 2)

    def test_the_chosen_candidate_is_marked(self):
        tried = [{"parameters": n, "rms_m": r, "bic": b} for n, r, b in
                 ((1, 30e-9, 9.0), (2, 11e-9, 1.0), (3, 10e-9, 2.0))]  # fmt: skip
        (axes,) = certificate_figures.order(tried, 2).get_axes()
        marks = {line.get_label(): line.get_xydata()[0].tolist() for line in axes.get_lines()}
        assert marks["lowest BIC"] == pytest.approx([2, 11.0])
        assert marks["chosen"] == pytest.approx([3, 10.0])
