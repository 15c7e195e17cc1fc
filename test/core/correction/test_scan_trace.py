"""Points that stand for a whole scan: the same however it came, of any length, restarted or not."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from omsm_ros.core.correction.systematic import ScanPoints, ScanTrace
from omsm_ros.core.kinematics.kinematics import WorkpiecePoints
from omsm_ros.core.streams.blocks import FloatArray

COUNT, PERIOD = 500, 1e-3
TIME = 40.0 + PERIOD * np.arange(COUNT)
NAMES = ("x", "y", "height", "z_rate", "b", "c", "distance")
COLUMNS = {name: np.random.default_rng(k).normal(size=COUNT) for k, name in enumerate(NAMES)}
# H(z), its rate, and its change by two directions of the covariance.
MOTION = np.random.default_rng(9).normal(size=(4, COUNT))
MOTION[1] = COLUMNS["z_rate"]


def where(part: slice) -> WorkpiecePoints:
    return WorkpiecePoints(*(COLUMNS[name][part] for name in ("x", "y", "height")))


def added(trace: ScanTrace, part: slice, session: int = 1, late: float = 0.0) -> ScanPoints:
    return trace.add(
        session, TIME[part] + late, where(part), (COLUMNS["b"][part], COLUMNS["c"][part]),
        MOTION[:, part], COLUMNS["distance"][part],
    )  # fmt: skip


def whole(most: int = COUNT) -> ScanTrace:
    trace = ScanTrace(most)
    trace.undetected = np.array([False, True])
    added(trace, slice(None))
    return trace


def column(points: ScanPoints, name: str) -> FloatArray:
    return np.asarray(getattr(points, name))


def test_all_is_kept_where_there_is_room_counted_from_the_first_point() -> None:
    trace = whole()
    points = trace.points()
    assert (trace.seen, trace.every, len(points)) == (COUNT, 1, COUNT)
    np.testing.assert_allclose(points.time, TIME - TIME[0], atol=1e-12)
    np.testing.assert_allclose(points.z, MOTION[0] - MOTION[0, 0], atol=1e-15)
    for name in NAMES:
        assert np.array_equal(column(points, name), COLUMNS[name])
    assert np.array_equal(points.dynamics, MOTION[2:])
    assert points.undetected.tolist() == [False, True]


@pytest.mark.parametrize(("most", "every"), [(500, 1), (499, 2), (250, 2), (249, 4), (16, 32)])
def test_of_a_longer_scan_every_so_many_th_point_is_kept(most: int, every: int) -> None:
    trace = whole(most)
    points = trace.points()
    assert trace.every == every
    assert len(points) == -(-COUNT // every) <= most
    np.testing.assert_allclose(points.time, (TIME - TIME[0])[::every], atol=1e-12)
    assert np.array_equal(points.dynamics, MOTION[2:, ::every])


@settings(max_examples=25)
@given(cuts=st.lists(st.integers(0, COUNT), max_size=8), most=st.sampled_from([7, 100, COUNT]))
def test_a_scan_in_any_pieces_leaves_the_same_points(cuts: list[int], most: int) -> None:
    trace = ScanTrace(most)
    trace.undetected = np.array([False, True])
    seen = [added(trace, slice(begin, end)) for begin, end in pairwise([0, *sorted(cuts), COUNT])]
    expected, found = whole(most).points(), trace.points()
    for name in ("time", "z", *NAMES, "dynamics"):
        assert np.array_equal(column(found, name), column(expected, name)), name
    # Each call returns all points of its own piece.
    assert sum(map(len, seen)) == trace.seen == COUNT
    together = np.concatenate([piece.z for piece in seen])
    assert np.array_equal(together, whole().points().z)


def test_a_restarted_counter_goes_on_where_it_was() -> None:
    """The second half comes with times of its own, from 0 on; nothing is known of the pause."""
    trace = ScanTrace()
    half = slice(0, COUNT // 2), slice(COUNT // 2, None)
    added(trace, half[0])
    added(trace, half[1], session=2, late=-TIME[COUNT // 2])
    time = trace.points().time
    assert time[COUNT // 2] == pytest.approx(time[COUNT // 2 - 1], abs=1e-12)
    assert time[-1] == pytest.approx(PERIOD * (COUNT - 2), rel=1e-9)
    assert np.all(np.diff(time) >= 0)
    # Z still counts from the first point of all.
    assert trace.points().z[-1] == pytest.approx(MOTION[0, -1] - MOTION[0, 0])


def test_of_nothing_there_is_nothing() -> None:
    trace = ScanTrace()
    added(trace, slice(0, 0))
    assert (trace.seen, len(trace.points())) == (0, 0)
    added(trace, slice(None))
    assert trace.points().time[0] == 0.0
