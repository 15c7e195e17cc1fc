"""A part turned on the chuck has one x and y in all scans, and is no other surface."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from omsm_ros.core.correction.correct import CorrectionOptions
from omsm_ros.core.surface.aperture import Aperture, BoundedSurface
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.io.results import CloudFile
from omsm_ros.pipelines.adjust import adjust_bags, write_adjustment

from .test_corrected_scan import write

TURNED_RAD = 1.2


def on_chuck(blocks, angle):
    """Return ``blocks`` of the same part turned by ``angle`` from x towards y, C with it."""
    return [(replace(axes, c=axes.c - angle), distance) for axes, distance in blocks]


@pytest.fixture(scope="module")
def adjusted_to(tmp_path_factory, small_scan_blocks, true_calibration):
    folder = tmp_path_factory.mktemp("turned")
    bags = []
    for k, angle in enumerate((0.0, TURNED_RAD)):
        # The same scan twice would verify itself: another nanometre of distance.
        blocks = [
            (axes, replace(distance, distance=distance.distance + 1e-9 * k))
            for axes, distance in small_scan_blocks
        ]
        bags.append(write(folder / f"{k}.mcap", on_chuck(blocks, angle)))

    def adjusted_to(nominal):
        return adjust_bags(
            bags, true_calibration, nominal=nominal, options=CorrectionOptions(),
            clockings=(0.0, TURNED_RAD),
        )  # fmt: skip

    return adjusted_to


@pytest.fixture(scope="module")
def adjusted(tmp_path_factory, adjusted_to):
    folder = tmp_path_factory.mktemp("adjusted")
    found, scans = adjusted_to(PAPER_MIRROR)
    write_adjustment(folder, {}, found, scans, report=False)
    return scans, CloudFile(folder / "adjusted.ply").read()


def test_a_turned_part_is_of_the_nominal_surface(adjusted):
    scans, _ = adjusted
    assert [scan.doubts for scan in scans] == [scans[0].doubts] * 2
    assert not any("another surface" in doubt for doubt in scans[0].doubts)


def test_the_cloud_has_each_place_of_the_part_once(adjusted):
    scans, cloud = adjusted
    first = len(scans[0].points)
    for name in "xy":
        one, other = cloud[name][:first], cloud[name][first:]
        assert np.max(abs(one - other)) < 1e-8


def test_figures_are_of_the_aperture_of_the_nominal_surface(adjusted_to):
    """In the frame of the part, however it is turned on the chuck; the points are of all."""
    radius = 2e-3
    area = Aperture.of("ellipse", 0.7 * radius, 0.5 * radius, 0.2 * radius, 0.0)
    found, scans = adjusted_to(BoundedSurface(PAPER_MIRROR, area))
    inside = area.holds(found.form.x, found.form.y)
    assert np.all(inside | (found.form.area == 0))
    assert np.ptp(found.form.x) > 1.2 * radius
    assert np.max(np.hypot(scans[1].points.x, scans[1].points.y)) > 0.98 * radius
