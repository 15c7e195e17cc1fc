"""Few fields that stand for many, at any point of the scan."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from omsm_ros.core.correction.source_kinds import SystematicSource, standard_fields
from omsm_ros.core.correction.systematic import DECLARED, resolves_per_turn_waves, scan_fields

from .systematic_scan import spiral_points

SOURCES = [
    SystematicSource("tilt", 1e-5, DECLARED, "r", {}),
    SystematicSource("drift_walk", 1e-9, DECLARED, "r", {}),
    SystematicSource("spindle_axial", 1e-8, DECLARED, "r", {"per_turn": 2}),
    SystematicSource("encoder_scale", 1e-12, DECLARED, "r", {}),
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
        scan_fields({"tilt": rows[:2], "undetected_model_error": rows}, 7)
        for rows in (of_one, of_other)
    )
    for found, rows in ((slow, of_one), (fast, of_other)):
        assert found.aligned == ("undetected_model_error",)
        own = found.fields[[name == "undetected_model_error" for name in found.names]]
        np.testing.assert_array_equal(own, rows)
        assert found.names.count("tilt") == 2
        assert not any(np.allclose(row, rows[0], atol=0) for row in found.fields[:2])


def test_without_sources_there_are_no_fields() -> None:
    assert scan_fields({}, 4).at(0, 7).shape == (0, 7)


def test_turns_that_the_points_leap_over_are_seen() -> None:
    points = spiral_points(3000)
    assert resolves_per_turn_waves(points)
    assert resolves_per_turn_waves(replace(points, c=points.c % (2 * np.pi)))
    assert not resolves_per_turn_waves(spiral_points(150))


def waves(*sizes: float) -> np.ndarray:
    """Rows of whole waves, uncorrelated, of which each has the rms ``size``."""
    place = 2 * np.pi * np.arange(1200) / 1200
    rows = [np.sqrt(2) * size * np.sin((k + 1) * place) for k, size in enumerate(sizes)]
    return np.array(rows)


def test_only_what_counts_among_all_is_left_of_a_source() -> None:
    """One of 400 beside two of 1 and 0.2: the last has a millionth of the variance."""
    found = scan_fields({"drift": waves(400.0), "tilt": waves(1.0, 0.2)}, 1)
    assert found.names == ("drift", "tilt")
    np.testing.assert_allclose(np.abs(found.fields[1]), np.abs(waves(1.0)[0]), atol=1e-9)
    alone = scan_fields({"tilt": waves(1.0, 0.2)}, 1)
    assert alone.names == ("tilt", "tilt")


def test_a_calibration_of_which_nothing_counts_is_left_out_as_a_whole() -> None:
    small, large = {"dynamics": waves(1e-4, 1e-5)}, {"dynamics": waves(1.0, 1e-5)}
    adjacent = {"drift": waves(1.0)}
    assert scan_fields(adjacent | small, 1).aligned == ()
    assert scan_fields(adjacent | small, 1).names == ("drift",)
    # But with one that counts the others stay, in their order.
    found = scan_fields(large | adjacent, 1)
    assert found.names == ("dynamics", "dynamics", "drift")
    assert found.aligned == ("dynamics",)
    np.testing.assert_array_equal(found.fields[:2], large["dynamics"])


def test_upper_bounds_are_those_of_the_sources_that_are_left() -> None:
    every = {"probe_latency": waves(1.0), "drift": waves(2.0), "tilt": waves(1e-9)}
    found = scan_fields(every, 1, bounds=("tilt", "probe_latency", "beam"))
    assert found.bounds == ("probe_latency",)


def test_unit_sign_and_order_of_the_fields_do_not_matter() -> None:
    every = {"drift": waves(2.0, 1.0), "tilt": waves(0.5)}
    plain = scan_fields(every, 1)
    turned = scan_fields({name: -1e-9 * rows[::-1] for name, rows in every.items()}, 1)
    for name in every:
        one, other = (
            np.sum(f.fields[[n == name for n in f.names]] ** 2, axis=0) for f in (plain, turned)
        )
        np.testing.assert_allclose(other, 1e-18 * one, rtol=1e-6, atol=1e-30)


def test_between_two_points_a_field_is_a_straight_line() -> None:
    found = scan_fields({"undetected_model_error": np.array([[0.0, 4.0, 2.0]])}, 4)
    assert found.at(0, 12)[0].tolist() == [0, 1, 2, 3, 4, 3.5, 3, 2.5, 2, 2, 2, 2]
    assert found.at(3, 2)[0].tolist() == [3, 4]
    one = scan_fields({"undetected_model_error": np.array([[7.0]])}, 4)
    # A single point has no scatter, so nothing of it counts as one.
    assert one.at(0, 3).shape[1] == 3
