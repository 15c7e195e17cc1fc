"""Points that have no place, and points that stand there again."""

import numpy as np

from omsm_ros.core.surface.measured_points import each_once, measured


def test_places_that_are_no_numbers_are_missing_like_heights():
    """Organised clouds write all three as NaN where nothing was seen."""
    x = np.array([0.0, np.nan, 2e-3, 3e-3])
    height = np.array([1e-6, np.nan, np.nan, 2e-6])
    found = measured(x, np.array([0.0, 1e-3, 2e-3, np.nan]), height)
    assert (len(found), found.missing) == (1, 3)


def test_points_that_stand_there_again_count_once_and_a_note_says_so():
    rng = np.random.default_rng(1)
    x, y, height = rng.normal(size=(3, 500)) * 1e-3
    twice = [np.concatenate([v, v[::-1], v[:7]]) for v in (x, y, height)]
    found = each_once(measured(*twice))
    np.testing.assert_array_equal(found.x, x)
    np.testing.assert_array_equal(found.height, height)
    assert found.notes == ("507 points stand there again in every digit: left out",)
    # One place that was measured twice is two measurements.
    assert len(measured(x, y, height).notes) == 0
    assert (
        len(measured(*(np.append(v, v[0] + d) for v, d in ((x, 0), (y, 0), (height, 1e-12)))))
        == 501
    )
