"""The figure error of the twin's mirror against its own closed form and through a scan."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from omsm_ros.core.kinematics.kinematics import workpiece_xy
from omsm_ros.core.kinematics.trajectories import Spiral
from omsm_ros.core.surface import deviation as form
from omsm_ros.core.surface.nominal import PAPER_MIRROR, PAPER_MIRROR_RADIUS_M, Flat
from omsm_ros.errors import ConfigurationError
from omsm_ros.twin.cell import Cell, Probe, record
from omsm_ros.twin.part import FigureError

RADIUS = PAPER_MIRROR_RADIUS_M


def disk(points=401):
    line = np.linspace(-RADIUS, RADIUS, points)
    x, y = (axis.ravel() for axis in np.meshgrid(line, line))
    inside = np.hypot(x, y) <= RADIUS
    return x[inside], y[inside]


@pytest.mark.parametrize(
    ("name", "order"), [("astigmatism", 2), ("trefoil", 3)], ids=["astigmatism", "trefoil"]
)
def test_each_part_has_its_peak_to_valley_and_rms(name, order):
    alone = {"astigmatism": 0.0, "trefoil": 0.0, "ripple": 0.0, name: 100e-9}
    x, y = disk()
    error = FigureError(Flat(), RADIUS, **alone).deviation(x, y)
    assert np.ptp(error) == pytest.approx(100e-9, rel=1e-2)
    assert np.sqrt(np.mean(error**2)) == pytest.approx(50e-9 / np.sqrt(2 * (order + 1)), rel=1e-2)


def test_ripple_is_round_with_its_pitch():
    rings = FigureError(
        Flat(), RADIUS, astigmatism=0.0, trefoil=0.0, ripple=6e-9, ripple_pitch=1e-3
    )
    angle = np.linspace(0, 2 * np.pi, 50)
    for radius, height in ((0.0, 3e-9), (0.5e-3, -3e-9), (7e-3, 3e-9)):
        around = rings.deviation(radius * np.cos(angle), radius * np.sin(angle))
        assert around == pytest.approx(height, abs=1e-15)


def test_is_smooth_everywhere():
    """The second difference falls with the square of the step, also across the centre."""
    mirror = FigureError(PAPER_MIRROR, RADIUS)

    def roughness(step):
        x = np.arange(-2e-3, 2e-3, step)
        return np.abs(np.diff(mirror.deviation(x, np.zeros_like(x)), 2)).max()

    assert roughness(20e-6) == pytest.approx(roughness(10e-6) * 4, rel=0.02, abs=0)


def test_seed_decides_the_orientation_and_nothing_else():
    x, y = disk()
    one, same, other = (FigureError(Flat(), RADIUS, seed).deviation(x, y) for seed in (1, 1, 2))
    assert np.array_equal(one, same)
    assert np.ptp(one - other) > 20e-9
    assert np.std(one) == pytest.approx(np.std(other), rel=0.02)


def test_stands_on_the_nominal_surface():
    x, y = disk(51)
    mirror = FigureError(PAPER_MIRROR, RADIUS)
    assert mirror.height(x, y) - PAPER_MIRROR.height(x, y) == pytest.approx(mirror.deviation(x, y))


@pytest.mark.parametrize("wrong", [{"radius": 0.0}, {"radius": RADIUS, "ripple_pitch": -1.0}])
def test_lengths_must_be_positive(wrong):
    with pytest.raises(ConfigurationError, match="expected a number from 1e-12"):
        FigureError(Flat(), **wrong)


def test_a_perfectly_corrected_scan_finds_it():
    """Probe motion from the truth, no noise: what is left over the nominal is the figure error."""
    mirror = FigureError(PAPER_MIRROR, RADIUS)
    cell = Cell(probe=Probe(scale=1.0, noise=0.0, resolution=0.0), encoder_noise=0.0)
    scan = record(cell, Spiral(PAPER_MIRROR, RADIUS, 1e-3, 30.0), mirror, substeps=4)
    x, y = workpiece_xy(scan.axes.x, scan.axes.y, scan.axes.c)
    height = scan.probe_motion + scan.distance.distance
    found = form.deviation(x, y, height, PAPER_MIRROR)
    assert np.abs(found - mirror.deviation(x, y)).max() < 1e-15
    assert np.ptp(found) > 80e-9


def test_tool_marks_are_parabolas_from_cusp_to_cusp():
    bare = FigureError(Flat(), RADIUS, astigmatism=0.0, trefoil=0.0, ripple=0.0)
    marked = replace(bare, tool_marks=8e-9)
    radius = np.linspace(1e-3, 1.3e-3, 30_001)
    height = marked.deviation(radius, np.zeros_like(radius))
    assert np.ptp(height) == pytest.approx(8e-9, rel=1e-6)
    # A round tool of radius R leaves scallops of feed² / 8R: R is 3.5 mm here.
    bend = np.diff(height, 2) / (radius[1] - radius[0]) ** 2
    assert np.median(bend) == pytest.approx(8 * 8e-9 / 15e-6**2, rel=1e-3)
    assert np.all(bare.deviation(radius, radius) == 0)
