"""Figures of a registered part: values, units and uncertainties."""

import numpy as np
import pytest

from omsm_ros.report.measurement import figures as form_figures
from omsm_ros.report.measurement.page import CAPTIONS, Report, render

ZERNIKE = [
    {"n": 1, "m": 1, "value": 9e-6, "uncertainty": 1e-9},
    {"n": 2, "m": 2, "value": 50e-9, "uncertainty": 2e-9},
    {"n": 3, "m": -1, "value": 1e-9, "uncertainty": 2e-9},
    {"n": 4, "m": 0, "value": None, "uncertainty": None},
]


def curve(position, value, uncertainty):
    arrays = np.broadcast_arrays(np.array(position, float), value, uncertainty)
    names = ("position", "value", "uncertainty")
    return {n: a.tolist() for n, a in zip(names, arrays, strict=True)}


CURVES = {
    "profiles": {
        "x": curve([-2e-3, 0, 2e-3], [1e-9, 0, 3e-9], 1e-9),
        "y": curve([-1e-3, 1e-3], [2e-9, 5e-9], 1e-9),
        "radius": curve([1e-3, 2e-3], [1e-9, 2e-9], 1e-9),
        "angle": curve([-1.0, 1.0], [1e-9, 2e-9], 1e-9),
    },
    "psd": {
        "radial": curve([100.0, 1000.0, 3000.0], [4e-24, 1e-24, 1e-25], [3e-24, 2e-25, 1e-25]),
        "azimuthal": curve([0.1, 1.5, 3.0], [1e-18, 4e-18, 2e-18], 1e-19),
        "areal": {"x": [-1e3, 0.0, 1e3], "y": [-1e3, 1e3], "value": [[1e-24, 2e-24, 0.0]] * 2},
        "mean_square": 9e-18,
    },
}


def test_every_figure_has_a_place_on_the_page():
    made = form_figures.form_figures({"zernike": ZERNIKE}, CURVES)
    assert set(made) <= set(CAPTIONS)
    assert set(made) == {
        "zernike_terms", "form_lines", "form_rings", "psd_radial", "psd_direction", "psd_areal",
    }  # fmt: skip
    page = render(Report("Form of a", "today", {}, None, made, {"zernike": ZERNIKE}, CURVES))
    alternatives = (
        f'alt="{CAPTIONS[name]}"'[:30] for name in ("form_lines", "zernike_terms", "psd_radial")
    )
    order = ["Form of the part", "Validity of the measurement", *alternatives]
    places = [page.index(text) for text in order if text in page]
    assert places == sorted(places)
    assert set(form_figures.form_figures({"zernike": ZERNIKE}, {})) == {"zernike_terms"}


def test_bars_are_nanometres_grey_within_their_uncertainty_and_nothing_is_cut():
    figure = form_figures.zernike_terms(ZERNIKE)
    axes = figure.axes[0]
    assert [bar.get_height() for bar in axes.patches] == pytest.approx([50.0, 1.0])
    assert axes.patches[0].get_facecolor() != axes.patches[1].get_facecolor()
    figure.canvas.draw()
    name = axes.xaxis.label.get_window_extent()
    assert name.y0 >= 0
    assert min(t.get_window_extent().y0 for t in axes.get_xticklabels()) >= name.y1 - 1


def test_profiles_are_nanometres_over_millimetres_with_twice_their_uncertainty():
    curve = CURVES["profiles"]["x"], (1e-3, "position [mm]", "along x")
    figure = form_figures.curve_panels([curve], sharex=True)
    axes = figure.axes[0]
    line = axes.lines[0]
    assert line.get_xdata() == pytest.approx([-2.0, 0.0, 2.0])
    assert line.get_ydata() == pytest.approx([1.0, 0.0, 3.0])
    band = axes.collections[0].get_paths()[0].vertices
    assert (band[:, 1].min(), band[:, 1].max()) == pytest.approx((-2.0, 5.0))


def test_densities_are_read_in_nanometres_and_waves_per_millimetre():
    axes = form_figures.radial_density(CURVES["psd"]["radial"]).axes[0]
    assert axes.lines[0].get_xdata() == pytest.approx([0.1, 1.0, 3.0])
    assert axes.lines[0].get_ydata() == pytest.approx([4.0, 1.0, 0.1])
    # The first value is less than its expanded uncertainty: the band goes to the floor, not below.
    band = axes.collections[0].get_paths()[0].vertices
    assert band[:, 1].min() == pytest.approx(0.02)
    without = {**CURVES["psd"]["radial"], "value": [4e-24, 0.0, 1e-25]}
    axes = form_figures.radial_density(without).axes[0]
    assert axes.lines[0].get_ydata() == pytest.approx([4.0, np.nan, 0.1], nan_ok=True)
    single = {name: values[:1] for name, values in without.items()}
    assert len(form_figures.radial_density(single).axes[0].lines[0].get_ydata()) == 1
    turn = form_figures.direction_density(CURVES["psd"]["azimuthal"]).axes[0]
    assert turn.lines[0].get_ydata() == pytest.approx([1.0, 4.0, 2.0])
    assert turn.lines[0].get_xdata()[0] == pytest.approx(np.degrees(0.1))


def test_the_areal_density_has_a_scale_that_is_not_cut():
    figure = form_figures.areal_density(CURVES["psd"]["areal"])
    # 1e-24 m⁴ is 1 nm² mm².
    drawn = figure.axes[0].collections[0]
    assert drawn.get_array().max() == pytest.approx(2.0)
    assert figure.axes[0].get_xlim() == pytest.approx((-1.5, 1.5))
    figure.canvas.draw()
    bar = figure.axes[1]
    width = figure.bbox.width
    assert all(t.get_window_extent().x1 <= width for t in bar.get_yticklabels() if t.get_text())
    assert figure.axes[0].get_window_extent().x1 < bar.get_window_extent().x0
