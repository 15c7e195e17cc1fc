"""All figures of a scan by the names of the page."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from soaked import soaked

from omsm_ros.core.surface.nominal import PAPER_MIRROR, PAPER_MIRROR_RADIUS_M
from omsm_ros.report.measurement.figures import levelled, surface_figures
from omsm_ros.report.measurement.page import CAPTIONS, MAPS, PROFILES

PNG = b"\x89PNG\r\n\x1a\n"


def part_of(cloud, chosen):
    return replace(cloud, **{f.name: getattr(cloud, f.name)[chosen] for f in fields(cloud)})


def test_with_a_nominal_surface_it_is_all_there(cloud):
    made = surface_figures(cloud, PAPER_MIRROR)
    assert set(made) == (
        {"raw_map", "corrected_map_same_scale", "corrected_map"} | set(PROFILES) | {"dynamic_error"}
    )
    assert all(picture.startswith(PNG) for picture in made.values())


def test_the_seat_of_the_part_is_removed_and_the_dynamic_error_is_not(cloud):
    tilted = replace(cloud, height=cloud.height + 5e-6 + 1e-4 * cloud.x - 2e-4 * cloud.y)
    corrected, raw = levelled(tilted, PAPER_MIRROR)
    flat, _ = levelled(cloud, PAPER_MIRROR)
    np.testing.assert_allclose(corrected, flat, atol=1e-14)
    difference = raw - corrected - cloud.dynamic_error
    assert np.ptp(difference) < 1e-15  # a constant: only a piston was removed
    seated, _ = levelled(tilted, PAPER_MIRROR, tilt=False)
    assert np.ptp(seated) > 20 * np.ptp(corrected)


def test_without_a_nominal_surface_it_shows_height_and_error(cloud):
    made = surface_figures(cloud, None)
    assert set(made) == {"height_map", "error_map", "dynamic_error"}
    assert set(made) <= set(CAPTIONS)
    assert {"height_map", "error_map"} <= set(MAPS)


@pytest.mark.parametrize("points", [1, *soaked(3, 200)])
def test_a_few_points_are_no_reason_to_fail(cloud, points):
    few = part_of(cloud, slice(0, points))
    assert "raw_map" in surface_figures(few, PAPER_MIRROR)


@pytest.mark.soak
def test_a_coarse_feed_still_has_profiles(cloud):
    share = np.arange(4000) / 4000
    radius, angle = PAPER_MIRROR_RADIUS_M * (1 - share), 2 * np.pi * 8 * share
    few = part_of(cloud, slice(0, 4000))
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    broad = replace(few, x=x, y=y, height=PAPER_MIRROR.height(x, y))
    assert set(PROFILES) <= set(surface_figures(broad, PAPER_MIRROR))


def test_a_piece_off_the_axes_has_a_map_but_not_all_profiles(cloud):
    piece = np.hypot(cloud.x - 8e-3, cloud.y - 4e-3) < 2e-3
    made = surface_figures(part_of(cloud, piece), PAPER_MIRROR)
    assert "corrected_map" in made
    assert "profile_x" not in made
    assert "profile_radius" not in made
