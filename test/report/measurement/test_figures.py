"""Values, units, limits and labels of the figures."""

from __future__ import annotations

import numpy as np
import pytest

from omsm_ros.core.surface import deviation as form
from omsm_ros.core.surface.aperture import Aperture
from omsm_ros.core.surface.area_weights import area_weights
from omsm_ros.core.surface.deviation import Profile
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.report.measurement import figures
from omsm_ros.report.measurement.surface_map import rasterise


@pytest.fixture(scope="module")
def deviations(cloud):
    weights = area_weights(cloud.x, cloud.y)
    return {
        name: form.level(
            cloud.x,
            cloud.y,
            form.deviation(cloud.x, cloud.y, height, PAPER_MIRROR),
            weights=weights,
        )
        for name, height in (
            ("raw", cloud.height + cloud.dynamic_error),
            ("corrected", cloud.height),
        )
    }


def texts(figure):
    """Return all texts on the axes."""
    found = []
    for axes in figure.get_axes():
        found += [axes.get_xlabel(), axes.get_ylabel(), axes.get_title(loc="left")]
        found += [text.get_text() for text in axes.texts]
        if axes.get_legend():
            found += [text.get_text() for text in axes.get_legend().get_texts()]
    return set(found) - {""}


class TestDeviationMap:
    @pytest.mark.parametrize(("unit", "size"), [("nm", 1e-9), ("µm", 1e-6), ("mm", 1e-3)])
    def test_pixels_are_in_the_unit_of_the_scale(self, cloud, unit, size):
        figure = figures.deviation_map(
            cloud.x, cloud.y, np.full(len(cloud), 5 * size), unit=unit, title="Five"
        )
        image = figure.get_axes()[0].get_images()[0].get_array()
        assert np.nanmin(image) == pytest.approx(5)
        assert np.nanmax(image) == pytest.approx(5)
        assert {"x [mm]", "y [mm]", f"deviation [{unit}]", "Five"} <= texts(figure)

    def test_axes_are_millimetres_of_equal_length(self, cloud):
        figure = figures.deviation_map(cloud.x, cloud.y, cloud.x, unit="mm", title="")
        axes = figure.get_axes()[0]
        assert axes.get_aspect() == 1
        assert axes.get_images()[0].get_extent() == pytest.approx(
            [-12.7, 12.7, -12.7, 12.7], abs=0.3
        )

    def test_two_maps_with_the_same_limits_have_the_same_colours(self, cloud, deviations):
        limits = figures.symmetric_limits(rasterise(cloud.x, cloud.y, deviations["raw"]))
        drawn = [
            figures.deviation_map(cloud.x, cloud.y, d, unit="µm", title="", limits=limits)
            for d in deviations.values()
        ]
        one, other = (f.get_axes()[0].get_images()[0].get_clim() for f in drawn)
        assert one == other == pytest.approx(np.array(limits) / 1e-6)

    def test_own_limits_hold_nearly_all_and_are_symmetric(self, cloud, deviations):
        low, high = figures.symmetric_limits(rasterise(cloud.x, cloud.y, deviations["raw"]))
        assert low == -high
        assert np.mean(np.abs(deviations["raw"]) <= high) > 0.99

    def test_one_outlier_does_not_take_the_colours(self, cloud, deviations):
        spoilt = deviations["corrected"].copy()
        spoilt[9] = 1e-3
        expected = figures.symmetric_limits(rasterise(cloud.x, cloud.y, deviations["corrected"]))
        assert figures.symmetric_limits(rasterise(cloud.x, cloud.y, spoilt)) == pytest.approx(
            expected, rel=0.1
        )

    @pytest.mark.parametrize(
        ("limits", "extend"),
        [((-1, 1), "neither"), ((-1e-9, 1), "min"), ((-1, 1e-9), "max"), ((-1e-9, 1e-9), "both")],
    )
    def test_the_scale_says_where_it_is_clipped(self, cloud, deviations, limits, extend):
        figure = figures.deviation_map(
            cloud.x, cloud.y, deviations["raw"], unit="µm", title="", limits=limits
        )
        assert figure.get_axes()[0].get_images()[0].colorbar.extend == extend

    def test_a_perfect_surface_is_drawn(self, cloud):
        assert figures.symmetric_limits(rasterise(cloud.x, cloud.y, np.zeros(len(cloud))))[1] > 0


class TestProfile:
    CUT = Profile(1e-3 * np.arange(5.0), 1e-6 * np.arange(5.0), np.ones(5, np.int64))

    def test_above_in_micrometres_below_in_nanometres(self):
        figure = figures.profile(
            {"a": self.CUT, "b": self.CUT}, self.CUT, title="Along x", position="x", unit="µm"
        )
        upper, lower = figure.get_axes()
        for axes, values in ((upper, np.arange(5.0)), (lower, 1e3 * np.arange(5.0))):
            line = axes.get_lines()[0]
            assert line.get_xdata() == pytest.approx(np.arange(5.0))
            assert line.get_ydata() == pytest.approx(values)
        assert {"deviation [µm]", "deviation [nm]", "x [mm]", "Along x"} <= texts(figure)

    def test_a_gap_in_the_cloud_breaks_the_line(self):
        position = np.r_[np.arange(10.0), np.arange(20.0, 30.0)] * 1e-3
        cut = Profile(position, np.ones(20), np.ones(20, np.int64))
        figure = figures.profile({"a": cut, "b": cut}, cut, title="", position="x", unit="µm")
        line = figure.get_axes()[0].get_lines()[0]
        assert np.flatnonzero(np.isnan(line.get_ydata())).tolist() == [10]


class TestDynamicError:
    def test_the_largest_error_is_drawn_in_its_unit(self):
        before = np.zeros(50_000)
        before[777] = 2e-6
        (upper,) = figures.dynamic_error(1e-3 * np.arange(50_000), before).get_axes()
        assert upper.dataLim.ymax == pytest.approx(2.0, rel=0.2)

    def test_without_the_truth_the_uncertainty_stands_below(self, cloud):
        figure = figures.dynamic_error(
            cloud.time, cloud.dynamic_error, uncertainty=cloud.uncertainty
        )
        assert figure.get_axes()[1].dataLim.ymax == pytest.approx(22.0)
        assert "±2u of a height" in texts(figure)

    def test_alone_it_is_one_panel(self, cloud):
        figure = figures.dynamic_error(cloud.time, cloud.dynamic_error)
        assert len(figure.get_axes()) == 1
        assert {"before [nm]", "time [s]"} <= texts(figure)


def test_a_registered_map_shows_points_left_out_and_what_no_point_covers():
    x, y = (v.ravel() for v in np.meshgrid(*[np.linspace(-5e-3, 5e-3, 120)] * 2))
    kept = (np.hypot(x, y) <= 5e-3) & ((x < 1e-3) | (y < 1e-3))
    form = {
        "aperture": {"rim": Aperture(5e-3).rim().tolist()},
        "left_out": {"x": [-2e-3], "y": [-1e-3]},
    }
    figure = figures.registered_map(x[kept], y[kept], 0 * x[kept], form)
    axes = figure.axes[0]
    assert axes.lines[0].get_xydata() == pytest.approx(np.array([[-2.0, -1.0]]))
    figure.canvas.draw()
    pixels = np.asarray(figure.canvas.buffer_rgba())[::-1]

    def colours(u, v):
        """Return the number of colours within 0.5 mm around u, v [mm]."""
        (left, low), (right, high) = (
            axes.transData.transform((u + s, v + s)).astype(int) for s in (-0.5, 0.5)
        )
        return len(np.unique(pixels[low:high, left:right].reshape(-1, 4), axis=0))

    assert colours(2.5, 2.5) > 3
    assert colours(-3.0, 2.0) == 1
    assert colours(4.9, 4.9) == 1
