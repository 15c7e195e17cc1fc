"""Dynamics that vary along X: several calibrations are corrected with as one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from certified import certified_by

from omsm_ros.core.calibration.calibration import Calibration, with_latency
from omsm_ros.core.calibration.calibration_set import CalibrationSet, calibration_set
from omsm_ros.core.calibration.latency import declared_latency
from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
from omsm_ros.core.correction.surface_points import SurfacePoints, join_points
from omsm_ros.core.correction.uncertainty import ErrorSources
from omsm_ros.core.kinematics.trajectories import Spiral
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.streams.blocks import Account
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.errors import CalibrationError
from omsm_ros.io.calibration_file import load_calibration, save_calibration
from omsm_ros.twin.cell import Cell, Probe, Recording, blocks_of, record
from omsm_ros.twin.disturbances import Disturbances
from omsm_ros.twin.structure import StructureErrors

PER_METRE = 20.0
RIM = 12.7e-3


def at(x: float, known: Calibration) -> Calibration:
    """The calibration there: the deflection 1 - G is larger by ``PER_METRE · x``."""
    g = known.dynamics
    numerator = np.zeros(len(g.denominator))
    numerator[: len(g.numerator)] = g.numerator
    there = g.denominator - (g.denominator - numerator) * (1 + PER_METRE * x)
    p = len(there) + len(g.denominator)
    dynamics = TransferFunction(there, g.denominator, g.delay)
    return replace(known, dynamics=dynamics, covariance=np.zeros((p, p)))


@pytest.fixture(scope="module")
def scan() -> Recording:
    """Without noise, fast, over a machine that is softer at the rim."""
    softer = Disturbances(structure=StructureErrors(compliance_per_m_of_x=PER_METRE))
    cell = Cell(probe=Probe(noise=0.0, resolution=0.0), encoder_noise=0.0, disturbances=softer)
    return record(cell, Spiral(PAPER_MIRROR, RIM, 2e-3, 60.0), PAPER_MIRROR)


@pytest.fixture
def ends(true_calibration: Calibration) -> CalibrationSet:
    return calibration_set("x", [(RIM, at(RIM, true_calibration)), (0.0, true_calibration)])


def corrected(
    calibration: Calibration, scan: Recording, block: int = 10**6
) -> tuple[SurfacePoints, Account]:
    corrector = Corrector(calibration, CorrectionOptions(sources=ErrorSources()))
    parts = []
    for axes, distance in blocks_of(scan, block):
        corrector.push_axes(axes)
        corrector.push_distance(distance)
        parts.append(corrector.take())
    points = join_points([*parts, corrector.finish()])
    return points, corrector.account


def error(points: SurfacePoints, scan: Recording) -> np.ndarray:
    moved = scan.axes.z[points.sample] - points.dynamic_error
    return np.asarray(moved - scan.probe_motion[points.sample])


def test_between_two_places_the_dynamics_are_found(
    ends: CalibrationSet, scan: Recording, true_calibration: Calibration
) -> None:
    blended, single = (corrected(c, scan)[0] for c in (ends, true_calibration))
    assert np.ptp(error(single, scan)) > 300e-9
    assert np.ptp(error(blended, scan)) < 1e-9


def test_the_variation_is_stated_as_uncertainty(ends: CalibrationSet, scan: Recording) -> None:
    """None at a member's own place, most between: |H_a - H_b| / √12."""
    points, _ = corrected(ends, scan)
    radius = np.hypot(points.x, points.y)
    middle = points.uncertainty[abs(radius - RIM / 2) < 0.02 * RIM]
    rim = points.uncertainty[radius > 0.995 * RIM]
    assert np.max(middle) > 3 * np.max(rim) > 0
    a, b = (corrected(c, scan)[0].dynamic_error for c in ends.members)
    expected = np.abs(a - b)[abs(radius - RIM / 2) < 0.02 * RIM] / np.sqrt(12)
    assert np.max(middle) == pytest.approx(np.max(expected), rel=0.05)


def test_nothing_bumps_where_a_member_hands_over(
    scan: Recording, true_calibration: Calibration
) -> None:
    three = calibration_set("x", [(x, at(x, true_calibration)) for x in (0.0, 0.5 * RIM, RIM)])
    points, _ = corrected(three, scan)
    assert np.ptp(error(points, scan)) < 1e-9
    bump = np.abs(np.diff(points.dynamic_error, 2))
    there = np.argmin(abs(np.hypot(points.x, points.y) - 0.5 * RIM))
    assert np.max(bump[there - 50 : there + 50]) < 2 * np.median(bump[there - 500 : there + 500])


def test_live_blocks_give_the_same_points(ends: CalibrationSet, scan: Recording) -> None:
    whole, cut = corrected(ends, scan)[0], corrected(ends, scan, 137)[0]
    assert np.array_equal(whole.height, cut.height)
    assert np.array_equal(whole.uncertainty, cut.uncertainty)


def test_members_that_are_alike_are_as_one(scan: Recording, true_calibration: Calibration) -> None:
    same = calibration_set("x", [(0.0, true_calibration), (RIM, true_calibration)])
    one, both = corrected(true_calibration, scan)[0], corrected(same, scan)[0]
    assert np.allclose(one.height, both.height, atol=1e-15, rtol=0)
    assert np.all(both.uncertainty == 0)


def test_beyond_the_range_there_are_no_points_and_each_is_counted(
    scan: Recording, true_calibration: Calibration
) -> None:
    inner = calibration_set("x", [(0.0, true_calibration), (0.01, at(0.01, true_calibration))])
    points, account = corrected(inner, scan)
    assert np.max(np.hypot(points.x, points.y)) < 0.0101 + 1e-6
    counted = account.axes.counted
    assert counted["beyond"] > 0
    assert account.axes.received == account.axes.corrected + sum(counted.values())


def test_a_set_goes_into_a_file_and_back(tmp_path, ends: CalibrationSet, scan: Recording) -> None:
    path = tmp_path / "set.json"
    save_calibration(path, ends)
    found = load_calibration(path)
    assert isinstance(found, CalibrationSet)
    assert found.id == ends.id
    assert found.positions == (0.0, RIM)
    assert np.array_equal(corrected(found, scan)[0].height, corrected(ends, scan)[0].height)
    path.write_text(path.read_text().replace('"along": "x"', '"along": "z"'))
    with pytest.raises(CalibrationError, match="altered"):
        load_calibration(path)


def test_the_worst_of_the_members_is_said_of_the_set(true_calibration: Calibration) -> None:
    def said(**certificate: object) -> Calibration:
        return replace(
            true_calibration,
            certificate=certified_by({**certificate}, true_calibration.certificate),
        )

    bad = said(verdict="rejected", reasons=["not linear"], noise_m=2e-8)
    made = calibration_set("z", [(0.0, said(noise_m=1e-8)), (1e-3, bad)])
    assert made.certificate.verdict == "rejected"
    assert list(map(str, made.certificate.reasons)) == ["not linear"]
    assert made.certificate.residual.noise_m == 2e-8
    assert not made.latency.resolved
    known = [
        with_latency(true_calibration, declared_latency(3e-4, delay, 1e-6, "maker"))
        for delay in (1e-4, 1.2e-4)
    ]
    latency = calibration_set("z", list(zip((0.0, 1e-3), known, strict=True))).latency
    assert latency.delay_s == pytest.approx(1.1e-4)
    assert latency.unshared_s == pytest.approx(np.hypot(1e-6, 0.2e-4 / np.sqrt(12)))


def test_members_that_do_not_belong_together_are_refused(true_calibration: Calibration) -> None:
    other = replace(true_calibration, sample_period=5e-4)
    for along, placed, says in (
        ("y", [(0.0, true_calibration), (1.0, true_calibration)], "along 'y'"),
        ("x", [(0.0, true_calibration)], "set of 1 calibrations"),
        ("x", [(0.0, true_calibration)] * 2, "are at the same x"),
        ("x", [(0.0, true_calibration), (1.0, other)], "sample_period of the members of a set"),
        ("x", [(0.0, true_calibration), (1e3, true_calibration)], "x is 1000.0 m"),
    ):
        with pytest.raises(CalibrationError, match=says):
            calibration_set(along, placed)
