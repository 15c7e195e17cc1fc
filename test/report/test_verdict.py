"""The verdict states every reason and is never better than the worst one."""

from __future__ import annotations

import pytest

from omsm_ros.report.verdict import next_steps, verdict_on_measurement

LEVELS = {
    "verified": "good",
    "not_verified": "care",
    "contradicted": "bad",
    "too_uncertain": "bad",
    "invalid": "bad",
}


@pytest.mark.parametrize("code", LEVELS)
def test_the_level_is_that_of_the_verdict(summary, code):
    summary["verdict"] |= {"code": code, "text": "as found"}
    verdict = verdict_on_measurement(summary)
    assert (verdict.level, verdict.word) == (LEVELS[code], "As found")


def test_what_to_do_next_stands_first(summary):
    first, *others = verdict_on_measurement(summary).reasons
    assert first.replace("\u202f", " ").startswith(
        "next: scan again faster, and run 'omsm adjust' with all scans: then U of PV is about 4.0"
    )
    assert others == ["one speed cannot show a lag"]


def test_where_all_agrees_the_page_says_so():
    steps = next_steps({"code": "verified", "reasons": []})
    assert steps == ["the scans agree, and no declared source is refuted"]


@pytest.mark.parametrize("stream", ["axes", "distance"])
@pytest.mark.parametrize("change", [-3, 3])
def test_a_lost_or_invented_sample_makes_it_invalid(summary, stream, change):
    summary["samples"][stream]["received"] += change
    verdict = verdict_on_measurement(summary)
    assert verdict.level == "bad"
    assert verdict.reasons == (f"{stream}: 3 samples unaccounted for",)


def test_what_waits_is_accounted_for(summary):
    summary["samples"]["axes"] |= {"received": 40_045, "pending": 5}
    assert verdict_on_measurement(summary).level == "care"


def test_a_warning_takes_the_green_away(summary):
    summary["verdict"] = {"code": "verified", "text": "verified by two scans", "reasons": []}
    assert verdict_on_measurement(summary).level == "good"
    summary["warnings"] = ["motion beyond 100 Hz"]
    verdict = verdict_on_measurement(summary)
    assert verdict.level == "care"
    assert verdict.reasons[0] == "motion beyond 100 Hz"


def test_nothing_at_all_is_not_verified():
    assert verdict_on_measurement({}).level == "unknown"
