"""Few fields that stand for many, at any point of the scan."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from omsm_ros.core.correction.scan_fields import resolves_turns, scan_fields
from omsm_ros.core.correction.source_kinds import source_of
from omsm_ros.core.correction.systematic import DECLARED, standard_fields

from .systematic_scan import spiral_points

SOURCES = [
    source_of("tilt", 1e-5, DECLARED, "r", {}),
    source_of("drift_walk", 1e-9, DECLARED, "r", {}),
    source_of("spindle_axial", 1e-8, DECLARED, "r", {"per_turn": 2}),
    source_of("encoder_scale", 1e-12, DECLARED, "r", {}),
]


def test_any_linear_figure_has_the_same_uncertainty() -> None:
    points = spiral_points()
    every = standard_fields(SOURCES, points)
    few = scan_fields(every, 1)
    assert len(few.names) < sum(map(len, every.values()))
    # Too small to count, and said to be by not being there.
    assert "encoder_scale" not in few.names
    random = np.random.default_rng(3)
    for _ in range(20):
        weights = np.polynomial.polynomial.polyval2d(
            points.x / 0.0127, points.y / 0.0127, random.normal(size=(4, 4))
        )
        weights -= weights.mean()
        expected = sum(np.sum((fields @ weights) ** 2) for fields in every.values())
        assert np.sum((few.fields @ weights) ** 2) == pytest.approx(expected, rel=0.03)


def test_between_the_points_the_fields_are_those_of_the_points_there() -> None:
    whole = standard_fields(SOURCES, spiral_points(6001))
    some = {name: fields[:, ::6] for name, fields in whole.items()}
    all_, few = scan_fields(whole, 1), scan_fields(some, 6)
    found = few.at(0, 6001)
    pieces = np.concatenate([few.at(0, 1000), few.at(1000, 5001)], axis=1)
    assert np.array_equal(found, pieces)
    for name in ("tilt", "spindle_axial"):
        squares = [
            np.sum(fields[[n == name for n in names]] ** 2, axis=0)
            for names, fields in ((all_.names, all_.fields), (few.names, found))
        ]
        assert np.max(abs(squares[1] - squares[0])) < 0.03 * np.max(squares[0])
    # Beyond the last one nothing is extrapolated.
    assert np.array_equal(few.at(6000, 5)[:, 0], few.at(6000, 5)[:, 4])


def test_directions_of_the_calibration_stay_what_they_are() -> None:
    """In another scan with it they are the same errors; principal ones would be mixtures."""
    rng = np.random.default_rng(3)
    of_one, of_other = (rng.normal(size=(3, 200)) * [[1e-9], [3e-9], [1e-14]] for _ in range(2))
    slow, fast = (
        scan_fields({"tilt": rows[:2], "could_hide": rows}, 7) for rows in (of_one, of_other)
    )
    for found, rows in ((slow, of_one), (fast, of_other)):
        assert found.aligned == ("could_hide",)
        own = found.fields[[name == "could_hide" for name in found.names]]
        np.testing.assert_array_equal(own, rows)
        assert found.names.count("tilt") == 2
        assert not any(np.allclose(row, rows[0], atol=0) for row in found.fields[:2])


def test_without_sources_there_are_no_fields() -> None:
    assert scan_fields({}, 4).at(0, 7).shape == (0, 7)


def test_turns_that_the_points_leap_over_are_seen() -> None:
    points = spiral_points(3000)
    assert resolves_turns(points)
    assert resolves_turns(replace(points, c=points.c % (2 * np.pi)))
    assert not resolves_turns(spiral_points(150))
