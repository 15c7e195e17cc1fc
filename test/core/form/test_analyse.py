"""The whole of it, on points of any arrangement."""

import numpy as np
import pytest
from soaked import soaked

from omsm_ros.core.form import analyse, deviation_map
from omsm_ros.core.form.analyse import analyse_form
from omsm_ros.core.registration.placement import PointBatch
from omsm_ros.core.surface.aperture import Aperture
from omsm_ros.core.surface.aspheres import Sphere
from omsm_ros.core.surface.nominal import Flat
from omsm_ros.errors import DataError

RNG = np.random.default_rng(6)


def form(x, y, height, *asked, **options):
    portion = PointBatch(x, y, height, np.empty((0, len(x))))
    return analyse_form(Flat(), lambda: [portion], asked or ("auto",), **options)


@pytest.mark.parametrize("arrangement", ["profile", "ring", *soaked("strip", "random", "raster")])
def test_any_arrangement_of_points_is_judged(arrangement):
    """A ripple of 10 nm on a tilted flat: its rms is found wherever the points lie."""
    n = 5000
    x, y = RNG.uniform(-0.02, 0.02, (2, n))
    if arrangement == "profile":
        x, y = np.linspace(-0.02, 0.02, n), np.zeros(n)
    elif arrangement == "strip":
        y = y / 20
    elif arrangement == "ring":
        angle = np.linspace(0, 60 * np.pi, n)
        r = np.linspace(0.012, 0.02, n)
        x, y = r * np.cos(angle), r * np.sin(angle)
    elif arrangement == "raster":
        x, y = (v.ravel() for v in np.meshgrid(*(np.linspace(-0.02, 0.02, 100),) * 2))
    height = 1e-5 * x + 10e-9 * np.sin(2 * np.pi * x / 4e-3)
    found = form(x, y, height, even=arrangement == "raster")
    assert found.deviation["rms"].value == pytest.approx(10e-9 / np.sqrt(2), rel=0.05)
    assert found.counts["used"] == len(x)
    for name, figure in found.deviation.items():
        assert figure.value is None or np.isfinite(figure.value), name
        assert figure.uncertainty is None or figure.uncertainty >= 0, name
    # A ripple along x: that is where the spectrum has it.
    if arrangement != "profile":
        turn = found.density.azimuthal
        angle = turn.position[np.argmax(turn.value)]
        assert min(angle, np.pi - angle) < 0.2


def test_the_noise_is_not_the_least_of_what_estimates_of_it_are_by_chance():
    """Three maps have a form far below the noise; about zero by area is the rms of the points."""
    x, y = (v.ravel() for v in np.meshgrid(*(np.linspace(-0.01, 0.01, 60),) * 2))
    true, found = [], []
    for seed in range(3):
        noise = np.random.default_rng(seed).normal(0, 8e-9, len(x))
        figures = form(x, y, 1e-9 * (x * y / 1e-4) + noise, even=True).deviation
        true.append(np.std(noise))
        found.append(figures["point_noise"].value)
        whole = np.hypot(np.std(noise), 1e-9 / 3)
        assert figures["rms_of_points"].value == pytest.approx(whole, rel=0.01)
    assert np.mean(np.divide(found, true)) == pytest.approx(1, abs=0.006)


def test_a_map_reaches_to_the_rim_between_its_pixels():
    """An edge −r¹²: its peak to valley and rms over the disc, in closed form."""
    radius, size = 0.01, 200e-9
    x, y = (v.ravel() for v in np.meshgrid(*(np.linspace(-radius, radius, 80),) * 2))
    x, y = x[np.hypot(x, y) <= radius], y[np.hypot(x, y) <= radius]
    height = -size * (np.hypot(x, y) / radius) ** 12 + RNG.normal(0, 1e-9, len(x))
    asked = ("piston", "tip", "tilt")
    figures = form(x, y, height, *asked, aperture=Aperture(radius), even=True).deviation
    truth = {"peak_to_valley": size, "rms": size * np.sqrt(1 / 13 - 1 / 49)}
    for name, value in truth.items():
        assert abs(figures[name].value - value) < 2 * figures[name].uncertainty < 0.1 * value


def test_every_point_is_accounted_for():
    x, y = RNG.uniform(-0.02, 0.02, (2, 5000))
    height = np.nan_to_num(Sphere(0.019).height(x, y)) + RNG.normal(0, 1e-8, 5000)
    height[:7] = np.nan
    height[100:120] += 1e-5
    portion = PointBatch(x, y, height, np.empty((0, 5000)))
    found = analyse_form(Sphere(0.019), lambda: [portion], ("piston",), aperture=Aperture(0.015))
    counts = dict(found.counts)
    assert counts.pop("read") == 5000 == sum(counts.values())
    assert counts["not_finite"] >= 7
    assert counts["beyond_surface"] > 0
    assert counts["outside_aperture"] > 0
    inside = np.hypot(x[100:120], y[100:120]) < 0.015
    assert counts["outliers"] == pytest.approx(int(inside.sum()), abs=1)


def test_an_aperture_without_points_is_refused():
    x, y = RNG.uniform(-0.02, 0.02, (2, 5000))
    with pytest.raises(DataError, match="0 points lie on the nominal surface"):
        form(x, y, 0 * x, aperture=Aperture(0.001, 0.5, 0.0))


@pytest.mark.parametrize("turned", [0.0, 0.6])
def test_a_profile_has_the_figures_of_its_line(turned):
    """Points twice as dense on one half: each stands for the way that it covers, at any angle."""
    along = np.r_[np.arange(-400, 0) * 0.05e-3, np.arange(0, 201) * 0.1e-3]
    form_, ripple, period = 3e-6 * along**2 / 0.02**2, 5e-9, 2e-3
    wave = 2 * np.pi / period
    noise = np.random.default_rng(3).normal(0, 0.05e-9, len(along))
    height = form_ + ripple * np.sin(wave * along) + noise
    found = form(along * np.cos(turned), along * np.sin(turned), height, "piston").deviation
    even = np.linspace(-0.02, 0.02, 40_001)
    truth = 3e-6 * even**2 / 0.02**2 + ripple * np.sin(wave * even)
    rms, extent = (found[f"{name}_best_fit"] for name in ("rms", "peak_to_valley"))
    assert rms.value == pytest.approx(np.std(truth), rel=2e-3)
    assert abs(extent.value - np.ptp(truth)) < 2 * extent.uncertainty + 0.01e-9
    # Noise changes an extent by about its own size at two places.
    assert 0.02e-9 < extent.uncertainty < 0.3e-9
    rest = found["rms_without_second_order"]
    assert rest.value == pytest.approx(ripple / np.sqrt(2), rel=0.01)
    if turned == 0:
        slope = found["slope_rms_without_second_order"]
        assert slope.value == pytest.approx(ripple * wave / np.sqrt(2), rel=0.05)
        both = np.hypot(ripple * wave / np.sqrt(2), 2 * 3e-6 / 0.02 / np.sqrt(3))
        assert found["slope_rms"].value == pytest.approx(both, rel=0.01)


def test_a_map_that_cells_and_selection_do_not_hold_keeps_its_texture(monkeypatch):
    """White texture and a pit: 160 × 160 points in blocks of nine, every fourth one selected."""
    monkeypatch.setattr(deviation_map, "_MOST_OF_GRID", 64)
    monkeypatch.setattr(analyse, "MOST_WEIGHED", 2**13)
    step, size = 1e-5, 10e-9
    y, x = np.indices((160, 160)) * step
    height = size * np.random.default_rng(3).normal(size=x.shape)
    height[81, 81] = -40 * size
    asked = (x.ravel(), y.ravel(), height.ravel(), "piston", "tip", "tilt")
    found = form(*asked, even=True, dust="none", filters=(None, 1.0)).deviation
    true = np.sqrt(sum(np.mean(np.diff(height, axis=k) ** 2) for k in (0, 1))) / step
    assert true == pytest.approx(2 * size / step, rel=0.1)
    assert found["Sdq"].value == pytest.approx(true, rel=5e-3)
    assert found["Sq"].value == pytest.approx(size, rel=0.03)
    for whole in (found["peak_to_valley"], found["Sz"]):
        assert abs(whole.value - np.ptp(height)) < 2 * whole.uncertainty < 2 * np.ptp(height)
