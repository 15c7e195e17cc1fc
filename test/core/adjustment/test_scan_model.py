"""Scans that cannot be fitted are refused with the reason."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from omsm_ros.core.adjustment.scan_model import ScanModel, ScanPlacement
from omsm_ros.core.adjustment.scan_reader import ScanColumns
from omsm_ros.errors import DataError


def spiral(points: int = 2000) -> ScanColumns:
    time = np.arange(points) * 1e-3
    zero = np.zeros(points)
    return ScanColumns(
        time=time, radius=5e-3 - 1e-3 * time, angle=6.0 * time, radial_rate=np.full(points, -1e-3),
        angular_rate=np.full(points, 6.0), height=zero, motion_rate=zero,
        motion_acceleration=zero, motion=zero,
    )  # fmt: skip


def test_a_scan_whose_pace_is_not_known_is_refused() -> None:
    good = spiral()
    turns = ScanModel([good, good], 3).turns
    assert turns == pytest.approx([2 * 6.0 / (2 * np.pi)] * 2, rel=1e-3)
    lost = np.where(np.arange(2000) == 7, np.nan, good.angular_rate)
    with pytest.raises(DataError, match="speed of C"):
        ScanModel([good, replace(good, angular_rate=lost)], 3)


def test_one_scan_says_nothing_of_what_differs() -> None:
    for scans in ([], [spiral()]):
        with pytest.raises(DataError, match=f"{len(scans)} scan, expected two or more"):
            ScanModel(scans, 3)


def test_only_the_ring_that_all_scans_share_is_used() -> None:
    """From 5 to 3 mm and from 4.5 mm on: the first half a millimetre is left out."""
    whole = spiral()
    part = replace(whole, **{n: getattr(whole, n)[500:] for n in ScanColumns.__dataclass_fields__})
    model = ScanModel([whole, replace(part, time=part.time - part.time[0])], 3)
    assert model.basis.outer == pytest.approx(4.5e-3)
    assert model.basis.inner == pytest.approx(3.001e-3)
    assert len(model) == 1500 + 1500
    assert np.bincount(model.scan).tolist() == [1500, 1500]


def test_the_centre_is_left_out_where_a_degree_is_less_than_the_points_spacing() -> None:
    inward = replace(spiral(), radius=np.linspace(5e-3, 0.0, 2000))
    model = ScanModel([inward, inward], 3)
    assert model.basis.inner == pytest.approx(0.01 * 5e-3)
    assert len(model) < 2 * 2000


def test_a_probe_goes_round_the_part_against_the_turn_of_c() -> None:
    there, back = spiral(), replace(spiral(), angular_rate=np.full(2000, -3.0))
    assert ScanModel([there, back, there], 3).speeds == [-6.0, 3.0, -6.0]


def test_each_scan_but_the_first_has_parameters_of_its_own() -> None:
    model = ScanModel([spiral()] * 3, 3)
    first, second = model.own(1), model.own(2)
    # Behind the four that all have in common; the drift of each follows its pose.
    assert (first.start, first.stop) == (4, 9)
    assert second.start - first.stop == model.size - second.stop >= 4
    assert second.stop - second.start == 5


def test_every_so_many_of_the_points_are_portioned_and_each_once() -> None:
    model = ScanModel([spiral(), spiral()], 3)
    place = ScanPlacement(0.0, np.zeros(2))
    for every in (1, 3):
        points = np.concatenate([part.points for part in model.portions(place, every)])
        assert len(np.unique(points)) == len(points) == -(-len(model) // every)


def test_before_a_surface_is_known_nothing_is_said_of_what_needs_its_slope() -> None:
    model = ScanModel([spiral(), spiral()], 3)
    place = ScanPlacement(1e-4, np.array([0.0, 1e-5]))
    parts = list(model.portions(place, 1))
    assert parts
    for part in parts:
        x, y = model.columns(part, place, None)
        assert not np.any(x[:, [3, *range(4, 7)]])
        assert np.all(y == 0.0)
