"""Cells, filters, texture and spectra of waves whose figures are known in closed form."""

from dataclasses import replace

import numpy as np
import pytest

from omsm_ros.core.form import deviation_map
from omsm_ros.core.form.deviation_map import DeviationMap, GridCells, profile_noise, repeated_noise
from omsm_ros.core.form.part_figures import short_waves
from omsm_ros.core.form.texture import bands_of, power_density, texture
from omsm_ros.errors import DataError

SIDE = 20e-3


def square(shape, noise=0.0, points=400, effects=None):
    """A map of a square, evenly measured; ``shape(x, y)`` [m]."""
    x, y = np.meshgrid(*(np.linspace(0, SIDE, points),) * 2)
    x, y = x.ravel(), y.ravel()
    value = shape(x, y) + noise * np.random.default_rng(1).normal(size=len(x))
    rows = np.empty((0, len(x))) if effects is None else np.array([e(x, y) for e in effects])
    return DeviationMap(x=x, y=y, deviation=value, area=np.ones(len(x)), effects=rows, noise=noise)


def wave(length, size=10e-9, angle=0.0):
    return lambda x, y: (
        size * np.sin(2 * np.pi / length * (x * np.cos(angle) + y * np.sin(angle)) + 0.3)
    )


def test_a_cell_is_the_mean_of_its_points():
    cells = GridCells.of(square(lambda x, y: 1e-6 * x + 2e-6 * y, noise=0.0))
    assert np.all(cells.present)
    steps = np.diff(cells.mean, axis=1)
    assert np.median(steps) == pytest.approx(1e-6 * cells.pitch, rel=0.1)
    assert cells.mean.mean() == pytest.approx(1.5e-6 * SIDE, rel=0.01)


@pytest.mark.parametrize("length", [1.5e-3, 4e-3])
def test_half_of_a_wave_passes_at_the_cutoff(length):
    """ISO 16610-21: the transmission at the cutoff is one half."""
    cells = GridCells.of(square(wave(length)))
    passed = cells.smoothed(cells.mean, length)
    inner = (slice(None), slice(40, -40))
    assert np.std(passed[inner]) / np.std(cells.mean[inner]) == pytest.approx(0.5, abs=0.02)


def test_a_filter_does_not_drag_the_edge_down():
    cells = GridCells.of(square(lambda x, y: 1e-6 + 0 * x))
    np.testing.assert_allclose(cells.smoothed(cells.mean, 3e-3), 1e-6, rtol=1e-12)


def test_parameters_of_a_sine_are_those_of_the_textbook():
    """Sq = a/√2, Sa = 2a/π, Ssk = 0, Sku = 1.5, slope 2π a/λ/√2."""
    length, size = 3e-3, 10e-9
    cells = GridCells.of(square(wave(length, size)))
    found = texture(cells, cells, bands_of(cells, None, 15e-3))
    assert found["Sq"].value == pytest.approx(size / np.sqrt(2), rel=0.02)
    assert found["Sa"].value == pytest.approx(2 * size / np.pi, rel=0.02)
    assert found["Sz"].value == pytest.approx(2 * size, rel=0.06)
    assert found["Ssk"].value == pytest.approx(0.0, abs=0.1)
    assert found["Sku"].value == pytest.approx(1.5, abs=0.1)
    slope = 2 * np.pi * size / length / np.sqrt(2)
    assert found["slope_rms"].value == pytest.approx(slope, rel=0.01)
    # From a quarter to a twentieth of the side: what one Gaussian passes and the other not.
    passed = np.exp2(-((SIDE / 20 / length) ** 2)) - np.exp2(-((SIDE / 4 / length) ** 2))
    assert found["rms_waviness"].value == pytest.approx(passed * size / np.sqrt(2), rel=0.04)


@pytest.mark.soak
def test_noise_is_in_the_uncertainty_and_an_effect_too():
    quiet = square(wave(2e-3, 1e-9))
    noisy = square(wave(2e-3, 1e-9), noise=2e-8, effects=[wave(2e-3, 5e-10)])
    figures = [texture(c, c, bands_of(c)) for c in map(GridCells.of, (quiet, noisy))]
    for name in ("Sq", "Sa", "Sz", "Sdq", "slope_rms"):
        true, found = (of[name] for of in figures)
        assert abs(found.value - true.value) < 2 * found.uncertainty
        assert found.uncertainty > 0.2 * abs(found.value - true.value)
    bare = square(wave(2e-3, 1e-9), effects=[wave(2e-3, 5e-10)])
    cells = GridCells.of(bare)
    found = texture(cells, cells, bands_of(cells))["Sq"]
    assert found.uncertainty == pytest.approx(0.5 * found.value, rel=0.04)


def test_bands_are_what_was_asked_for_where_the_cells_allow_it():
    cells = GridCells.of(square(wave(2e-3)))
    assert bands_of(cells, 1e-3, 8e-3).l_filter == 8e-3
    assert bands_of(cells, 1e-3, 8e-3).s_filter == 1e-3
    assert bands_of(cells, 1e-9).s_filter == 4 * cells.pitch
    with pytest.raises(DataError, match="is not longer than the S-filter"):
        bands_of(cells, 8e-3, 8e-3)


# Spectral densities.


@pytest.mark.parametrize("angle", [0.0, 0.6, 2.0])
def test_the_density_holds_the_mean_square_and_where_it_is(angle):
    """Parseval in the plane, over radial frequency and over direction; the wave's own place."""
    cells = GridCells.of(square(wave(1.25e-3, angle=angle)))
    found = power_density(cells)
    step_x, step_y = found.x[1], found.y[1]
    assert found.areal.sum() * step_x * step_y == pytest.approx(found.mean_square, rel=1e-12, abs=0)
    # Cells hold means of their points, which is made up for.
    assert found.mean_square == pytest.approx(0.5e-16, rel=0.01, abs=0)
    turn = found.azimuthal
    assert turn.value.sum() * np.pi / len(turn.value) == pytest.approx(
        found.mean_square, rel=1e-9, abs=0
    )
    assert abs(turn.position[np.argmax(turn.value)] - angle) < 0.1
    radial = found.radial
    total = np.sum(2 * np.pi * radial.position * radial.value) * step_x
    assert total == pytest.approx(found.mean_square_in_band, rel=1e-12, abs=0)
    assert total == pytest.approx(found.mean_square, rel=0.01, abs=0)
    low, high = found.band
    assert (low, high) == pytest.approx((step_x / 2, radial.position[-1] + step_x / 2))
    assert high <= 1 / (2 * cells.pitch) + step_x
    assert radial.position[np.argmax(radial.value)] == pytest.approx(800.0, rel=0.05)


def test_the_density_of_noise_is_flat_and_of_the_known_height():
    """White noise of variance σ² on cells of pitch d has the density σ² d² everywhere."""
    map_ = square(lambda x, y: 0 * x, noise=1e-8)
    cells = GridCells.of(replace(map_, noise_known=False), even=True)
    found = power_density(cells).radial
    middle = found.value[5:-5]
    assert np.mean(middle) == pytest.approx(1e-16 * cells.pitch**2, rel=0.05, abs=0)
    known = power_density(replace(cells, noise_known=True)).radial
    assert np.all(known.value <= 2 * known.uncertainty)
    assert np.mean(known.value[5:-5]) < 0.1 * np.mean(middle)
    # The radial density ends before the corners of the square, so π/4 of the power remains.
    both = power_density(cells)
    assert both.mean_square_in_band == pytest.approx(np.pi / 4 * both.mean_square, rel=0.04, abs=0)
    # All of it is noise, and the uncertainty says so.
    assert np.all(middle < 2.5 * found.uncertainty[5:-5])


def test_blocks_of_the_density_hold_what_their_cells_do():
    found = power_density(GridCells.of(square(wave(1.25e-3, angle=0.4))))
    x, y, areal = found.coarse(48)
    assert areal.shape == (len(y), len(x))
    assert max(areal.shape) <= 48
    held = areal.sum() * (x[1] - x[0]) * (y[1] - y[0])
    assert held == pytest.approx(found.mean_square, rel=1e-3, abs=0)
    row, column = np.unravel_index(np.argmax(areal), areal.shape)
    assert np.hypot(x[column], y[row]) == pytest.approx(800.0, abs=(x[1] - x[0]) / 2**0.5)


def test_a_strip_and_a_disc_have_cells_too():
    x, y = np.random.default_rng(2).uniform(-1, 1, (2, 40_000))
    for chosen in (np.abs(y) < 0.06, x**2 + y**2 < 1):
        n = int(chosen.sum())
        map_ = DeviationMap(x=x[chosen], y=y[chosen], deviation=1e-9 * x[chosen],
                            area=np.ones(n), effects=np.empty((0, n)), noise=0.0)  # fmt: skip
        cells = GridCells.of(map_)
        assert cells.present.mean() > 0.6
        assert np.isfinite(texture(cells, cells, bands_of(cells))["Sq"].value)
        assert power_density(cells).mean_square >= 0


def test_a_wave_does_not_leak_into_other_frequencies():
    """Beyond two lines a raised cosine lets through -31 dB at most."""
    found = power_density(GridCells.of(square(wave(4e-3))))
    along = found.areal[0]
    away = np.abs(np.abs(found.x) - 250.0)
    assert np.max(along[away > 2.1 * found.x[1]]) < 1e-3 * np.max(along)


@pytest.mark.parametrize("rows", [1, 2, 3, 40])
def test_what_is_in_the_band_of_a_narrow_strip_is_no_less_than_nothing(rows):
    """A transform of two cells has zero and a negative frequency alone."""
    mean = np.random.default_rng(3).normal(0.0, 1e-9, (rows, 40))
    present = np.ones(mean.shape, bool)
    nothing = {"offset": np.zeros((2, 1, 1)), "noise": np.zeros((1, 1))}
    cells = replace(GridCells.of(square(wave(4e-3))), mean=mean, present=present, **nothing)
    for strip in (cells, replace(cells, mean=mean.T, present=present.T)):
        found = power_density(strip)
        assert found.mean_square_in_band >= 0
        assert found.mean_square > 0
        assert np.all(np.diff(found.radial.position) > 0)
        assert np.all(found.radial.value >= 0)


@pytest.mark.parametrize("even", [True, False])
def test_figures_of_the_texture_are_those_of_the_surface_and_not_of_its_cells(even):
    """Three waves in the closed forms of their sums, sixteen and more cells long each."""
    waves = [(2.6e-3, 10e-9, 0.3), (4.0e-3, 6e-9, 2.0), (1.9e-3, 3e-9, 1.2)]
    map_ = square(lambda x, y: sum(wave(*w)(x, y) for w in waves), points=320)
    cells = GridCells.of(map_, even=even)
    found = texture(cells, cells, bands_of(cells, None, 1.0))
    assert found["Sq"].value == pytest.approx(
        np.sqrt(sum(a * a for _, a, _ in waves) / 2), rel=0.01
    )
    steep = np.sqrt(sum((2 * np.pi * a / length) ** 2 for length, a, _ in waves) / 2)
    assert found["slope_rms"].value == pytest.approx(steep, rel=0.006)
    assert found["Sdq"].value == pytest.approx(steep, rel=0.01)
    squares = sum(a * a for _, a, _ in waves) / 2
    assert power_density(cells).mean_square_in_band == pytest.approx(squares, rel=0.05, abs=0)


def test_an_s_filter_that_is_asked_for_passes_half_at_its_cutoff():
    for even in (True, False):
        cells = GridCells.of(square(wave(0.75e-3), points=250), even=even)
        passed = texture(cells, cells, bands_of(cells, 0.75e-3, 1.0))["Sq"].value
        assert passed == pytest.approx(0.5 * 10e-9 / np.sqrt(2), rel=0.05)


def test_noise_of_a_profile_is_not_its_texture():
    """White noise on a smooth form is found; a texture that falls as 1/f² is not taken for it."""
    random, along = np.random.default_rng(8), np.arange(4000) * 1e-4
    smooth = 1e-6 * np.cos(along / 0.05) + 0.1e-9 * random.normal(size=4000)
    found, white = profile_noise(along[::-1], smooth[::-1])
    assert white
    assert found == pytest.approx(0.1e-9, rel=0.06)
    texture_ = smooth + 6e-9 * np.cumsum(random.normal(size=4000))
    assert not profile_noise(along, texture_)[1]
    again = texture_ + 0.1e-9 * random.normal(size=(3, 4000))
    places = np.tile(along, 3), np.zeros(12_000)
    assert repeated_noise(*places, again.ravel()) == pytest.approx(0.1e-9, rel=0.03)
    assert repeated_noise(along, 0 * along, texture_) is None


def test_waves_shorter_than_the_cells_count_in_the_texture_of_points():
    """Rings of 10 nm and half a millimetre under 2 nm of noise, on cells of a third of one."""
    rng = np.random.default_rng(4)
    share = np.linspace(1, 0, 20_000)
    x, y = (8e-3 * share * f(200 * np.pi * share) for f in (np.cos, np.sin))
    rings = 10e-9 * np.sin(2 * np.pi * np.hypot(x, y) / 0.5e-3)
    map_ = DeviationMap(x=x, y=y, deviation=rings + rng.normal(0, 2e-9, len(x)), area=share + 1e-9,
                        effects=np.empty((0, len(x))), noise=2e-9)  # fmt: skip
    cells = GridCells.of(map_)
    bands = bands_of(cells)
    found = texture(cells, cells, bands, short_waves(map_, cells, bands.l_filter))
    assert found["Sq"].value == pytest.approx(10e-9 / np.sqrt(2), rel=0.03)
    assert found["Sa"].value == pytest.approx(20e-9 / np.pi, rel=0.05)


@pytest.mark.parametrize("step", [1e-9 / 1.024, 1e-5 / 3, 1.953125e-9])
def test_a_grid_of_512_columns_has_as_many_cells(step):
    """Rounding must not make the grid wider than the most cells that there are."""
    x, y = (v.ravel() for v in np.meshgrid(*(np.arange(512) * step,) * 2))
    map_ = DeviationMap(
        x=x, y=y, deviation=x, area=np.ones(len(x)), effects=np.empty((0, len(x))), noise=0.0
    )
    assert GridCells.of(map_, even=True).mean.shape == (512, 512)


@pytest.mark.parametrize("size", [0.0, 1e-5])
def test_blocks_lose_no_gradient_of_a_fine_texture_on_a_large_form(monkeypatch, size):
    """White texture of 1 nm in blocks of four points; astigmatism and a cubic term of 10 µm."""
    monkeypatch.setattr(deviation_map, "_MOST_OF_GRID", 64)
    map_ = square(lambda x, y: 0 * x, noise=1e-9, points=128)
    fine = map_.deviation.reshape(128, 128)
    v, u = (np.indices((128, 128)) - 63.5) / 64
    seen = fine + size * (u**2 - v**2 + 0.3 * u**3)
    step = SIDE / 127
    slope = deviation_map.square_slope(seen, (step, step))
    cells, formless = (
        GridCells.of(replace(map_, deviation=values.ravel()), even=True) for values in (seen, fine)
    )
    found = texture(cells, formless, bands_of(cells, None, 1.0), map_, None, slope)["Sdq"]
    true = np.sqrt(sum(np.mean(np.diff(fine, axis=k) ** 2) for k in (0, 1))) / step
    assert found.value == pytest.approx(true, rel=5e-3)
