"""Filters, texture and densities of cells: cell after cell, and by what changes nothing."""

from __future__ import annotations

import numpy as np
import pytest

from omsm_ros.core.form.deviation_map import GridCells, UncertainValue, gaussian_weights
from omsm_ros.core.form.texture import bands_of, power_density, texture

RNG = np.random.default_rng(12)


def cells_of(values, present=None, noise=0.0, effects=()):
    shape = values.shape
    present = np.ones(shape, bool) if present is None else present
    rows = np.array(effects).reshape(len(effects), *shape)
    return GridCells(
        x=1e-4 * np.arange(shape[1]), y=1e-4 * np.arange(shape[0]), steps=(1e-4, 1e-4),
        present=present, mean=values, noise=np.full(shape, noise), effects=rows,
    )  # fmt: skip


def test_a_filter_is_the_weighted_mean_of_the_cells_that_are_there():
    """``exp(−π (d / α λ)²)`` of ISO 16610-21, one cell after the other; missing cells stay so."""
    values, present = RNG.normal(size=(9, 11)), RNG.random((9, 11)) > 0.3
    cells = cells_of(values, present)
    found = cells.smoothed(values, 4e-4)
    of_rows, of_columns, total = cells.weights(4e-4)
    noise = of_rows**2 @ (0.04 * present) @ of_columns**2 / total**2 * present
    rows, columns = np.mgrid[:9, :11]
    alpha = np.sqrt(np.log(2) / np.pi)
    for i in range(9):
        for j in range(11):
            square = (rows - i) ** 2 + (columns - j) ** 2
            weight = np.exp(-np.pi * square / (alpha * 4) ** 2) * present
            share = weight / weight.sum()
            assert found[i, j] == pytest.approx(present[i, j] * np.sum(share * values), abs=1e-12)
            assert noise[i, j] == pytest.approx(present[i, j] * 0.04 * np.sum(share**2))


@pytest.mark.parametrize("cutoff", [5.0, 12.0])
def test_of_a_wave_at_the_cutoff_the_weights_pass_half(cutoff):
    row = gaussian_weights(201, cutoff)[100]
    wave = np.cos(2 * np.pi * (np.arange(201) - 100) / cutoff)
    assert row @ wave / row.sum() == pytest.approx(0.5, abs=1e-3)
    np.testing.assert_array_equal(gaussian_weights(30, cutoff), gaussian_weights(30, cutoff).T)


def test_texture_of_two_levels_is_known_by_hand():
    """Part of the cells a above the rest, and no filter that matters: cells of 0.1 mm."""
    block = np.zeros((9, 9))
    block[1::2, 1::2] = 1.0
    values = 40e-9 * np.kron(block, np.ones((24, 24)))
    cells = cells_of(values)
    found = texture(cells, cells, bands_of(cells, None, 1.0))
    p = 16 / 81
    assert found["Sq"].value == pytest.approx(40e-9 * np.sqrt(p * (1 - p)), rel=2e-3)
    assert found["Sa"].value == pytest.approx(40e-9 * 2 * p * (1 - p), rel=2e-3)
    assert found["Sz"].value == pytest.approx(40e-9, rel=2e-3)
    assert found["Ssk"].value == pytest.approx((1 - 2 * p) / np.sqrt(p * (1 - p)), rel=2e-3)
    assert found["Sku"].value == pytest.approx(1 / (p * (1 - p)) - 3, rel=2e-3)
    # Each of 16 blocks has four edges of 24 steps.
    edges = 4 * 16 * 24 / (216 * 215)
    assert found["Sdq"].value == pytest.approx(40e-9 / 1e-4 * np.sqrt(edges), rel=1e-9)


def test_texture_upside_down_and_turned_is_the_same_but_for_its_skewness():
    values = np.cumsum(RNG.normal(0, 1e-9, (40, 60)), axis=1)
    usual, down, turned = (
        texture(c, c, bands_of(c)) for c in map(cells_of, (values, -values, values.T))
    )
    assert {"Sa", "Sq", "Sz", "Ssk", "Sku", "Sdq"} <= set(usual)
    for name, figure in usual.items():
        sign = -1 if name == "Ssk" else 1
        assert down[name].value == pytest.approx(sign * figure.value)
        assert turned[name].value == pytest.approx(figure.value)


def test_slopes_of_a_plane_are_its_own_whatever_cells_are_missing():
    rows, columns = np.mgrid[:20, :30]
    plane = 1e-4 * (3e-6 * columns - 4e-6 * rows)
    holed = cells_of(plane, RNG.random((20, 30)) > 0.1)
    for cells in (cells_of(plane), holed):
        found = texture(cells, cells, bands_of(cells))
        assert found["slope_rms"].value == pytest.approx(5e-6, rel=1e-4)
        assert found["slope_largest"].value == pytest.approx(5e-6, rel=1e-3)
        unfiltered = texture(cells, cells, bands_of(cells, None, 1e3))
        assert unfiltered["Sdq"].value == pytest.approx(5e-6, rel=1e-4)


def test_a_single_cell_has_no_slope():
    one = cells_of(np.ones((1, 1)))
    for name in ("slope_rms", "Sdq"):
        assert texture(one, one, bands_of(one))[name] == UncertainValue(None, None)


def test_a_constant_effect_makes_no_texture_uncertain():
    values = RNG.normal(0, 1e-9, (40, 40))
    cells = cells_of(values, effects=[np.full((40, 40), 1e-6)])
    found, bare = (texture(c, c, bands_of(c)) for c in (cells, cells_of(values)))
    assert {"Sa", "Sq", "Sz"} <= set(found)
    for name, figure in found.items():
        assert figure.uncertainty == pytest.approx(bare[name].uncertainty, rel=1e-3, abs=0), name


# Densities.


@pytest.mark.parametrize("scale", [0.1, 30.0])
def test_a_density_grows_with_the_square_of_heights_and_knows_no_level(scale):
    values = RNG.normal(0, 1e-9, (32, 48))
    usual, other = power_density(cells_of(values)), power_density(cells_of(scale * values + 5e-6))
    np.testing.assert_allclose(other.areal, scale**2 * usual.areal, rtol=1e-6, atol=1e-42)
    assert other.mean_square == pytest.approx(scale**2 * usual.mean_square, rel=1e-6, abs=0)
    np.testing.assert_allclose(other.radial.value, scale**2 * usual.radial.value, rtol=1e-5)


def test_turned_by_a_quarter_the_density_over_direction_is_shifted_by_half_its_range():
    """Directions go from 0 to half a turn; radially nothing changes."""
    values = RNG.normal(0, 1e-9, (32, 32)) + 5e-9 * np.sin(np.arange(32))[np.newaxis]
    usual, turned = power_density(cells_of(values)), power_density(cells_of(values.T))
    np.testing.assert_allclose(turned.radial.value, usual.radial.value, rtol=1e-9)
    along = usual.azimuthal.position[np.argmax(usual.azimuthal.value)]
    across = turned.azimuthal.position[np.argmax(turned.azimuthal.value)]
    assert abs(across - along) == pytest.approx(np.pi / 2, abs=0.1)
