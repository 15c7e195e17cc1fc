"""The corrector against the twin's truth, and its account in every disturbance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from omsm_ros.core.calibration.calibration import with_latency
from omsm_ros.core.calibration.latency import declared_latency
from omsm_ros.core.correction.correct import CorrectionOptions, Corrector, latency_in_use
from omsm_ros.core.correction.surface_points import join_points
from omsm_ros.core.correction.uncertainty import ErrorSources
from omsm_ros.core.kinematics.kinematics import Geometry
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.twin.cell import Recording
from omsm_ros.twin.plant import PAPER_STATIC_GAIN

from .corrected_runs import (
    CALIBRATION,
    NOISE,
    balanced,
    calibration,
    cut,
    part,
    run,
    same_points,
    shifted,
)

# Against the truth of the twin.


def test_the_probes_true_motion_is_found(quiet_scan: Recording) -> None:
    points, _ = run([quiet_scan.axes], [quiet_scan.distance])
    moved = quiet_scan.axes.z[points.sample] - points.dynamic_error
    # Nothing but the discretisation of both sides is left.
    assert np.ptp(moved - quiet_scan.probe_motion[points.sample]) < 0.02e-9


def test_without_noise_the_surface_is_found(quiet_scan: Recording) -> None:
    points, _ = run([quiet_scan.axes], [quiet_scan.distance])
    assert np.ptp(points.height - quiet_scan.surface_height[points.sample]) < 0.02e-9


def test_without_correction_the_error_would_be_a_micrometre(quiet_scan: Recording) -> None:
    error = quiet_scan.probe_motion - quiet_scan.axes.z
    assert np.ptp(error) > 1e-6


def test_with_noise_only_the_noise_is_left(scan: Recording) -> None:
    points, _ = run([scan.axes], [scan.distance])
    error = points.height - scan.surface_height[points.sample]
    floor = np.hypot(10e-9, 10e-9 / np.sqrt(12))
    assert np.std(error) < 1.1 * floor
    moved = scan.axes.z[points.sample] - points.dynamic_error
    assert np.ptp(moved - scan.probe_motion[points.sample]) < 5e-9


def test_points_lie_where_the_probe_looked(quiet_scan: Recording) -> None:
    points, _ = run([quiet_scan.axes], [quiet_scan.distance])
    surface = PAPER_MIRROR.height(points.x, points.y)
    assert np.allclose(points.height, surface, rtol=0, atol=1e-10)


def test_the_static_gain_belongs_to_the_distance(quiet_scan: Recording) -> None:
    scaled, _ = run([quiet_scan.axes], [quiet_scan.distance])
    unscaled = replace(CALIBRATION, static_gain=1.0)
    plain, _ = run([quiet_scan.axes], [quiet_scan.distance], known=unscaled)
    reading = quiet_scan.distance.distance[plain.sample]
    assert np.allclose(
        scaled.height - plain.height, reading * (1 / PAPER_STATIC_GAIN - 1), atol=1e-15
    )


def test_a_probe_mounted_the_other_way(quiet_scan: Recording) -> None:
    turned = replace(quiet_scan.distance, distance=-quiet_scan.distance.distance)
    ours, _ = run([quiet_scan.axes], [turned], CorrectionOptions(polarity=-1))
    usual, _ = run([quiet_scan.axes], [quiet_scan.distance])
    assert same_points(ours, usual)


def test_an_intensity_that_the_device_does_not_tell_is_nan(scan: Recording) -> None:
    silent = replace(scan.distance, intensity=np.empty(0, np.float32))
    points, _ = run([scan.axes], [silent])
    assert np.all(np.isnan(points.intensity))
    assert points.intensity.dtype == np.float32


def test_geometry_moves_the_points(quiet_scan: Recording) -> None:
    geometry = Geometry(centre_x=5e-6)
    moved, _ = run([quiet_scan.axes], [quiet_scan.distance], CorrectionOptions(geometry=geometry))
    usual, _ = run([quiet_scan.axes], [quiet_scan.distance])
    c = quiet_scan.axes.c[usual.sample]
    assert np.allclose(usual.x - moved.x, 5e-6 * np.cos(c), rtol=0, atol=1e-15)
    assert np.allclose(moved.y - usual.y, 5e-6 * np.sin(c), rtol=0, atol=1e-15)
    assert np.array_equal(moved.height, usual.height)


# The same bits, live and offline.


@settings(max_examples=15)
@given(
    axis_cuts=st.lists(st.integers(1, 3999), max_size=60),
    probe_cuts=st.lists(st.integers(1, 3999), max_size=60),
    turns=st.lists(st.booleans(), max_size=130),
    takes=st.integers(1, 40),
)
def test_cuts_and_interleaving_do_not_change_a_bit(
    scan: Recording, axis_cuts: list[int], probe_cuts: list[int], turns: list[bool], takes: int
) -> None:
    axes, distance = part(scan.axes, 0, 4000), part(scan.distance, 0, 4000)
    holes = np.r_[500:520, 1990:2010]
    distance = replace(distance, distance=np.where(np.isin(np.arange(4000), holes), np.nan, 1e-6))
    expected = run([axes], [distance])
    waiting_axes, waiting_distance = cut(axes, axis_cuts), cut(distance, probe_cuts)
    corrector, taken = Corrector(CALIBRATION), []
    for turn in [*turns, *[True] * len(waiting_axes), *[False] * len(waiting_distance)]:
        if turn and waiting_axes:
            corrector.push_axes(waiting_axes.pop(0))  # type: ignore[arg-type]
        elif not turn and waiting_distance:
            corrector.push_distance(waiting_distance.pop(0))  # type: ignore[arg-type]
        assert balanced(corrector.account.axes)
        assert balanced(corrector.account.distance)
        if len(waiting_axes) % takes == 0:
            taken.append(corrector.take())
    taken.append(corrector.finish())
    assert same_points(join_points(taken), expected[0])
    assert corrector.account == expected[1]


def test_single_samples_give_the_same_bits_as_one_block(scan: Recording) -> None:
    axes, distance = part(scan.axes, 0, 300), part(scan.distance, 0, 300)
    expected, account = run([axes], [distance])
    ones = range(300)
    single, single_account = run(cut(axes, ones), cut(distance, ones))
    assert same_points(single, expected)
    assert single_account == account


def test_points_carry_the_time_of_their_own_first_sample(scan: Recording) -> None:
    late = 7_000_000_000
    axes, distance = (
        cut(shifted(part(whole, 0, 2000), 0, late / 1e9), range(100, 2000, 100))
        for whole in (scan.axes, scan.distance)
    )
    corrector = Corrector(CALIBRATION)
    assert len(distance) == 20
    for axis_block, _ in zip(axes, distance, strict=True):
        corrector.push_axes(axis_block)  # type: ignore[arg-type]
    for block in distance:
        corrector.push_distance(block)  # type: ignore[arg-type]
        points = corrector.take()
        # Not that of the newest message, which is 2 s.
        assert points is not None
        assert points.stamp_ns == late + int(points.sample[0]) * 1_000_000


def test_a_lost_first_sample_moves_the_time_on(scan: Recording) -> None:
    distance = scan.distance.distance.copy()
    distance[:500] = np.nan
    points, _ = run([scan.axes], [replace(scan.distance, distance=distance)])
    assert points.sample[0] == 500
    assert points.stamp_ns == 500_000_000


def test_a_pitch_costs_height_over_the_abbe_arm(scan: Recording) -> None:
    def stated(**changes: float) -> float:
        sources = ErrorSources(
            probe_noise=10e-9, **{k: v for k, v in changes.items() if k == "pitch"}
        )
        options = CorrectionOptions(
            sources=sources, geometry=Geometry(abbe_arm=changes.get("abbe_arm", 0.0))
        )
        corrector = Corrector(calibration(covariance=np.zeros((7, 7))), options)
        corrector.push_axes(scan.axes)
        corrector.push_distance(scan.distance)
        points = join_points([corrector.finish()])
        return float(np.median(points.uncertainty))

    plain = stated()
    assert stated(pitch=2e-6) == plain
    assert stated(pitch=2e-6, abbe_arm=0.05) == pytest.approx(np.hypot(plain, 100e-9), rel=1e-6)


# Uncertainty.


def test_the_budget_is_the_uncertainty_of_the_points(scan: Recording) -> None:
    corrector = Corrector(CALIBRATION, CorrectionOptions(sources=NOISE))
    corrector.push_axes(scan.axes)
    corrector.push_distance(scan.distance)
    points = join_points([corrector.finish()])
    budget = corrector.budget
    assert budget["probe_noise"] == pytest.approx(10e-9 / PAPER_STATIC_GAIN)
    assert budget["dynamics"] > 0.1e-9
    total = np.sqrt(sum(value**2 for value in budget.values()))
    assert total == pytest.approx(np.sqrt(np.mean(points.uncertainty**2)))


def test_stated_noise_is_the_scatter_of_the_heights(scan: Recording) -> None:
    points, _ = run([scan.axes], [scan.distance], CorrectionOptions(sources=NOISE))
    error = points.height - scan.surface_height[points.sample]
    assert np.std(error / points.uncertainty) == pytest.approx(1.0, abs=0.02)


# Latency.


def test_latency_is_assumed_only_where_it_is_known() -> None:
    lag = CALIBRATION.dynamics.low_frequency_delay
    late = with_latency(CALIBRATION, declared_latency(lag, 0.7 * lag, 1e-6, "data sheet"))
    assert latency_in_use(CALIBRATION, CorrectionOptions()) == 0.0
    assert latency_in_use(late, CorrectionOptions()) == 0.7 * lag
    assert latency_in_use(late, CorrectionOptions(probe_latency=0.0)) == 0.0


def test_a_late_probe_looks_where_the_spindle_was(quiet_scan: Recording) -> None:
    lag = 0.34e-3
    now, _ = run([quiet_scan.axes], [quiet_scan.distance])
    then, _ = run([quiet_scan.axes], [quiet_scan.distance], CorrectionOptions(probe_latency=lag))
    now_at = {int(k): complex(x, y) for k, x, y in zip(now.sample, now.x, now.y, strict=True)}
    start = np.array([now_at[int(k)] for k in then.sample])
    turned = np.angle((then.x + 1j * then.y) / start)
    inside = abs(start) > 1e-3
    # Y = -x sin c: the workpiece angle falls as the spindle turns, so earlier is larger.
    assert np.allclose(turned[inside], np.pi * lag, rtol=1e-6)
    feed = 2e-3 * 0.5
    grown = np.hypot(then.x, then.y) - abs(start)
    assert np.allclose(grown[inside], feed * lag, atol=1e-12)
