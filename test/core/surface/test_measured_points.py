"""Points without a position, and exact duplicates."""

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from omsm_ros.core.surface.measured_points import MeasuredPoints, measured, without_duplicates
from omsm_ros.errors import DataError


def test_places_that_are_no_numbers_are_missing_like_heights():
    """Organised clouds write all three as NaN where nothing was seen."""
    x = np.array([0.0, np.nan, 2e-3, 3e-3])
    height = np.array([1e-6, np.nan, np.nan, 2e-6])
    found = measured(x, np.array([0.0, 1e-3, 2e-3, np.nan]), height)
    assert (len(found), found.missing) == (1, 3)


@pytest.mark.filterwarnings("error")
def test_a_signalling_nan_of_single_precision_is_a_height_that_is_missing():
    """Damaged files hold them, and a warning of NumPy is no line that a user can use."""
    height = np.array([0x3F800000, 0x7F800001], np.uint32).view(np.float32)
    found = measured(np.zeros(2), np.arange(2.0), height)
    assert (len(found), found.missing) == (1, 1)


def test_points_that_stand_there_again_count_once_and_a_note_says_so():
    rng = np.random.default_rng(1)
    x, y, height = rng.normal(size=(3, 500)) * 1e-3
    twice = [np.concatenate([v, v[::-1], v[:7]]) for v in (x, y, height)]
    found = without_duplicates(measured(*twice))
    np.testing.assert_array_equal(found.x, x)
    np.testing.assert_array_equal(found.height, height)
    assert found.notes == ("507 points are exact duplicates of others: left out",)
    # One place that was measured twice is two measurements.
    assert len(measured(x, y, height).notes) == 0
    assert (
        len(measured(*(np.append(v, v[0] + d) for v, d in ((x, 0), (y, 0), (height, 1e-12)))))
        == 501
    )


def points(count=6, **columns):
    row = np.arange(float(count))
    return MeasuredPoints(**{"x": row, "y": 10 + row, "height": 1e-6 * row} | columns)


@pytest.mark.parametrize("place", [np.array([4, 0, 2]), np.arange(6) % 2 == 0])
def test_a_part_keeps_what_belongs_to_each_point(place):
    whole = points(
        uncertainty=1e-9 * np.arange(6.0), sample=np.arange(100, 106), missing=3, notes=("seen",)
    )
    part = whole.part(place)
    assert len(part) == 3
    for name in ("x", "y", "height", "uncertainty", "sample"):
        np.testing.assert_array_equal(getattr(part, name), getattr(whole, name)[place])
    assert (part.missing, part.notes) == (3, ("seen",))
    bare = points().part(place)
    assert bare.uncertainty is None
    assert bare.sample is None


def test_what_is_known_of_a_point_goes_with_it_when_others_are_left_out():
    height = np.array([1e-6, np.nan, 3e-6, -np.inf, 5e-6])
    x = np.arange(5.0)
    found = measured(x, -x, height, np.arange(5) * 1e-9, ("as read",), sample=np.arange(5) * 7.0)
    np.testing.assert_array_equal(found.x, [0, 2, 4])
    np.testing.assert_array_equal(found.y, [0, -2, -4])
    np.testing.assert_array_equal(found.uncertainty, [0, 2e-9, 4e-9])
    np.testing.assert_array_equal(found.sample, [0, 14, 28])
    assert found.sample.dtype == np.int64
    assert (found.missing, found.notes) == (2, ("as read",))


def test_whole_numbers_are_heights_too():
    found = measured(*([0, 1, 2] for _ in range(3)))
    assert found.height.dtype == np.float64
    assert found.sample is None
    assert found.uncertainty is None


@pytest.mark.parametrize(
    ("columns", "reported"),
    [
        ({"sample": np.array([0.0, 1.0, 2.0, 3.0, 4.0, -1.0])}, r"sample\[5\] is -1"),
        ({"uncertainty": np.full(6, -1e-9)}, r"uncertainty\[0\] is -1e-09 m"),
        ({"y": np.array([0, 0, 200.0, 0, 0, 0])}, r"y\[2\] is 200.0 m.*metres"),
        ({"sample": np.arange(5)}, r"'sample': \(5,\)"),
        ({n: np.zeros((2, 3)) for n in ("x", "y", "height")}, "one row of one length"),
    ],
)
def test_what_no_instrument_delivers_is_refused_by_name_and_place(columns, reported):
    with pytest.raises(DataError, match=reported):
        points(**columns)


def test_a_place_where_all_is_missing_is_no_surface():
    nothing = np.full(4, np.nan)
    with pytest.raises(DataError, match="without points"):
        measured(np.zeros(4), np.zeros(4), nothing)


@pytest.mark.parametrize("name", ["x", "y", "height"])
def test_one_bit_in_one_coordinate_makes_another_point(name):
    columns = {n: np.array([v, v]) for n, v in (("x", 0.1), ("y", -0.2), ("height", 3e-6))}
    assert len(without_duplicates(MeasuredPoints(**columns))) == 1
    columns[name][1] = np.nextafter(columns[name][1], 1.0)
    assert len(without_duplicates(MeasuredPoints(**columns))) == 2


def test_exchanged_coordinates_are_another_point():
    """Each of the six orders of three numbers stands for itself."""
    orders = np.array(list(permutations((1e-3, 2e-3, 3e-3))))
    assert (
        len(without_duplicates(MeasuredPoints(x=orders[:, 0], y=orders[:, 1], height=orders[:, 2])))
        == 6
    )


def test_the_first_of_equal_points_stays_with_its_own_order_and_uncertainty():
    twice = points(
        4,
        x=np.array([2.0, 1.0, 2.0, 1.0]),
        y=np.zeros(4),
        height=np.array([5e-6, 4e-6, 5e-6, 7e-6]),
        uncertainty=np.array([1e-9, 2e-9, 3e-9, 4e-9]),
        sample=np.array([10, 11, 12, 13]),
        notes=("seen",),
    )
    once = without_duplicates(twice)
    assert once.sample.tolist() == [10, 11, 13]
    assert once.uncertainty.tolist() == [1e-9, 2e-9, 4e-9]
    assert once.notes[0] == "seen"
    assert once.notes[1].startswith("1 point")


@given(st.lists(st.integers(0, 3), min_size=1, max_size=40))
@settings(max_examples=30)
def test_as_many_points_stay_as_a_set_holds(numbers):
    values = np.array(numbers, float)
    once = without_duplicates(MeasuredPoints(x=values, y=-values, height=1e-6 * values))
    assert once.x.tolist() == list(dict.fromkeys(values.tolist()))
