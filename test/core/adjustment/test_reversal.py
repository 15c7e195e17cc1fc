"""The probe latency, recovered from two scans of the twin in opposite directions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from soaked import soaked

from omsm_ros.core.adjustment.resolved_calibration import reversal
from omsm_ros.core.adjustment.scan_data import ScanData
from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.kinematics.trajectories import Spiral
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.surface.aspheres import Sphere
from omsm_ros.core.surface.nominal import PAPER_MIRROR, Flat
from omsm_ros.errors import DataError
from omsm_ros.pipelines.recording import scan_data
from omsm_ros.twin.cell import Cell, record
from omsm_ros.twin.disturbances import Disturbances
from omsm_ros.twin.plant import PAPER_STATIC_GAIN, Plant
from omsm_ros.twin.probe import ProbeErrors

LATENCY = 0.34e-3
PROMPT = TransferFunction(np.ones(1), np.array([1.0, 1 / (2 * np.pi * 5000)]))


def calibration(dynamics: TransferFunction, delay_variance: float = 0.0) -> Calibration:
    p = len(dynamics.numerator) + len(dynamics.denominator)
    covariance = np.zeros((p, p))
    covariance[-1, -1] = delay_variance
    return Calibration(
        dynamics=dynamics,
        static_gain=PAPER_STATIC_GAIN,
        sample_period=1e-3,
        valid_up_to=100.0,
        covariance=covariance,
    )


LATE = calibration(TransferFunction(PROMPT.numerator, PROMPT.denominator, LATENCY))
MECHANICAL = calibration(Plant().dynamics)


def scan(
    speed: float,
    seed: int,
    known: Calibration,
    cell: Cell,
    surface: Surface = PAPER_MIRROR,
    feed: float = 1e-3,
) -> ScanData:
    spiral = Spiral(surface, start_radius=12.7e-3, feed_per_turn=feed, spindle_speed=speed)
    recording = record(replace(cell, seed=seed), spiral, surface)
    corrector = Corrector(known, CorrectionOptions(probe_latency=0.0))
    corrector.push_axes(recording.axes)
    corrector.push_distance(recording.distance)
    return scan_data([recording.axes], [corrector.finish()], 1e-3)[0]


LATE_CELL = Cell(
    plant=Plant(dynamics=PROMPT), disturbances=Disturbances(probe=ProbeErrors(latency_s=LATENCY))
)


@pytest.fixture(scope="module")
def late_scans() -> list[ScanData]:
    return [scan(30.0, 1, LATE, LATE_CELL), scan(-30.0, 2, LATE, LATE_CELL)]


def test_a_latency_is_recovered_within_its_uncertainty(late_scans: list[ScanData]) -> None:
    found = reversal(late_scans, LATE)
    assert found.uncertainty < 1e-6
    assert abs(found.lag - LATENCY) < 3 * found.uncertainty
    assert found.residual == pytest.approx(10.5e-9, rel=0.05)


def test_a_mechanical_lag_is_not_probe_latency() -> None:
    scans = [scan(30.0, 1, MECHANICAL, Cell()), scan(-30.0, 2, MECHANICAL, Cell())]
    found = reversal(scans, MECHANICAL)
    assert abs(found.lag) < 3 * found.uncertainty
    assert found.latency is False
    assert found.lag_of_z == pytest.approx(0.3397e-3, abs=1e-7)


def test_latency_is_reported_when_it_is_the_whole_lag(late_scans: list[ScanData]) -> None:
    total = LATE.dynamics.low_frequency_delay
    known = replace(LATE, covariance=calibration(LATE.dynamics, (20e-6) ** 2).covariance)
    found = reversal(late_scans, known)
    assert found.lag_of_z == total
    assert found.latency is True


def test_a_poorly_known_delay_of_the_calibration_limits_the_estimate(
    late_scans: list[ScanData],
) -> None:
    vague = replace(LATE, covariance=calibration(LATE.dynamics, (50e-6) ** 2).covariance)
    assert reversal(late_scans, vague).uncertainty == pytest.approx(50e-6, rel=1e-3)


def test_scans_in_one_direction_are_refused(late_scans: list[ScanData]) -> None:
    with pytest.raises(DataError, match="turn in the same direction"):
        reversal([late_scans[0], late_scans[0]], LATE)


def test_a_single_scan_is_refused(late_scans: list[ScanData]) -> None:
    with pytest.raises(DataError, match="1 scan"):
        reversal(late_scans[:1], LATE)


def test_scans_of_different_rings_are_refused(late_scans: list[ScanData]) -> None:
    elsewhere = replace(late_scans[1], x=late_scans[1].x + 40e-3)
    with pytest.raises(DataError, match="share no ring"):
        reversal([late_scans[0], elsewhere], LATE)


@pytest.mark.parametrize("surface", [Sphere(0.5), *soaked(Flat())])
def test_a_surface_of_revolution_is_refused(surface: Surface) -> None:
    pair = [scan(s, 1, LATE, LATE_CELL, surface) for s in (30.0, -30.0)]
    with pytest.raises(DataError, match="not symmetric about the spindle"):
        reversal(pair, LATE)
