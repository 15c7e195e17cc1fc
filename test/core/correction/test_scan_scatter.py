"""The scatter of a scan's own heights: found where it is more than stated, and only there."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
from omsm_ros.core.correction.machine_sources import excess_noise
from omsm_ros.core.correction.surface_points import SurfacePoints, join_points
from omsm_ros.core.correction.uncertainty import ErrorSources
from omsm_ros.core.streams.blocks import AxisBlock, DistanceBlock, FloatArray
from omsm_ros.core.streams.statistics import RunningScatter

NOISE = 10e-9
COUNT = 20_000
SAMPLE = np.arange(COUNT)
# Motion of Z on the paper's mirror at four times the paper's speed.
SURFACE = 150e-6 * np.sin(2 * np.pi * 4 * SAMPLE * 1e-3)


def noise(size: float, seed: int = 1) -> FloatArray:
    return np.random.default_rng(seed).normal(0.0, size, COUNT)


def test_noise_as_stated_and_a_moving_surface_exceed_nothing() -> None:
    for seed in range(3):
        excess = RunningScatter(NOISE).excess(0, SAMPLE, SURFACE + noise(NOISE, seed))
        assert not excess.any()


def test_more_noise_than_stated_is_found() -> None:
    excess = RunningScatter(NOISE).excess(0, SAMPLE, SURFACE + noise(4 * NOISE))
    assert np.sqrt(excess[6000:] + NOISE**2) == pytest.approx(4 * NOISE, rel=0.08)
    rms = np.sqrt(np.mean(excess[6000:]) + NOISE**2)
    assert rms == pytest.approx(4 * NOISE, rel=0.02)


def test_where_nothing_is_stated_all_of_it_counts() -> None:
    excess = RunningScatter(0.0).excess(0, SAMPLE, noise(NOISE))
    assert np.sqrt(np.mean(excess[100:])) == pytest.approx(NOISE, rel=0.03)
    assert not excess[:6].any()


def test_blocks_of_any_length_give_the_same_to_the_last_bit() -> None:
    height, random = SURFACE + noise(3 * NOISE), np.random.default_rng(5)
    kept = random.random(COUNT) > 0.05
    sample, height = SAMPLE[kept], height[kept]
    whole = RunningScatter(NOISE).excess(0, sample, height)
    cuts = [0, 1, 2, 5, *np.sort(random.integers(6, len(sample), 40)), len(sample)]
    parts = RunningScatter(NOISE)
    found = [parts.excess(0, sample[a:b], height[a:b]) for a, b in pairwise(cuts)]
    assert np.array_equal(np.concatenate(found), whole)


def test_a_step_across_lost_samples_or_a_restart_is_no_scatter() -> None:
    height = noise(NOISE)
    height[COUNT // 2 :] += 1e-3
    later = np.where(height > 5e-4, SAMPLE + 100, SAMPLE)
    assert not RunningScatter(NOISE).excess(0, later, height).any()
    scatter, half = RunningScatter(NOISE), COUNT // 2
    parts = [
        scatter.excess(session, SAMPLE[:half], height[session * half :][:half])
        for session in (0, 1)
    ]
    assert not np.any(parts)


def test_a_speck_of_dust_widens_what_is_near_it_alone() -> None:
    height = noise(NOISE)
    height[5000] += 3e-6
    excess = RunningScatter(NOISE).excess(0, SAMPLE, height)
    assert not excess[:5000].any()
    assert 0 < np.sqrt(excess[5006]) < 4 * NOISE
    assert not excess[15_000:].any()


def corrected(known: Calibration, size: float) -> tuple[SurfacePoints, Corrector]:
    """A scan on a plane, of a step test that states a noise of ``NOISE``."""
    corrector = Corrector(known, CorrectionOptions(sources=ErrorSources(probe_noise=NOISE)))
    zero = np.zeros(COUNT)
    place = {"stamp_ns": 0, "first_sample": 0, "sample_period": known.sample_period}
    corrector.push_axes(AxisBlock(**place, x=zero, y=zero, z=zero, b=zero, c=zero))  # type: ignore[arg-type]
    corrector.push_distance(DistanceBlock(**place, distance=noise(size)))  # type: ignore[arg-type]
    return join_points([corrector.finish()]), corrector


def test_the_points_of_a_noisier_scan_state_what_they_scatter_by(
    true_calibration: Calibration,
) -> None:
    points, corrector = corrected(true_calibration, 4 * NOISE)
    settled = slice(8000, None)
    found = float(np.std(points.height[settled]))
    assert np.median(points.uncertainty[settled]) == pytest.approx(found, rel=0.05)
    assert "state probe_noise" in str(excess_noise(corrector.budget))


def test_of_a_scan_as_stated_there_is_nothing_to_say(true_calibration: Calibration) -> None:
    points, corrector = corrected(true_calibration, NOISE)
    gain = true_calibration.static_gain
    assert np.median(points.uncertainty) == pytest.approx(NOISE / gain, rel=1e-9)
    assert corrector.budget["scan_scatter"] == 0
    assert excess_noise(corrector.budget) is None
