"""The verdict on the part, at the top of the page."""

from __future__ import annotations

import pytest

from omsm_ros.report.measurement.page import (
    form_table,
    limits_table,
    provenance_table,
    removed_table,
    verdict_on_part,
    verdict_on_points,
)

FORM = {
    "deviation": {
        "peak_to_valley_of_points": {"value": 185e-9, "uncertainty": None},
        "peak_to_valley": {"value": 171e-9, "uncertainty": 30e-9},
        "robust_peak_to_valley": {"value": 124e-9, "uncertainty": 20e-9},
        "rms": {"value": 21.6e-9, "uncertainty": None},
    },
    "pose": {
        "piston": {"value": 1.5e-9, "uncertainty": 0.2e-9},
        "tip": {"value": 50e-6, "uncertainty": 17e-3},
        "power": {"value": 0.25, "uncertainty": 0.01},
        "clocking": {"value": 0.0, "uncertainty": 17.45e-3},
    },
    "removed": {
        "fitted": ["piston", "tip", "power"],
        "not_determined": {"clocking": "a sphere looks alike from all sides"},
        "pose_uncertainty": {
            "noise and form": {"piston": 0.12e-9, "tip": 2e-6, "power": 0.01},
            "dynamics": {"piston": 0.16e-9, "tip": 0.0, "power": 0.0},
            "clocking": {"piston": 0.0, "tip": 17e-3, "power": 0.0},
        },
    },
}


def summary(verdict=None, code="verified"):
    found = {
        "verdict": {"code": code},
        "figures": {
            "peak_to_valley": {"value": 124e-9, "standard_uncertainty": 20e-9},
            "rms": {"value": 21.6e-9, "standard_uncertainty": 4e-9},
            "removed": ["piston", "tip"],
        },
    }
    if verdict:
        held = {"verdict": verdict, "value": 124e-9, "expanded": 40e-9, "tolerance": 200e-9}
        found["conformity"] = held
    return found


@pytest.mark.parametrize(
    ("verdict", "code", "level", "word"),
    [
        ("holds", "verified", "good", "The part meets its tolerance of 200 nm"),
        ("holds", "not_verified", "care", "Not verified: the part meets its tolerance"),
        ("fails", "verified", "bad", "The part exceeds its tolerance of 200 nm"),
        ("fails", "not_verified", "bad", "The part exceeds its tolerance of 200 nm"),
        ("cannot tell", "verified", "care", "Conformity not decided"),
    ],
)
def test_a_tolerance_is_answered_first(verdict, code, level, word):
    found = verdict_on_part(summary(verdict, code), FORM)
    assert found.level == level
    assert found.word.replace("\u202f", " ").startswith(word)


def test_without_a_tolerance_nothing_is_called_good():
    found = verdict_on_part(summary(), FORM)
    assert found.level == "unknown"
    assert "no tolerance given" in found.reasons[-1]


def test_every_figure_comes_with_its_expanded_uncertainty():
    reasons = [r.replace("\u202f", " ") for r in verdict_on_part(summary(), FORM).reasons]
    assert reasons[:2] == ["PV 124 nm ± 40 nm (k = 2)", "rms 21.6 nm ± 8.0 nm (k = 2)"]
    assert reasons[2] == "removed: piston, tip"


def test_a_form_of_points_alone_says_what_nobody_looked_at():
    found = verdict_on_points({"removed": {"not_evaluated": ["systematic errors"]}})
    assert found.level == "unknown"
    assert found.reasons == ("not evaluated: systematic errors",)
    assert verdict_on_points({"removed": {"not_evaluated": []}}).level == "care"


def test_all_figures_and_the_band_of_the_density_stand_in_one_table():
    psd = {"band": [50.0, 6000.0], "mean_square_in_band": 4e-18, "mean_square": 9e-18}
    rows = dict(form_table(FORM, {"psd": psd}).rows)
    assert rows["PV of points"].replace("\u202f", " ") == "185 nm"
    assert rows["PV of 99.5 %"] == "124 nm ± 40 nm (k = 2)"
    assert rows["rms in the band of the spectral density, 0.0500 to 6.00 1/mm"] == "2.00 nm"
    assert rows["rms of the windowed points"] == "3.00 nm"
    assert form_table({}, {}).rows == []


def test_what_was_taken_out_has_no_more_digits_than_are_known():
    rows = {row[0]: row[1:] for row in removed_table(FORM).rows}
    assert rows["tip"][:2] == ("50.0 µrad", "2.0 µrad")


def test_a_figure_below_its_uncertainty_is_a_bound():
    found = summary()
    for value, size, text in ((-1e-9, 450e-9, "at most 900 nm (k = 2)"),
                              (100e-9, 60e-9, "at most 220 nm")):  # fmt: skip
        found["figures"]["peak_to_valley"] = {"value": value, "standard_uncertainty": size}
        assert text in verdict_on_part(found, {}).reasons[0].replace("\u202f", " ")


def test_a_part_that_was_not_registered_says_so():
    raw = {"deviation": {"corrected": {"peak_to_valley": 1e-7, "rms_area_weighted": 1e-8}}}
    assert verdict_on_part(raw, {}) is None
    assert not removed_table({}).rows


def test_without_a_nominal_surface_there_is_no_verdict_on_the_part():
    assert verdict_on_part({}, {}) is None
    assert not removed_table({}).rows


def test_advice_for_a_better_scan_is_reported_with_the_figures():
    form = {**FORM, "removed": {**FORM["removed"], "notes": ["hold it: --fit piston,tip,tilt"]}}
    assert "hold it: --fit piston,tip,tilt" in verdict_on_part(summary(), form).reasons


def test_what_was_taken_out_has_units_and_reasons():
    table = removed_table(FORM)
    rows = [tuple(c.replace("\u202f", " ") for c in r) for r in table.rows]
    assert rows[0][:3] == ("piston", "1.50 nm", "0.20 nm")
    assert rows[1][:3] == ("tip", "50.0 µrad", "2.0 µrad")
    assert rows[2][1] == "0.250 1/m"
    assert rows[3][0] == "clocking, not fitted"
    # The correlated moves are stated here, not in the rows above.
    assert table.columns[-1] == table.prose
    assert rows[3][3].startswith("a sphere looks alike from all sides; clocking ± 17 mrad corr")
    assert "tip ± 17 mrad" in rows[3][3]


def test_the_tightest_limit_comes_first():
    limits = [
        {"name": "dynamics", "value": 6e-9, "allowed": 25e-9, "unit": "m", "speed_factor": 20.0},
        {"name": "spindle", "value": 30.0, "allowed": 120.0, "unit": "rpm", "speed_factor": 4.0},
        {"name": "range", "value": 1e-6, "allowed": 5e-5, "unit": "m", "speed_factor": 100.0},
    ]
    table = limits_table({"prediction": {"limits": limits}})
    assert [row[0] for row in table.rows] == ["spindle", "dynamics", "range"]
    assert [row[-1] for row in table.rows] == ["4.00 ×", "20.0 ×", "≥ 100 ×"]
    assert not limits_table({}).rows


def test_provenance_names_recording_and_calibration():
    reported = {"bag": "scan.mcap", "calibration": "c0ffee", "admission": {"overridden": True}}
    rows = dict(provenance_table(reported).rows)
    assert rows["recording"] == "scan.mcap"
    assert rows["calibration"] == "c0ffee"
    assert rows["overridden"] == "yes"
    assert not provenance_table({}).rows
