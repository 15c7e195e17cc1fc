import html

import numpy as np
import pytest

from omsm_ros.report.campaign import CampaignEntry, judge, remarks, render

DAY_NS = 86_400 * 10**9


def measurement(i, rms, state="done", name=None):
    summary = {
        "samples": {"distance": {"received": 1000, "corrected": 990, "counted": {"settling": 10}}},
        "figures": {"rms": {"value": rms}, "peak_to_valley": {"value": 5 * rms}},
        "uncertainty": {"median": 10e-9},
    }
    said = "" if state == "done" else "no axes"
    return CampaignEntry(
        name or f"{i}.mcap", state, said, i * DAY_NS, f"{i}/report.html",
        summary if state == "done" else {},
    )  # fmt: skip


@pytest.fixture
def drifting():
    """Return twenty days of 0.5 nm drift per day, and one bad part."""
    random = np.random.default_rng(1)
    rms = 20e-9 + 0.5e-9 * np.arange(20) + random.normal(0, 0.3e-9, 20)
    rms[11] = 200e-9
    return [measurement(i, value) for i, value in enumerate(rms)]


def test_outliers_and_drift_are_named_with_their_size(drifting):
    reported = remarks(drifting, judge(drifting))
    assert any(t.startswith("11.mcap is an outlier: form deviation, rms") for t in reported)
    (drift,) = [t for t in reported if "deviation, rms drifts" in t]
    assert "pm per day" in drift or "nm per day" in drift
    assert not any("ncertainty" in t for t in reported)


def test_correlation_with_temperature_is_reported_with_its_size():
    """Return 2 nm per kelvin over two weeks without a trend of temperature or age."""
    random = np.random.default_rng(2)
    warm = 20.0 + random.normal(0, 0.5, 14)
    reported = [measurement(i, 20e-9 + 2e-9 * (t - 20)) for i, t in enumerate(warm)]
    for one, t in zip(reported, warm, strict=True):
        one.summary["conditions"] = {"temperature": {"mean": t}, "calibration_age": 86400.0}
    (said,) = [t for t in remarks(reported, judge(reported)) if "deviation, rms depends" in t]
    assert "temperature, 2.00 nm to 2.00 nm per kelvin" in said
    assert not any("Age" in t for t in remarks(reported, judge(reported)))


def test_what_three_digits_do_not_show_is_no_finding():
    random = np.random.default_rng(3)
    alike = 20e-9 * (1 + 1e-5 * np.arange(14) + 1e-6 * random.normal(size=14))
    alike[5] *= 1.001
    reported = [measurement(i, value) for i, value in enumerate(alike)]
    assert remarks(reported, judge(reported)) == []


def test_few_measurements_are_said_to_be_too_few():
    few = [measurement(0, 20e-9), measurement(1, 20e-9, "crashed")]
    assert remarks(few, judge(few)) == [
        "1.mcap: crashed, no axes",
        "outliers and drift: not evaluated, fewer than 5 measurements",
    ]


def test_the_page_has_a_row_for_each_and_escapes_names(drifting, true_calibration):
    bad = measurement(20, 0, "refused", name="<script>x</script>.mcap")
    page = render("Campaign", [*drifting, bad], true_calibration)
    assert page.count("<tr><th>") == 1 + 21
    assert "<script>" not in page
    assert html.escape(bad.name) in page
    assert 'class="out"' in page
    assert 'href="3/report.html"' in page


def test_a_campaign_without_any_result_has_a_page_too(true_calibration):
    page = render("Campaign", [measurement(0, 0, "refused")], true_calibration)
    assert "0.mcap: refused" in page
