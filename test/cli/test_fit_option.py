"""Rows that show a registration and a form."""

import math

import pytest

from omsm_ros.cli.fit_option import form_rows


@pytest.fixture
def facts():
    """On a small off-axis mirror, clocking correlates with tip and y."""
    by_noise, by_clocking = {"tip": 3e-6, "y": 4e-6}, {"tip": 17e-3, "y": 0.9e-3}
    return {
        "pose": {
            "tip": {"value": 1e-6, "uncertainty": math.hypot(5e-6, 17e-3)},
            "y": {"value": 22e-6, "uncertainty": math.hypot(4e-6, 0.9e-3)},
            "clocking": {"value": 0.0, "uncertainty": math.radians(1)},
        },
        "shape": {},
        "deviation": {
            "peak_to_valley": {"value": 1e-9, "uncertainty": 8e-9},
            "Ssk": {"value": -0.4, "uncertainty": 0.3},
        },
        "removed": {
            "fitted": ["tip", "y"],
            "not_determined": {"clocking": "it does what tip and y do"},
            "held": {"x": "form looks like it here"},
            "pose_uncertainty": {
                "noise and form": by_noise,
                "dynamics": {"tip": 4e-6, "y": 0.0},
                "clocking": by_clocking,
            },
            "notes": [],
            "not_evaluated": [],
        },
        "points": {"read": 40000, "used": 39990, "outliers": 10, "no_height": 0},
    }


def test_effects_of_an_undetermined_degree_of_freedom_are_reported_separately(facts):
    """3 and 4 µrad give 5 µrad; the 17 mrad of clocking are stated with the clocking."""
    rows = dict(form_rows(facts))
    assert rows["tip"] == "1.0 µrad ± 5.0 µrad (k = 1)"
    assert rows["y"] == "22.0 µm ± 4.0 µm (k = 1)"
    reported = rows["clocking, not fitted"]
    assert reported.startswith("it does what tip and y do; clocking ± 17 mrad correlates with")
    assert reported.endswith("tip ± 17 mrad, y ± 900 µm, at equal form")


def test_a_fixed_degree_of_freedom_is_reported_with_the_reason(facts):
    assert dict(form_rows(facts))["x, not fitted"] == "held: form looks like it here"


def test_an_unresolved_figure_is_reported_as_an_upper_bound(facts):
    rows = dict(form_rows(facts))
    assert rows["PV"] == "at most 17.0 nm (k = 2)"
    assert rows["Ssk"] == "-0.40 ± 0.60 (k = 2)"


def test_points_are_counted_by_what_became_of_them(facts):
    assert dict(form_rows(facts))["points"] == "40 000 read: 39 990 used, 10 outliers"
