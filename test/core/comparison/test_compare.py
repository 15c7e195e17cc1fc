"""Two measurements of one part agree when they should, and differ when they should."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import RectBivariateSpline
from soaked import soaked

from omsm_ros.core.comparison.compare import (
    AGREE,
    CANNOT_TELL,
    DIFFER,
    compare_measurements_of_part,
)
from omsm_ros.core.comparison.matching import SEATED
from omsm_ros.core.comparison.stated_errors import ESTIMATED, ComparedMeasurement
from omsm_ros.core.correction.systematic import ScanFields
from omsm_ros.core.surface.measured_points import MeasuredPoints
from omsm_ros.errors import ConfigurationError, DataError

from .parts import RADIUS, astigmatism, form, mapped, scan

WALK = 2e-9
"""Of the drift, in metres per root second: some 20 nm at the end of a scan."""


def pair(seed, added=None, **known):
    first = scan(seed, feed=1.5e-4, rpm=30, walk=WALK, common=2e-9, **known)
    second = scan(seed + 50, feed=2e-4, rpm=45, walk=WALK, common=2e-9, added=added, **known)
    return first, second


@pytest.mark.parametrize("seed", [5, *soaked(6)])
def test_two_scans_with_drift_agree_and_with_astigmatism_differ(seed):
    first, second = pair(seed)
    found = compare_measurements_of_part(first, second)
    assert found.verdict == AGREE
    assert abs(found.agreement.largest.e_n) < 1
    assert all(abs(n.e_n) < 1 for n in found.agreement.figures.values())
    assert found.agreement.within > 0.9
    # It says what it rests on.
    assert "no drift is stated" in str(found.reservations[0])
    assert {side.drift_from for side in found.sides} == {ESTIMATED}

    other = compare_measurements_of_part(first, pair(seed, astigmatism)[1])
    assert other.verdict == DIFFER
    largest = other.agreement.largest
    assert (largest.n, largest.m) == (2, 2)
    assert abs(largest.e_n) > 1
    size = largest.difference * (RADIUS / other.agreement.aperture[0]) ** 2
    assert size == pytest.approx(-20e-9, abs=3 * largest.uncertainty)


@pytest.mark.soak
def test_the_size_of_the_drift_is_found():
    """Within the factor that one realisation of a random walk leaves open."""
    sizes = []
    for seed in range(3):
        found = compare_measurements_of_part(*pair(seed))
        sizes.append(found.sides[0].drift / (WALK * np.sqrt(67)))
    assert 0.4 < float(np.exp(np.mean(np.log(sizes)))) < 2.0


def test_drift_that_is_stated_and_too_small_is_a_difference():
    first, second = pair(3, drift=0.2e-9)
    found = compare_measurements_of_part(first, second)
    assert found.verdict == DIFFER
    assert found.reservations == ()


def test_stated_drift_widens_what_a_spiral_turns_it_into_and_nothing_else():
    calm, windy = (
        compare_measurements_of_part(*pair(0, drift=size)).agreement for size in (1e-12, 20e-9)
    )
    spread = [{(t.n, t.m): t.uncertainty for t in found.terms} for found in (calm, windy)]
    assert spread[1][2, 0] > 5 * spread[0][2, 0]
    assert spread[1][2, 2] == pytest.approx(spread[0][2, 2], rel=0.1)


@pytest.mark.soak
def test_stated_uncertainties_hold_over_repetitions():
    """Noise alone: the terms of the difference scatter as stated, and the probability is even."""
    scores, probabilities = [], []
    for seed in range(8):
        first = scan(seed, common=0.0, drift=0.0)
        second = scan(seed + 100, feed=2e-4, rpm=45, common=0.0, drift=0.0)
        found = compare_measurements_of_part(first, second, spacing=0.35e-3).agreement
        scores += [term.difference / term.uncertainty for term in found.terms]
        probabilities.append(found.probability)
    assert np.sqrt(np.mean(np.square(scores))) == pytest.approx(1, abs=0.2)
    assert 0.2 < np.mean(probabilities) < 0.8


@pytest.mark.soak
def test_form_like_errors_scatter_as_stated():
    """An error with the stated size and correlation length, drawn anew each time."""
    length, size, scores = 2.5e-3, 5e-9, []
    at = np.linspace(-1.2 * RADIUS, 1.2 * RADIUS, 25)
    nodes = np.stack([part.ravel() for part in np.meshgrid(at, at)], axis=1)
    distance = np.sum((nodes[:, None] - nodes[None]) ** 2, axis=2)
    values, vectors = np.linalg.eigh(np.exp(-distance / (2 * length**2)))
    root = vectors * np.sqrt(np.maximum(values, 0))
    for seed in range(8):
        error = (root @ np.random.default_rng(seed).normal(size=len(nodes))).reshape(25, 25)
        spline = RectBivariateSpline(at, at, size * error.T)
        second = mapped(common=size, added=spline.ev, side=51)
        found = compare_measurements_of_part(
            mapped(common=0.0, seed=1, side=51), second, length=length
        )
        scores += [t.difference / t.uncertainty for t in found.agreement.terms if t.n < 5]
    assert np.sqrt(np.mean(np.square(scores))) == pytest.approx(1, abs=0.25)


def test_without_an_uncertainty_nothing_is_evaluated():
    found = compare_measurements_of_part(scan(0, stated=3e-9, name="ours"), mapped())
    assert found.verdict == CANNOT_TELL
    assert [*map(str, found.reasons)] == [
        "map has no uncertainty; state it with 'uncertainty' 5e-9"
    ]
    assert found.agreement is None
    assert found.sides[1].sources is None


@pytest.mark.soak
def test_an_uncertainty_larger_than_the_part_tells_nothing():
    found = compare_measurements_of_part(scan(0, common=5e-6, drift=0.0), mapped(common=5e-6))
    assert found.verdict == CANNOT_TELL
    assert "exceeds all that is compared" in str(found.reasons[0])


def test_an_uncertainty_in_a_wrong_unit_is_larger_than_the_part():
    """Five metres for five nanometres: terms beside them have no covariance but rounding."""
    found = compare_measurements_of_part(mapped(common=5.0), mapped(common=5.0, seed=3))
    assert found.verdict == CANNOT_TELL
    assert "exceeds all that is compared" in str(found.reasons[0])


@pytest.mark.soak
@pytest.mark.parametrize("dof", ["x", "clocking"])
def test_a_shift_alone_is_fitted(dof):
    moved = mapped(**({"shift": (80e-6, 0.0)} if dof == "x" else {"turn": 7e-3}), common=1e-9)
    found = compare_measurements_of_part(mapped(common=1e-9), moved, (dof,))
    size = {"x": -80e-6, "clocking": -7e-3}[dof]
    assert found.matched.moved[dof] == pytest.approx(size, abs=0.1 * abs(size))


def test_a_scratch_that_no_zernike_term_sees_is_found():
    def scratch(x, y):
        return 60e-9 * np.exp(-((x - 1e-3) ** 2 + (y + 2e-3) ** 2) / (2 * (0.25e-3) ** 2))

    found = compare_measurements_of_part(
        scan(0, common=1e-9, drift=0.0), mapped(common=1e-9, added=scratch)
    )
    assert found.verdict == DIFFER
    place = next(str(reason) for reason in found.reasons if "at x" in str(reason))
    assert "x = 1.0" in place or "x = 9" in place
    assert found.agreement.at == pytest.approx((1e-3, -2e-3), abs=0.2e-3)


# Errors in fields.


def turned_field(scan_of, size):
    """A source whose field is the change of the form with an angle, over every fifth point."""
    points = scan_of.points
    step = 1e-6
    x, y = points.x[::5], points.y[::5]
    field = (form(x - step * y, y + step * x) - form(x, y)) / step
    return ScanFields(("probe_latency",), size * field[np.newaxis], 5, (), ("probe_latency",))


def test_each_direction_of_a_calibration_is_one_error_in_both():
    first, second = scan(1, drift=0.0), scan(2, feed=2e-4, rpm=45, drift=0.0)

    def known(m, *turns):
        rows = np.concatenate([turned_field(m, size).fields for size in turns])
        names = ("undetected_model_error",) * len(turns)
        return ScanFields(names, rows, 5, (), ("undetected_model_error",))

    def explained(*of_both):
        sides = [
            ComparedMeasurement(
                name=m.name, points=m.points, fields=f, drift=0.0, calibration="one"
            )
            for m, f in zip((first, second), of_both, strict=True)
        ]
        found = compare_measurements_of_part(*sides)
        return next(t.uncertainty for t in found.agreement.terms if (t.n, t.m) == (2, 2))

    broad = explained(known(first, 2e-3, 3e-3), known(second, 2e-3))
    cancelled = explained(known(first, 2e-3, 3e-3), known(second, 2e-3, 3e-3))
    turned = explained(known(first, 2e-3, 3e-3), known(second, -2e-3, -3e-3))
    assert cancelled < 0.1 * broad
    # Common errors of opposite sign add; independent errors would add in squares.
    assert turned == pytest.approx(
        broad * 2 * np.hypot(2, 3) / np.sqrt(2**2 + 3**2 + 2**2), rel=0.05
    )


@pytest.mark.soak
def test_an_error_that_both_share_is_subtracted():
    first, second = scan(1, drift=0.0), scan(2, feed=2e-4, rpm=45, drift=0.0)
    size = 2e-3
    spread = {}
    for ids in (("one", "one"), ("one", "two"), ("", "")):
        sides = [
            ComparedMeasurement(
                name=m.name, points=m.points, fields=turned_field(m, size), drift=0.0,
                calibration=own,
            )
            for m, own in zip((first, second), ids, strict=True)
        ]  # fmt: skip
        found = compare_measurements_of_part(*sides)
        spread[ids] = {(t.n, t.m): t.uncertainty for t in found.agreement.terms}
        assert found.common == (("probe_latency",) if ids == ("one", "one") else ())
        assert found.sides[0].sources["probe_latency"] > 1e-9
    # 3 µm of u v turned by 2 mrad is 6 nm of u² − v², in each of the two.
    radius = found.agreement.aperture[0]
    expected = np.sqrt(2) * 3e-6 * size * (radius / RADIUS) ** 2
    assert spread["one", "two"][2, 2] == pytest.approx(expected, rel=0.05)
    assert spread["one", "one"][2, 2] < 0.1 * expected
    assert spread["", ""] == spread["one", "two"]


# Matching.


def test_piston_tip_tilt_and_power_are_taken_off_and_reported():
    def seat(x, y):
        return 4e-6 + 30e-6 * x - 20e-6 * y + 1e-3 * (x**2 + y**2)

    found = compare_measurements_of_part(
        mapped(common=1e-9), mapped(common=1e-9, added=seat, seed=3), (*SEATED, "power")
    )
    assert found.verdict == AGREE
    moved = found.matched.moved
    assert moved["piston"] == pytest.approx(-4e-6, abs=1e-9)
    # As a pose has it: tip raises the side of +y, tilt lowers that of +x, power is a curvature.
    assert moved["tip"] == pytest.approx(20e-6, abs=1e-7)
    assert moved["tilt"] == pytest.approx(30e-6, abs=1e-7)
    assert moved["power"] == pytest.approx(-2e-3, abs=2e-4)
    assert (2, 0) not in {(t.n, t.m) for t in found.agreement.terms}


def test_shift_and_clocking_are_found():
    moved = mapped(shift=(80e-6, -50e-6), turn=7e-3, common=1e-9, seed=4)
    here = mapped(common=1e-9)
    assert compare_measurements_of_part(here, moved).verdict == DIFFER
    found = compare_measurements_of_part(here, moved, (*SEATED, "x", "y", "clocking"))
    assert found.verdict == AGREE
    assert "x, y, clocking were fitted" in str(found.reservations[0])
    # The second goes back: turned about the origin, then shifted.
    cos, sin = np.cos(7e-3), np.sin(7e-3)
    assert found.matched.moved["clocking"] == pytest.approx(-7e-3, abs=2e-4)
    assert found.matched.moved["x"] == pytest.approx(-(80e-6 * cos - 50e-6 * sin), abs=3e-6)
    assert found.matched.moved["y"] == pytest.approx(80e-6 * sin + 50e-6 * cos, abs=3e-6)


def test_a_turn_that_a_surface_of_revolution_does_not_show_is_refused():
    at = np.linspace(-RADIUS, RADIUS, 61)
    x, y = (part.ravel() for part in np.meshgrid(at, at))
    bowl = MeasuredPoints(x=x, y=y, height=(x**2 + y**2) / 0.2)
    sides = [ComparedMeasurement(name=n, points=bowl, common=1e-9) for n in "ab"]
    found = compare_measurements_of_part(*sides, dofs=(*SEATED, "x", "y", "clocking"))
    assert set(found.matched.refused) == {"x", "y", "clocking"}
    assert any("clocking was not fitted" in str(text) for text in found.reservations)


@pytest.mark.soak
def test_slopes_that_are_noise_alone_tell_no_turn():
    """With a nanometre of noise each slope has a little of its own, which no fit settles on."""
    at, random = np.linspace(-RADIUS, RADIUS, 81), np.random.default_rng(2)
    x, y = (part.ravel() for part in np.meshgrid(at, at))
    sides = [
        ComparedMeasurement(name=n, common=1e-9, points=MeasuredPoints(
            x=x, y=y, height=(x**2 + y**2) / 0.2 + random.normal(0, 10e-9, len(x))))
        for n in "ab"
    ]  # fmt: skip
    found = compare_measurements_of_part(*sides, dofs=(*SEATED, "x", "y", "clocking"))
    assert "clocking" in found.matched.refused
    assert found.verdict != DIFFER


def test_steep_heights_that_were_compared_whole_are_reported():
    """A lateral shift changes a fourth-order surface by slope times shift, a plane by a tilt."""
    at = np.linspace(-RADIUS, RADIUS, 61)
    x, y = (part.ravel() for part in np.meshgrid(at, at))
    steep = MeasuredPoints(x=x, y=y, height=1e-3 * (x / RADIUS) ** 4)
    found = compare_measurements_of_part(
        *(ComparedMeasurement(name=n, points=steep, common=1e-9) for n in "ab")
    )
    reported = [str(text) for text in found.reservations if "whole heights" in str(text)]
    assert "SURFACE.yaml" in reported[0]
    flat = MeasuredPoints(x=x, y=y, height=1e-9 * (x / RADIUS) ** 4)
    found = compare_measurements_of_part(
        *(ComparedMeasurement(name=n, points=flat, common=1e-9) for n in "ab")
    )
    assert not any("whole heights" in str(text) for text in found.reservations)


def test_what_does_not_lie_together_is_refused():
    first = mapped(common=1e-9)
    away = MeasuredPoints(x=first.points.x + 1.0, y=first.points.y, height=first.points.height)
    with pytest.raises(DataError, match="do not overlap; do they lie in one frame"):
        compare_measurements_of_part(first, ComparedMeasurement(name="b", points=away, common=1e-9))
    apart = MeasuredPoints(
        x=first.points.x + 1.88 * RADIUS, y=first.points.y, height=first.points.height
    )
    with pytest.raises(DataError, match=r"share \d+ places"):
        compare_measurements_of_part(
            first, ComparedMeasurement(name="b", points=apart, common=1e-9)
        )


def test_a_small_overlap_cannot_tell():
    first = mapped(common=1e-9)
    shifted = MeasuredPoints(
        x=first.points.x + 1.2 * RADIUS, y=first.points.y, height=first.points.height
    )
    found = compare_measurements_of_part(
        first, ComparedMeasurement(name="b", points=shifted, common=1e-9)
    )
    assert found.verdict == CANNOT_TELL
    assert "% of the smaller area" in str(found.reasons[0])


def test_an_unknown_freedom_is_refused():
    with pytest.raises(ConfigurationError, match="pose parameter 'z' is unknown"):
        compare_measurements_of_part(mapped(), mapped(), ("piston", "z"))


def test_heights_of_so_few_digits_that_they_do_not_scatter_are_compared():
    first, second = mapped(stated=1e-9), mapped(stated=1e-9, seed=3)
    coarse = replace(second.points, height=np.round(second.points.height, 4))
    found = compare_measurements_of_part(first, replace(second, points=coarse))
    assert found.verdict == DIFFER
