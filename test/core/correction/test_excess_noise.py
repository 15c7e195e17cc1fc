"""Scatter of a scan beyond its stated sources, and what is assumed of one scan."""

from __future__ import annotations

import pytest

from omsm_ros.core.adjustment.families import Ranges, families_of
from omsm_ros.core.correction.machine_sources import (
    ASSUMED_SIZES,
    NOTHING_STATED,
    MachineSources,
    StatedSource,
    excess_noise,
    with_assumed,
)


def test_scatter_beyond_what_is_stated_is_reported_with_both() -> None:
    """3 and 4 nm stated are 5, with 12 beyond they are 13; what all heights share is no scatter."""
    budget = {"probe_noise": 3e-9, "vibration": 4e-9, "scan_scatter": 12e-9, "dynamics": 1e-6}
    assert str(excess_noise(budget)).startswith(
        "heights of this scan scatter by 13.0 nm, the stated sources of single readings by 5.00 nm"
    )


@pytest.mark.parametrize("beyond", [0.0, 1e-9, 2e-9])
def test_a_little_more_scatter_is_light_and_texture(beyond: float) -> None:
    assert excess_noise({"probe_noise": 5e-9, "scan_scatter": beyond}) is None


def test_the_unit_of_the_scatter_does_not_matter() -> None:
    for size in (1e-12, 1e-9, 1e-3):
        assert excess_noise({"probe_noise": size, "scan_scatter": size}) is not None
        assert excess_noise({"probe_noise": size, "scan_scatter": 0.3 * size}) is None


def test_where_nothing_is_stated_nothing_is_exceeded() -> None:
    assert excess_noise({"scan_scatter": 1e-6}) is None
    assert excess_noise({}) is None


def test_what_one_scan_cannot_show_is_assumed_as_the_adjustment_assumes_it() -> None:
    extent = Ranges(
        speeds=(3.0,), speed=3.0, duration=100.0, motion=1e-4, distance=1e-5, half_range=1e-5,
        radius=1e-2, slide=(0.0, 1e-2), lift=(0.0, 1e-4), clampings=(0,),
        durations=(100.0,), feeds=(1e-4,),
    )  # fmt: skip
    defaults = {f.name: f.default for f in families_of(extent, ()) if f.name in ASSUMED_SIZES}
    assert defaults == ASSUMED_SIZES
    assert {s.source: s.value for s in with_assumed(NOTHING_STATED).stated} == ASSUMED_SIZES


def test_what_is_stated_is_not_assumed() -> None:
    said = StatedSource(source="lag_change", value=1e-6, reason="two step tests")
    found = with_assumed(MachineSources((said,))).of("lag_change")
    assert found == (said,)
