"""Determined and held pose parameters, from products of columns written by hand."""

from __future__ import annotations

import numpy as np
import pytest

from omsm_ros.core.registration.placement import POSE_PARAMETERS
from omsm_ros.core.registration.pose_parameters import (
    AUTO,
    RIGID,
    PoseParameters,
    determined_dofs,
    parse_dofs,
    typical_range,
    weakest_dof,
)
from omsm_ros.errors import ConfigurationError, DataError

RNG = np.random.default_rng(3)
POINTS = 500
X, Y = RNG.uniform(-1e-2, 1e-2, (2, POINTS))


def gram_of(**columns):
    """Return the products of the columns of all pose parameters, zero for those without one."""
    rows = np.array([columns.get(name, np.zeros(POINTS)) for name in POSE_PARAMETERS])
    return rows @ rows.T


PLANE = {"piston": np.ones(POINTS), "tip": Y, "tilt": -X}


def test_of_a_plane_its_three_moves_are_determined():
    found = determined_dofs([AUTO], gram_of(**PLANE), POINTS)
    assert found.fitted == ("piston", "tip", "tilt")
    assert found.held == {}
    assert set(found.refused) == {"x", "y", "clocking"}
    assert str(found.refused["x"]) == "this move does not change the surface"


def test_a_freedom_that_does_what_others_do_together_is_refused_with_their_names():
    both = gram_of(**PLANE, x=0.3 * X + 0.4 * Y)
    found = determined_dofs([AUTO], both, POINTS)
    assert str(found.refused["x"]) == "on this surface it has the effect of tip and tilt"
    one = determined_dofs([AUTO], gram_of(**PLANE, x=-0.3 * X), POINTS)
    assert str(one.refused["x"]) == "on this surface it has the effect of tilt"


@pytest.mark.parametrize(("form", "fitted"), [(1.2e-9, True), (0.8e-9, False)])
def test_a_freedom_is_determined_by_a_nanometre_of_form_of_a_part_put_on_by_hand(form, fitted):
    """Moved by its millimetre it leaves so much beside the others, rms."""
    own = X * Y
    own = (
        own
        - np.stack(list(PLANE.values()), axis=1)
        @ np.linalg.lstsq(np.stack(list(PLANE.values()), axis=1), own, rcond=None)[0]
    )
    column = form / typical_range("x") * own / np.sqrt(np.mean(own**2))
    found = determined_dofs([AUTO], gram_of(**PLANE, x=column + 0.1 * X), POINTS)
    assert ("x" in found.fitted) == fitted


def test_what_was_asked_for_by_name_and_is_not_determined_is_an_error():
    gram = gram_of(**PLANE)
    assert determined_dofs(["tip", "piston"], gram, POINTS).fitted == ("piston", "tip")
    with pytest.raises(DataError, match=r"clocking cannot be fitted: .* leave it out of 'fit'"):
        determined_dofs([AUTO, "clocking"], gram, POINTS)
    with pytest.raises(DataError, match="y cannot be fitted"):
        determined_dofs(["piston", "y"], gram, POINTS)


def test_auto_takes_no_power_unless_it_is_named():
    bowl = {**PLANE, "power": (X**2 + Y**2) / 2}
    assert determined_dofs([AUTO], gram_of(**bowl), POINTS).fitted == ("piston", "tip", "tilt")
    named = determined_dofs([AUTO, "power"], gram_of(**bowl), POINTS)
    assert named.fitted == ("piston", "tip", "tilt", "power")


def test_twice_as_many_points_of_the_same_kind_determine_the_same():
    gram = gram_of(**PLANE, x=X * Y, y=1e-3 * X)
    one, two = determined_dofs([AUTO], gram, POINTS), determined_dofs([AUTO], 2 * gram, 2 * POINTS)
    assert one == two


# Names.


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("auto", ("auto",)),
        (" piston , tip ", ("piston", "tip")),
        ("auto,power", ("auto", "power")),
        ("x,,y", ("x", "y")),
    ],
)
def test_names_are_read_with_or_without_spaces(text, names):
    assert parse_dofs(text) == names


@pytest.mark.parametrize(
    ("text", "reported"),
    [
        ("roll", "'roll' is unknown, expected a list of .*clocking"),
        ("x,y,x", "'x' stands twice"),
        (" , ", "no pose parameter is named"),
        ("X", "'X' is unknown"),
    ],
)
def test_other_names_are_reported_with_those_there_are(text, reported):
    with pytest.raises(ConfigurationError, match=reported):
        parse_dofs(text)


def test_a_part_put_on_by_hand_is_off_by_a_millimetre_and_a_degree():
    assert [typical_range(name) for name in POSE_PARAMETERS] == pytest.approx(
        [1e-3, np.radians(1), np.radians(1), 1e-3, 1e-3, np.radians(1), 1.0]
    )


def test_a_freedom_that_is_held_is_no_longer_fitted():
    found = PoseParameters(("piston", "x", "y"), {"clocking": "no"}, {"tip": "weak"}).without(
        "x", "why"
    )
    assert found.fitted == ("piston", "y")
    assert found.held == {"tip": "weak", "x": "why"}
    assert found.refused == {"clocking": "no"}


# Held.


def weak(values, spreads, effects, names=("piston", "x", "y")):
    """Return the weakest of independent pose parameters with these effects."""
    dofs = PoseParameters(tuple(names), {}, {})
    return weakest_dof(
        dofs, (), np.array(values), np.diag(np.square(spreads)), np.diag(np.square(effects))
    )


def test_the_odds_of_a_move_are_those_of_its_densities():
    """Known to u of a millimetre: u √(20 …) beside its place it is moved, at 20 to 1.

    Dickey and Savage: (v/u)²/2 − ln(1 mm/u) = ln 20.
    """
    spread = 1e-5
    edge = spread * np.sqrt(2 * (np.log(20) + np.log(1e-3 / spread)))
    effect = (1e-3, 1e-3, 1e-3)
    assert weak((0, 1.01 * edge, 1.0), (1e-9, spread, 1e-9), effect) is None
    name, why = weak((0, 0.99 * edge, 1.0), (1e-9, spread, 1e-9), effect)
    assert name == "x"
    assert "39 µm ± 10 µm (k = 1), an effect of 10 nm rms" in str(why)


def test_the_least_likely_move_is_held_first():
    name, _ = weak((0, 2e-5, 1e-5), (1e-9, 1e-5, 1e-5), (1e-3, 1e-3, 1e-3))
    assert name == "y"
    name, _ = weak((0, -1e-5, 2e-5), (1e-9, 1e-5, 1e-5), (1e-3, 1e-3, 1e-3))
    assert name == "x"


def test_pistons_and_tilts_are_never_held_nor_what_costs_no_form():
    names = ("piston", "tip", "tilt")
    assert weak((0, 0, 0), (1e-4, 1e-3, 1e-3), (1.0, 1.0, 1.0), names) is None
    # Known to 10 µm, which is less than a nanometre of form.
    assert weak((0, 0, 1.0), (1e-9, 1e-5, 1e-9), (1e-3, 9e-5, 1e-3)) is None
    assert weak((0, 0, 1.0), (1e-9, 1e-5, 1e-9), (1e-3, 1.1e-4, 1e-3))[0] == "x"


def test_what_another_freedom_does_is_not_counted_as_its_own():
    """Two columns alike but for a thousandth: only that much form tells them apart."""
    gram = 1e-6 * np.array([[1.0, 1 - 5e-7], [1 - 5e-7, 1.0]])
    dofs = PoseParameters(("x", "y"), {}, {})
    covariance = np.diag([1e-10, 1e-10])
    apart = weakest_dof(dofs, (), np.zeros(2), covariance, np.diag(np.diag(gram)))
    assert apart is not None
    assert weakest_dof(dofs, (), np.zeros(2), covariance, gram) is None


def test_rigid_freedoms_are_the_six_of_a_pose():
    assert RIGID == ("piston", "tip", "tilt", "x", "y", "clocking")
