"""Every number on a page equals that of the file, to the digits shown."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from page_tables import PageTables, says, value_of

from omsm_ros.core.ripple import source_hypotheses
from omsm_ros.core.ripple.source_hypotheses import KINDS, PART
from omsm_ros.report.experiments import compared, done
from omsm_ros.report.measurement.page import Report, render
from omsm_ros.report.spectrum import render as render_spectrum

# Any value from picometres to metres, and unknown ones.
LENGTH = st.floats(1e-12, 1.0)
KNOWN = st.one_of(st.none(), LENGTH)
COUNT = st.integers(0, 10**9)
FEW = settings(max_examples=5)


def page_of(summary, **parts):
    return PageTables(render(Report("Scan", "today", summary, **parts)))


@FEW
@given(*[LENGTH] * 8)
def test_errors_and_headlines_are_those_of_the_summary(pv, rms, area, before, left, med, most, raw):
    summary = {
        "deviation": {
            "raw": {"peak_to_valley": raw, "rms": raw, "rms_area_weighted": raw},
            "corrected": {"peak_to_valley": pv, "rms": rms, "rms_area_weighted": area},
        },
        "dynamic_error_before": {"peak_to_valley": before, "rms": before / 3},
        "dynamic_error_after": {"peak_to_valley": left, "rms": left / 3},
        "uncertainty": {"median": med, "largest": most},
    }
    page = page_of(summary)
    value, detail = page.headlines["Dynamic error, rms"]
    assert [says(*p) for p in zip(value.split(" → "), (before / 3, left / 3), strict=True)] == [
        True, True,
    ]  # fmt: skip
    shown = detail.removeprefix("peak to valley ").split(" → ")
    assert [says(*p) for p in zip(shown, (before, left), strict=True)] == [True, True]
    value, detail = page.headlines["Expanded uncertainty"]
    assert says(value, 2 * med)
    assert says(detail.partition("at most ")[2], 2 * most)


@FEW
@given(st.lists(st.tuples(KNOWN, KNOWN, st.booleans()), min_size=1, max_size=6))
def test_the_budget_has_every_source_once_the_largest_first(sources):
    rows = [
        {
            "source": f"s_{k}", "says": f"x{k}", "kind": "random" if k % 2 else "systematic",
            "status": "not evaluated" if open_ else "stated", "reason": "why" if open_ else "",
            "standard_uncertainty": size, "height": height, "unit": "m",
        }
        for k, (size, height, open_) in enumerate(sources)
    ]  # fmt: skip
    (found,) = (
        t for t in page_of({"budget": {"sources": rows}}).tables if t["title"].startswith("Uncert")
    )
    shown = {row[0]: row[1:] for row in found["rows"]}
    missing = [f"{row['says']} ({row['source']})" for row in rows if row["reason"]]
    known = [row for row in rows if not row["reason"]]
    assert len(shown) == len(known) + bool(missing)
    largest = max((row["height"] or 0.0 for row in known), default=0.0)
    for row in known:
        size, height, acts, basis = shown[f"{row['says']} ({row['source']})"]
        assert says(size, row["standard_uncertainty"], 2)
        assert says(height, row["height"], largest=largest)
        assert acts == ("none" if row["kind"] == "random" else "all points")
        assert basis == "stated"
    if missing:
        assert shown["not evaluated"][-1] == "; ".join(missing)
        assert found["rows"][-1][0] == "not evaluated"
    order = [-(value_of(row[2].removeprefix("< ")) or 0.0) for row in found["rows"][: len(known)]]
    assert order == sorted(order)


@pytest.mark.parametrize("size", [0.0, 1e-4, 0.25, 12.0])
def test_a_share_has_no_prefix(size):
    source = {"source": "gain", "says": "x", "kind": "systematic", "status": "stated",
              "reason": "", "standard_uncertainty": size, "height": 1e-9, "unit": "1"}  # fmt: skip
    (found,) = (
        t for t in page_of({"budget": {"sources": [source]}}).tables
        if t["title"].startswith("Uncertainty")
    )  # fmt: skip
    assert says(found["rows"][0][1], size, 2)


@FEW
@given(st.dictionaries(st.sampled_from(["axes", "distance", "reference"]),
                       st.tuples(COUNT, COUNT, COUNT, COUNT), min_size=1))  # fmt: skip
def test_samples_are_whole_numbers_in_their_stream(streams):
    summary = {
        name: {"received": sum(n), "corrected": n[0], "pending": n[1],
               "counted": {"settling": n[2], "not_ok": n[3]}}
        for name, n in streams.items()
    }  # fmt: skip
    page = page_of({"samples": summary})
    (table,) = (t for t in page.tables if t["title"] == "Samples")
    assert table["columns"] == ["", *streams]
    rows = {row[0]: [int(cell.replace(" ", "")) for cell in row[1:]] for row in table["rows"]}
    for k, name in enumerate(streams):
        for row, value in (
            ("received", sum(streams[name])), ("corrected", streams[name][0]),
            ("settling", streams[name][2]), ("not ok", streams[name][3]),
        ):  # fmt: skip
            assert rows[row][k] == value
    assert ("still pending" in rows) is any(n[1] for n in streams.values())
    if "distance" in streams:
        value, detail = page.headlines["Surface points"]
        assert int(value.replace(" ", "")) == streams["distance"][0]
        reported = detail.removeprefix("of ").removesuffix(" samples received")
        assert int(reported.replace(" ", "")) == sum(streams["distance"])


@FEW
@given(st.lists(st.tuples(LENGTH, LENGTH, st.floats(0.01, 100)), min_size=1, max_size=5))
def test_limits_say_how_far_they_are_and_the_tightest_comes_first(limits):
    content = [
        {"name": f"limit {k}", "unit": "m", "value": v, "allowed": a, "speed_factor": f}
        for k, (v, a, f) in enumerate(limits)
    ]
    page = page_of({"prediction": {"limits": content, "not_evaluated": []}})
    (table,) = (t for t in page.tables if t["title"] == "Limits of the motion")
    for name, value, allowed, factor in table["rows"]:
        limit = content[int(name.removeprefix("limit "))]
        assert says(value, limit["value"])
        assert says(allowed, limit["allowed"])
        # A factor of speed is rounded down, to the safe side.
        shown, real = value_of(factor.removeprefix("≥ ").removesuffix(" ×")), limit["speed_factor"]
        assert shown <= real * (1 + 1e-12)
        assert real - shown <= 0.01 * real
    factors = [content[int(row[0].removeprefix("limit "))]["speed_factor"] for row in table["rows"]]
    assert factors == sorted(factors)


def spectrum_summary(peaks, name="scan", stop=None):
    scan = {
        "name": name, "duration": 12.34, "spindle_speed_rpm": 30.0, "path_length": 2.5,
        "samples": {"analysed": 12_340}, "form": {"rms_removed": 1.5e-6},
        "noise": {"rms": 3.21e-9, "amplitude": 4.56e-11}, "motion": {"outside_band_rms": None},
        "accelerometer": None, "vibration_removed": [], "peaks": peaks, "band_stop": stop,
        "sampling": [{"radius": 5e-3, "distance": 1.57e-5, "shortest_wavelength": 3.14e-5}],
    }  # fmt: skip
    counts = {kind: sum(p["kind"] == kind for p in peaks) for kind in KINDS}
    return {"scans": [scan], "counts": counts, "normalisation": "one-sided", "exposure": None}


def peak(kind="part", **changes):
    return {
        "kind": kind, "frequency": 123.456, "wavelength_along_path": 1.5e-5,
        "wavelength_along_radius": 2e-3, "amplitude": 7.89e-9, "amplitude_on_part": 8.1e-9,
        "significance": 12.3,
        "true_frequency": None, "true_wavelength": None, "order": None, "evidence": ["seen"],
        "needs": None,
    } | changes  # fmt: skip


@FEW
@given(st.floats(1e-3, 1e5), st.floats(1e-7, 1e-1), LENGTH, st.floats(3, 900))
def test_a_line_is_where_its_file_says(frequency, wavelength, amplitude, significance):
    reported = peak(
        PART, frequency=frequency, wavelength_along_path=wavelength, amplitude=amplitude,
        significance=significance,
    )  # fmt: skip
    page = PageTables(render_spectrum(spectrum_summary([reported]), {}))
    (cells,) = (t["rows"][0] for t in page.tables if t["title"] == "scan")
    assert cells[0] == PART
    for cell, value, digits in zip(
        cells[1:6],
        (frequency, wavelength, amplitude, 8.1e-9, significance),
        (5, 4, 3, 3, 3),
        strict=True,
    ):
        assert says(cell, value, digits), cell
    assert cells[7] == "seen"


@pytest.mark.parametrize(
    ("change", "truly"),
    [
        ({"true_frequency": 680.0, "true_wavelength": 1e-3, "order": 3}, "680.00 Hz"),
        ({"true_wavelength": 1.5e-5, "order": 3}, "15.00 µm"),
        ({"order": 3}, "3 per turn"),
        ({}, ""),
    ],
)
def test_what_a_line_truly_is_is_said_in_one_way(change, truly):
    page = PageTables(render_spectrum(spectrum_summary([peak(**change)]), {}))
    (cells,) = (t["rows"][0] for t in page.tables if t["title"] == "scan")
    assert cells[6] == truly


def test_a_line_across_the_path_has_its_radial_wavelength_and_what_it_needs():
    reported = peak(wavelength_along_path=None, needs="another speed", evidence=["a", "b"])
    page = PageTables(render_spectrum(spectrum_summary([reported]), {}))
    (cells,) = (t["rows"][0] for t in page.tables if t["title"] == "scan")
    assert cells[2] == "2.000 mm"
    assert cells[7] == "a; b; another speed"


def test_scans_sampling_and_band_stop_are_reported_in_their_units():
    stop = {"bands": [[310.0, 330.0], [40.0, 50.0]], "rms_before": 5e-9, "rms_after": 3e-9,
            "rms_removed": 4e-9, "settling_at_the_ends": 0.25}  # fmt: skip
    summary = spectrum_summary([peak()], stop=stop)
    acceleration_lines = {
        "axis": "z", "frequency": 680.0, "acceleration": 0.0912, "displacement": 5e-9,
        "significance": 44.0,
    }  # fmt: skip
    summary["scans"][0]["accelerometer"] = {"lines": [acceleration_lines]}
    page = PageTables(render_spectrum(summary, {}))
    (scans,) = (t for t in page.tables if "duration" in t["columns"])
    (row,) = scans["rows"]
    wanted = (12_340, 12.34, 30.0, 2.5, 1.5e-6, 3.21e-9, 4.56e-11, None)
    assert row[0] == "scan"
    assert all(says(c, v) for c, v in zip(row[2:], wanted[1:], strict=True))
    assert row[1] == "12 340"
    (cells,) = page.table("Sampling of the part").values()
    assert says(cells[0], 1.57e-5)
    assert says(cells[1], 3.14e-5)
    (stopped,) = (t["rows"][0] for t in page.tables if "rms before" in t["columns"])
    assert stopped[1] == "310 to 330 Hz, 40.0 to 50.0 Hz"
    assert [value_of(stopped[k]) for k in (2, 3, 4)] == pytest.approx([5e-9, 3e-9, 4e-9])
    assert says(stopped[6], 0.25)
    cells = page.table("Accelerometer lines")["scan, z"]
    assert cells[1] == "0.0912 m/s²"
    assert says(cells[2], 5e-9)


@pytest.mark.parametrize(
    ("peaks", "level", "word"),
    [([], "good", "No line above 3 σ"), (["PART"], "good", "Source of every line identified"),
     (["PART", "UNDECIDED"], "unknown", "Some lines of unknown source")],
)  # fmt: skip
def test_the_verdict_counts_the_lines(peaks, level, word):
    kinds = [getattr(source_hypotheses, name) for name in peaks]
    reported = [
        peak(k, needs="one more scan" if k == source_hypotheses.UNDECIDED else None) for k in kinds
    ]
    html = render_spectrum(spectrum_summary(reported), {})
    assert f'class="verdict {level}"' in html
    assert word in html
    items = PageTables(html).items
    assert all(f"1 {kind}" in items for kind in kinds)
    assert ("one more scan" in items) is (level == "unknown")


def test_paper_figures_and_ours_stand_in_the_same_rows():
    rows = [
        compared("error", "7.85 nm", 7.85e-9, 7.91e-9, "m", "as read"),
        compared("lag", "", None, 339e-6, "s"),
    ]
    page = PageTables(done("Fig. 9", "as it is", rows, {}, {}).page)
    (table,) = page.tables
    assert table["columns"] == ["", "the paper", "the twin", "ratio", "remark"]
    assert table["rows"] == [
        ["error", "7.85 nm", "7.910 nm", "1.01", "as read"], ["lag", "", "339.0 µs", "", ""],
    ]  # fmt: skip


def test_the_reader_of_these_tests_can_fail():
    assert value_of("−12.5 nm") == pytest.approx(-12.5e-9)
    assert value_of("3.19 · 10⁻⁵ nm") == pytest.approx(3.19e-14, rel=1e-6, abs=0)
    assert value_of("290 011") == 290_011
    assert math.isclose(value_of("0.12 %"), 0.0012)
    assert not says("12.6 nm", 12.5e-9)
    assert not says("12.5 µm", 12.5e-9)
    assert not says("–", 0.0)
