"""A form file has the content that a registration writes; errors name their place."""

from __future__ import annotations

import json

import pytest

from omsm_ros.errors import FileError
from omsm_ros.io.results import read_curves, read_form
from omsm_ros.report.measurement.page import Report, correlated_moves, render

FIGURE = {"value": 2e-9, "uncertainty": 1e-10}
FORM = {
    "pose": {"piston": FIGURE, "tip": FIGURE},
    "deviation": {"rms": FIGURE, "peak_to_valley": {"value": None, "uncertainty": None}},
    "zernike": [{"n": 2, "m": -2, **FIGURE}, {"n": 3, "m": 1, "value": None, "uncertainty": None}],
    "removed": {
        "fitted": ["piston", "tip"], "not_determined": {"clocking": "alike"}, "held": {},
        "pose_uncertainty": {"noise": {"piston": 1e-9, "tip": 1e-9},
                             "clocking": {"piston": 0.0, "tip": 1e-6}},
        "not_evaluated": [], "notes": ["a"],
    },
    "conformity": {"verdict": "holds", "tolerance": 1e-6, "value": 1e-7},
    "points": {"read": 9},
}  # fmt: skip
CURVE = {"position": [1.0, 2.0], "value": [3.0, 4.0], "uncertainty": [0.0, 1.0]}
CURVES = {
    "profiles": {"x": CURVE, "radius": CURVE},
    "psd": {
        "radial": CURVE, "azimuthal": CURVE, "mean_square": 2.0, "mean_square_in_band": 1.0,
        "band": [1.0, 9.0], "normalisation": "two-sided",
        "areal": {"x": [1, 2, 3], "y": [1, 2], "value": [[1, 2, 3], [4, 5, 6]]},
    },
}  # fmt: skip


def changed(content, way, value):
    made = json.loads(json.dumps(content))
    place = made
    for key in way[:-1]:
        place = place[key]
    if value is ...:
        del place[way[-1]]
    else:
        place[way[-1]] = value
    return made


def written(folder, name, content):
    (folder / name).write_text(json.dumps(content))
    return folder / name


def test_what_a_registration_writes_is_read_as_it_is(tmp_path):
    assert read_form(written(tmp_path, "form.json", FORM)) == FORM
    assert read_curves(written(tmp_path, "curves.json", CURVES)) == CURVES
    assert read_curves(written(tmp_path, "curves.json", {})) == {}
    least = {"zernike": []}
    assert read_form(written(tmp_path, "form.json", least | {"conformity": None}))
    assert "Figures of the form" in render(Report("a", "b", {}, form=FORM, curves=CURVES))


@pytest.mark.parametrize(
    ("way", "value", "reported"),
    [
        (["deviation"], 3, "deviation is 3, expected names and values"),
        (["deviation", "rms"], 1e-9, "deviation.rms is 1e-09, expected names and values"),
        (
            ["deviation", "rms", "value"],
            "2 nm",
            "value is '2 nm', expected a number or null; write",
        ),
        (["deviation", "rms", "uncertainty"], ..., "uncertainty is required and missing"),
        (["deviation", "rms", "value"], 1e300, "value is 1e.300, expected -1e.50 to 1e.50"),
        (["zernike"], ..., "zernike is required and missing"),
        (["zernike", 0], [2, -2], "expected names and values"),
        (["zernike", 0, "n"], 2.5, r"zernike\[0\].n is 2.5, expected a whole number"),
        (["pose", "tip"], None, "pose.tip is None, expected names and values"),
        (["removed"], [], r"removed is \[\], expected names and values"),
        (["removed", "fitted"], "piston", "removed.fitted is 'piston', expected a list"),
        (["removed", "fitted", 0], 7, r"removed.fitted\[0\] is 7, expected a text"),
        (["removed", "held"], {"x": 3}, "removed.held.x is 3, expected a text"),
        (["removed", "pose_uncertainty", "noise", "tip"], ..., "pose_uncertainty.noise lacks tip"),
        (["removed", "pose_uncertainty", "noise"], 1, "noise is 1, expected names and values"),
        (["conformity", "verdict"], "maybe", "conformity.verdict is 'maybe', expected one of"),
        (["conformity"], {}, "verdict is required and missing"),
    ],
)
def test_a_form_that_was_altered_is_reported_by_its_place(tmp_path, way, value, reported):
    path = written(tmp_path, "form.json", changed(FORM, way, value))
    with pytest.raises(FileError, match=rf"^form '.*form.json': .*{reported}") as refused:
        read_form(path)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("way", "value", "reported"),
    [
        (["psd"], 3, "psd is 3, expected names and values or null"),
        (["psd", "band"], [1.0], "psd.band has 1 values, expected at least 2"),
        (["psd", "mean_square"], -1.0, "mean_square is -1.0, expected 0 to 1e.50"),
        (["psd", "radial", "value"], ..., "value is required and missing"),
        (["psd", "radial", "value"], [1.0], r"radial has columns of \[1, 2\] values; register"),
        (["psd", "azimuthal", "value"], [1.0, "b"], "azimuthal is no row of numbers"),
        (
            ["profiles", "x", "position"],
            [[1.0, 2.0]],
            r"x has shape \(1, 2\) or values that are not finite",
        ),
        (
            ["profiles", "x", "value"],
            [1.0, None],
            "x has shape .2,. or values that are not finite; regis",
        ),
        (
            ["profiles", "radius", "value"],
            [],
            "radius has shape .0,. or values that are not finite",
        ),
        (["profiles"], [], r"profiles is \[\], expected names and values"),
        (["psd", "areal", "x"], [1, 2], "areal.value has 2 × 3 values at 2 × 2 frequencies"),
        (["psd", "areal", "value"], [[1, 2, 3], [4]], "areal.value is no row of numbers"),
    ],
)
def test_curves_that_were_altered_are_reported_by_their_place(tmp_path, way, value, reported):
    path = written(tmp_path, "curves.json", changed(CURVES, way, value))
    with pytest.raises(FileError, match=rf"^curves '.*curves.json': .*{reported}") as refused:
        read_curves(path)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("read", [read_form, read_curves])
@pytest.mark.parametrize("text", ["", "[1]", '{"a": NaN}', '{"a": 1, "a": 2}'])
def test_invalid_json_is_reported(tmp_path, read, text):
    (tmp_path / "f.json").write_text(text)
    with pytest.raises(FileError, match=r"f.json' is "):
        read(tmp_path / "f.json")
    with pytest.raises(FileError, match=r"none.json'; check the path"):
        read(tmp_path / "none.json")


@pytest.mark.parametrize("own", [None, 0.0, 2e-6])
@pytest.mark.parametrize("share", [0.0, 1e-6])
def test_correlated_moves_are_reported_only_where_both_are_known(own, share):
    form = changed(FORM, ["pose", "clocking"], {"value": 0.0, "uncertainty": own})
    form["removed"]["pose_uncertainty"]["clocking"] = {"piston": 0.0, "tip": share}
    reported = correlated_moves(form, "clocking")
    assert bool(reported) is bool(own and share)
    if reported:
        assert reported.startswith("; clocking ± 2.0 µrad correlates with tip ± 1.0 µrad")
