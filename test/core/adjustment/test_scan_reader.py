"""Read scans independently of the size of their portions; a dropout costs its own points only."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from omsm_ros.core.adjustment.resolved_calibration import unit_calibration
from omsm_ros.core.adjustment.scan_model import ScanModel
from omsm_ros.core.adjustment.scan_reader import ScanColumns, ScanReader, read_scan
from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
from omsm_ros.core.correction.surface_points import SurfacePoints, join_points
from omsm_ros.core.kinematics.trajectories import Spiral
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.errors import DataError
from omsm_ros.twin.cell import Cell, Recording, blocks_of, record

SPIRAL = Spiral(PAPER_MIRROR, start_radius=12.7e-3, feed_per_turn=2e-3, spindle_speed=60.0)


@pytest.fixture(scope="module")
def recording() -> Recording:
    return record(Cell(encoder_noise=0.0), SPIRAL, PAPER_MIRROR)


@pytest.fixture(scope="module")
def points(recording: Recording) -> SurfacePoints:
    corrector = Corrector(unit_calibration(1e-3), CorrectionOptions(probe_latency=0.0))
    corrector.push_axes(recording.axes)
    corrector.push_distance(recording.distance)
    return join_points([corrector.finish()])


@pytest.fixture(scope="module")
def whole(recording: Recording, points: SurfacePoints) -> ScanColumns:
    return read_scan(recording.axes, points)


def test_rates_are_those_of_the_motion(recording: Recording, whole: ScanColumns) -> None:
    outside = whole.radius > 1e-3
    omega = 2 * np.pi
    np.testing.assert_allclose(whole.angular_rate[outside], -omega, rtol=1e-6)
    np.testing.assert_allclose(whole.radial_rate[outside], -2e-3, rtol=1e-6)
    z = recording.truth.slide  # type: ignore[union-attr]
    velocity = np.gradient(z, 1e-3)[np.round(whole.time / 1e-3).astype(int)]
    assert np.max(abs(whole.motion_rate - velocity)) < 2e-3 * np.max(abs(velocity))


def test_portions_give_what_the_whole_gives(
    recording: Recording, points: SurfacePoints, whole: ScanColumns
) -> None:
    reader, done = ScanReader(1e-3), 0
    for axes, _ in blocks_of(recording, 700):
        reader.add_axes(axes)
        # The points come late, as they do when the probe's stream is behind.
        ready = int(np.searchsorted(points.sample, axes.first_sample))
        reader.add(points.part(slice(done, ready)))
        done = ready
    reader.add(points.part(slice(done, None)))
    cut = reader.columns()
    assert len(cut) == len(whole) == reader.used
    for name in ("time", "radius", "height", "motion", "motion_rate", "angular_rate"):
        np.testing.assert_allclose(getattr(cut, name), getattr(whole, name), atol=1e-12)


def test_a_dropout_costs_its_own_points(
    recording: Recording, points: SurfacePoints, whole: ScanColumns
) -> None:
    parts = [points.part(slice(0, 2000)), points.part(slice(2003, None))]
    found = read_scan(recording.axes, join_points(parts))
    assert len(found) == len(whole) - 3


def test_a_gap_in_the_axes_costs_its_neighbours(
    recording: Recording, points: SurfacePoints, whole: ScanColumns
) -> None:
    reader = ScanReader(1e-3)
    for axes, _ in blocks_of(recording, 1000):
        if axes.first_sample != 3000:
            reader.add_axes(axes)
    keep = (points.sample < 3000) | (points.sample >= 4000)
    first = int(np.argmin(keep))
    last = first + int(np.count_nonzero(~keep))
    reader.add(join_points([points.part(slice(0, first)), points.part(slice(last, None))]))
    # 12 ms on each side of the gap.
    assert len(reader.columns()) == len(whole) - 1000 - 24


def test_a_lost_sample_of_an_axis_costs_its_neighbours(
    recording: Recording, points: SurfacePoints, whole: ScanColumns
) -> None:
    z = recording.axes.z.copy()
    z[3000] = np.nan
    place = int(np.flatnonzero(points.sample == 3000)[0])
    kept = join_points([points.part(slice(0, place)), points.part(slice(place + 1, None))])
    found = read_scan(replace(recording.axes, z=z), kept)
    assert len(found) == len(whole) - 1 - 24
    later = whole.time > 3.1
    for name in ("radius", "motion_rate", "angular_rate"):
        got, expected = getattr(found, name), getattr(whole, name)[later]
        np.testing.assert_allclose(got[found.time > 3.1], expected, atol=1e-12)
    turns = (found.angle[found.time > 3.1] - whole.angle[later]) / (2 * np.pi)
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-9)


def test_scans_of_different_rings_are_refused(whole: ScanColumns) -> None:
    elsewhere = replace(whole, radius=whole.radius + 20e-3)
    with pytest.raises(DataError, match="share no ring"):
        ScanModel([whole, elsewhere], 4)
