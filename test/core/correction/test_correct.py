"""The corrector against the twin's truth, and its account in every disturbance."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from omsm_ros.core.correction.correct import CorrectionOptions, Corrector, lateral_lag
from omsm_ros.core.correction.surface_points import SurfacePoints, join_points
from omsm_ros.core.correction.uncertainty import ErrorSources
from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.dynamics.latency import declared, with_latency
from omsm_ros.core.machine.kinematics import Geometry
from omsm_ros.core.machine.trajectories import Spiral
from omsm_ros.core.samples.accounts import Account, StreamAccount
from omsm_ros.core.samples.blocks import AxisBlock, Block, DistanceBlock, Status
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.errors import CalibrationError, ConfigurationError, DataError
from omsm_ros.twin.cell import Cell, Probe, Recording, record
from omsm_ros.twin.plant import PAPER_STATIC_GAIN, Plant

PERIOD = 1e-3
SPIRAL = Spiral(PAPER_MIRROR, start_radius=12.7e-3, feed_per_turn=2e-3, spindle_speed=30.0)
NOISE = ErrorSources(probe_noise=10e-9, probe_resolution=10e-9, encoder_noise=0.4e-9)


def calibration(**changes: object) -> Calibration:
    """True dynamics of the paper's plant, with a plausible covariance."""
    g = Plant().dynamics
    values = np.concatenate([g.numerator, g.denominator[1:], [0.0]])
    deviations = 1e-3 * abs(values)
    deviations[0] = 0.0
    parts: dict[str, object] = {
        "dynamics": g,
        "static_gain": PAPER_STATIC_GAIN,
        "sample_period": PERIOD,
        "valid_up_to": 100.0,
        "covariance": np.diag(deviations**2),
    }
    return Calibration(**(parts | changes))  # type: ignore[arg-type]


CALIBRATION = calibration()


@pytest.fixture(scope="module")
def scan() -> Recording:
    return record(Cell(), SPIRAL, PAPER_MIRROR)


@pytest.fixture(scope="module")
def quiet_scan() -> Recording:
    probe = Probe(noise=0.0, resolution=0.0)
    return record(Cell(probe=probe, encoder_noise=0.0), SPIRAL, PAPER_MIRROR)


def part(block: Block, start: int, stop: int) -> Block:
    """Samples ``start`` to ``stop`` of a block, stamped as a driver would."""
    arrays = {
        f.name: getattr(block, f.name)[start:stop].copy()
        for f in fields(block)
        if isinstance(getattr(block, f.name), np.ndarray)
    }
    return replace(
        block,
        first_sample=block.first_sample + start,
        stamp_ns=block.stamp_ns + round(start * PERIOD * 1e9),
        **arrays,
    )


def cut(block: Block, edges: Sequence[int]) -> list[Block]:
    inner = sorted({e for e in edges if 0 < e < len(block)})  # type: ignore[arg-type]
    bounds = [0, *inner, len(block)]  # type: ignore[arg-type]
    return [part(block, a, b) for a, b in itertools.pairwise(bounds)]


def run(
    axes: Sequence[Block], distance: Sequence[Block], options: CorrectionOptions | None = None
) -> tuple[SurfacePoints, Account]:
    corrector = Corrector(CALIBRATION, options or CorrectionOptions())
    for block in axes:
        corrector.push_axes(block)  # type: ignore[arg-type]
    for block in distance:
        corrector.push_distance(block)  # type: ignore[arg-type]
    points = join_points([corrector.finish()])
    return points, corrector.account


def same_points(one: SurfacePoints, other: SurfacePoints) -> bool:
    return all(
        np.array_equal(getattr(one, f.name), getattr(other, f.name), equal_nan=True)
        for f in fields(SurfacePoints)
    )


def balanced(account: StreamAccount) -> bool:
    return account.received == (account.corrected + account.pending + sum(account.counted.values()))


# --- against the truth of the twin ---------------------------------------------------------


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
    plain, _ = run([quiet_scan.axes], [quiet_scan.distance], CorrectionOptions(static_gain=1.0))
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


# --- the same bits, live and offline --------------------------------------------------------


@settings(max_examples=25, deadline=None)
@given(
    axis_cuts=st.lists(st.integers(1, 3999), max_size=60),
    probe_cuts=st.lists(st.integers(1, 3999), max_size=60),
    turns=st.lists(st.booleans(), max_size=130),
    takes=st.integers(1, 40),
)
def test_cuts_and_interleaving_do_not_change_a_bit(
    scan: Recording,
    axis_cuts: list[int],
    probe_cuts: list[int],
    turns: list[bool],
    takes: int,
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


# --- every sample is accounted for ----------------------------------------------------------


def test_settling_is_counted_in_both_streams(scan: Recording) -> None:
    points, account = run([scan.axes], [scan.distance])
    settling = account.axes.counted["settling"]
    assert 12 <= settling < 40
    assert account.distance.counted == {"settling": settling}
    assert len(points) == account.axes.corrected == len(scan.axes) - settling
    assert points.sample[0] == settling


def test_a_probe_dropout_costs_its_points_and_nothing_else(scan: Recording) -> None:
    status = scan.distance.status.copy()
    status[1000:1050] = Status.NO_TARGET
    distance = scan.distance.distance.copy()
    distance[2000:2003] = np.nan, np.inf, 1e300
    whole, _ = run([scan.axes], [scan.distance])
    points, account = run([scan.axes], [replace(scan.distance, status=status, distance=distance)])
    lost = np.r_[1000:1050, 2000:2003]
    kept = ~np.isin(whole.sample, lost)
    assert np.array_equal(points.height, whole.height[kept])
    assert account.axes.counted["invalid"] == account.distance.counted["invalid"] == 53


@pytest.mark.parametrize("channel", ["x", "y", "z", "b", "c"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -1e300])
def test_an_impossible_axis_never_poisons_the_filter(
    scan: Recording, channel: str, bad: float
) -> None:
    values = getattr(scan.axes, channel).copy()
    values[3000:3005] = bad
    points, account = run([replace(scan.axes, **{channel: values})], [scan.distance])
    assert account.axes.counted["invalid"] == account.distance.counted["invalid"] == 5
    assert account.axes.counted["settling"] == 2 * points.sample[0]
    error = points.height - scan.surface_height[points.sample]
    assert np.all(np.isfinite(points.height))
    assert np.max(abs(error)) < 100e-9


def test_a_gap_restarts_the_filter_in_the_motion_it_finds(quiet_scan: Recording) -> None:
    axes = [part(quiet_scan.axes, 0, 2000), part(quiet_scan.axes, 2500, 6000)]
    points, account = run(axes, [part(quiet_scan.distance, 0, 6000)])
    error = points.height - quiet_scan.surface_height[points.sample]
    assert np.max(abs(error)) < 0.02e-9
    settling = points.sample[0]
    assert account.axes.counted == {"settling": 2 * settling}
    assert account.distance.counted == {"settling": 2 * settling, "unmatched": 500}


def test_a_run_too_short_to_start_on_is_settling(scan: Recording) -> None:
    axes = [part(scan.axes, 0, 5), part(scan.axes, 10, 14)]
    points, account = run(axes, [part(scan.distance, 0, 14)])
    assert len(points) == 0
    assert account.axes.counted == {"settling": 9}
    assert account.distance.counted == {"settling": 9, "unmatched": 5}


def test_repeated_and_overlapping_blocks_are_counted_once(scan: Recording) -> None:
    expected, account = run([part(scan.axes, 0, 1000)], [part(scan.distance, 0, 1000)])
    axes = [part(scan.axes, a, b) for a, b in [(0, 400), (0, 400), (300, 700), (700, 1000)]]
    points, doubled = run(axes, [part(scan.distance, 0, 1000)])
    assert same_points(points, expected)
    assert doubled.axes.counted == {**account.axes.counted, "duplicate": 500}


def test_a_late_block_is_counted_and_not_used(scan: Recording) -> None:
    axes = [part(scan.axes, a, b) for a, b in [(0, 1000), (1500, 2000), (1000, 1500)]]
    points, account = run(axes, [part(scan.distance, 0, 2000)])
    assert account.axes.counted["late"] == 500
    assert account.distance.counted["unmatched"] == 500
    assert not np.any((points.sample >= 1000) & (points.sample < 1500))


def shifted(block: Block, count: int, seconds: float) -> Block:
    return replace(
        block,
        first_sample=block.first_sample + count,
        stamp_ns=block.stamp_ns + round(seconds * 1e9),
    )


@pytest.mark.parametrize("seconds", [60.0, -60.0], ids=["device restarted", "bag in a loop"])
def test_a_count_that_begins_anew_is_a_new_scan(scan: Recording, seconds: float) -> None:
    axes, distance = part(scan.axes, 0, 3000), part(scan.distance, 0, 3000)
    once, account = run([axes], [distance])
    points, twice = run(
        [axes, shifted(axes, 0, seconds)], [distance, shifted(distance, 0, seconds)]
    )
    assert same_points(points, join_points([once, once]))
    assert twice.axes.corrected == 2 * account.axes.corrected
    assert twice.axes.counted == {"settling": 2 * account.axes.counted["settling"]}


def test_counts_beyond_32_bits_are_no_interruption(scan: Recording) -> None:
    axes, distance = part(scan.axes, 0, 2000), part(scan.distance, 0, 2000)
    plain, _ = run([axes], [distance])
    start = 2**32 - 700
    points, account = run(
        [replace(b, first_sample=b.first_sample + start) for b in cut(axes, range(100, 2000, 100))],
        [replace(b, first_sample=b.first_sample + start) for b in cut(distance, [70, 1400])],
    )
    assert np.array_equal(points.height, plain.height)
    assert np.array_equal(points.sample, plain.sample + start)
    assert set(account.axes.counted) == {"settling"}


def test_time_lapse_changes_nothing(scan: Recording) -> None:
    sizes = range(100, 4000, 100)
    axes, distance = cut(part(scan.axes, 0, 4000), sizes), cut(part(scan.distance, 0, 4000), sizes)
    expected = run(axes, distance)
    fast = [[replace(b, stamp_ns=b.stamp_ns // 20) for b in blocks] for blocks in (axes, distance)]
    points, account = run(*fast)
    assert same_points(points, expected[0])
    assert account == expected[1]


def test_what_waits_in_vain_is_bounded(scan: Recording) -> None:
    corrector = Corrector(CALIBRATION, CorrectionOptions(max_pending=1.0))
    for block in cut(part(scan.axes, 0, 4000), range(100, 4000, 100)):
        corrector.push_axes(block)  # type: ignore[arg-type]
        assert corrector.account.axes.pending <= 1000
        assert balanced(corrector.account.axes)
    overdue = 3000 - corrector.account.axes.counted["settling"]
    assert corrector.account.axes.counted["overdue"] == overdue
    corrector.push_distance(part(scan.distance, 0, 4000))  # type: ignore[arg-type]
    assert corrector.account.distance.counted["overdue"] == 3000
    assert corrector.account.distance.corrected == 1000


def test_stamps_that_disagree_about_a_trigger_are_told(scan: Recording) -> None:
    corrector = Corrector(CALIBRATION)
    assert corrector.stamp_skew is None
    corrector.push_axes(scan.axes)
    corrector.push_distance(shifted(scan.distance, 0, 0.04))  # type: ignore[arg-type]
    assert corrector.stamp_skew == pytest.approx(-0.04)


def test_a_refused_block_leaves_the_account_as_it_was(scan: Recording) -> None:
    corrector = Corrector(CALIBRATION)
    with pytest.raises(DataError, match="first_sample"):
        corrector.push_axes(replace(scan.axes, first_sample=2**63))
    assert corrector.account == Account()


@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_whatever_the_network_does_every_sample_is_counted_and_no_point_is_wrong(
    scan: Recording, data: st.DataObject
) -> None:
    """Blocks lost, repeated, swapped and overlapping, with holes in them, in both streams."""
    corrector, taken = Corrector(CALIBRATION), []
    starts = st.lists(st.integers(0, 3900), min_size=1, max_size=25)
    for axes_start, probe_start in zip(data.draw(starts), data.draw(starts), strict=False):
        length, hole = data.draw(st.integers(1, 400)), data.draw(st.integers(0, 399))
        axes = part(scan.axes, axes_start, axes_start + length)
        distance = part(scan.distance, probe_start, probe_start + length)
        if hole < length and hole % 3 == 0:
            axes.z[hole], distance.distance[hole] = np.nan, np.inf  # type: ignore[attr-defined]
        corrector.push_axes(axes)  # type: ignore[arg-type]
        corrector.push_distance(distance)  # type: ignore[arg-type]
        taken.append(corrector.take())
        assert balanced(corrector.account.axes)
        assert balanced(corrector.account.distance)
    points = join_points([*taken, corrector.finish()])
    account = corrector.account
    assert account.axes.pending == account.distance.pending == 0
    assert account.axes.corrected == account.distance.corrected == len(points)
    assert balanced(account.axes)
    assert np.all(abs(points.height - scan.surface_height[points.sample]) < 100e-9)


def test_after_finish_a_new_scan_may_begin(scan: Recording) -> None:
    axes, distance = part(scan.axes, 0, 1000), part(scan.distance, 0, 1000)
    corrector, found = Corrector(CALIBRATION), []
    for _ in range(2):
        corrector.push_axes(axes)  # type: ignore[arg-type]
        corrector.push_distance(distance)  # type: ignore[arg-type]
        found.append(corrector.finish())
    assert same_points(join_points(found[:1]), join_points(found[1:]))


def test_nothing_to_take_is_none() -> None:
    corrector = Corrector(CALIBRATION)
    assert corrector.take() is None
    assert corrector.finish() is None
    assert corrector.account == Account()


# --- uncertainty ------------------------------------------------------------------------------


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


# --- latency ------------------------------------------------------------------------------------


def test_latency_is_assumed_only_where_it_is_known() -> None:
    lag = CALIBRATION.dynamics.low_frequency_delay
    late = with_latency(CALIBRATION, declared(lag, 0.7 * lag, 1e-6, "data sheet"))
    assert lateral_lag(CALIBRATION, CorrectionOptions()) == 0.0
    assert lateral_lag(late, CorrectionOptions()) == 0.7 * lag
    assert lateral_lag(late, CorrectionOptions(lateral_lag=0.0)) == 0.0


def test_a_late_probe_looks_where_the_spindle_was(quiet_scan: Recording) -> None:
    lag = 0.34e-3
    now, _ = run([quiet_scan.axes], [quiet_scan.distance])
    then, _ = run([quiet_scan.axes], [quiet_scan.distance], CorrectionOptions(lateral_lag=lag))
    now_at = {int(k): complex(x, y) for k, x, y in zip(now.sample, now.x, now.y, strict=True)}
    start = np.array([now_at[int(k)] for k in then.sample])
    turned = np.angle((then.x + 1j * then.y) / start)
    inside = abs(start) > 1e-3
    # Y = -x sin c: the workpiece angle falls as the spindle turns, so earlier is larger.
    assert np.allclose(turned[inside], np.pi * lag, rtol=1e-6)
    feed = 2e-3 * 0.5
    grown = np.hypot(then.x, then.y) - abs(start)
    assert np.allclose(grown[inside], feed * lag, atol=1e-12)


# --- refusals --------------------------------------------------------------------------------


def other_rate(block: AxisBlock | DistanceBlock, period: float) -> AxisBlock | DistanceBlock:
    return replace(block, sample_period=period)


@pytest.mark.parametrize("push", [Corrector.push_axes, Corrector.push_distance])
def test_another_rate_than_the_calibrations_is_refused(
    scan: Recording, push: Callable[[Corrector, object], None]
) -> None:
    block = scan.axes if push is Corrector.push_axes else scan.distance
    with pytest.raises(CalibrationError, match=r"0\.0005 s.*0\.001 s"):
        push(Corrector(CALIBRATION), other_rate(block, 0.5e-3))


def test_another_rate_may_be_accepted(scan: Recording) -> None:
    axes, distance = other_rate(scan.axes, 0.5e-3), other_rate(scan.distance, 0.5e-3)
    points, _ = run([axes], [distance], CorrectionOptions(accept_other_rate=True))
    # The same samples in half the time: twice the speed, twice the lag's error.
    usual, _ = run([scan.axes], [scan.distance])
    common = np.intersect1d(points.sample, usual.sample)
    ours = points.dynamic_error[np.isin(points.sample, common)]
    theirs = usual.dynamic_error[np.isin(usual.sample, common)]
    assert np.ptp(ours) == pytest.approx(2 * np.ptp(theirs), rel=0.01)


def test_one_stream_may_not_change_its_rate(scan: Recording) -> None:
    corrector = Corrector(CALIBRATION, CorrectionOptions(accept_other_rate=True))
    corrector.push_axes(scan.axes)
    with pytest.raises(CalibrationError, match="both streams"):
        corrector.push_distance(replace(scan.distance, sample_period=0.5e-3))


@pytest.mark.parametrize(
    "wrong",
    [
        {"polarity": 0},
        {"static_gain": 0.0},
        {"static_gain": np.nan},
        {"max_pending": 0.0},
        {"lateral_lag": -1e-3},
    ],
    ids=lambda wrong: next(iter(wrong)),
)
def test_senseless_options_are_named(wrong: dict[str, float]) -> None:
    (name,) = wrong
    with pytest.raises(ConfigurationError, match=name):
        CorrectionOptions(**wrong)  # type: ignore[arg-type]


def test_a_certificate_with_a_senseless_noise_is_refused() -> None:
    with pytest.raises(CalibrationError, match="noise_m is 'low'"):
        Corrector(calibration(certificate={"noise_m": "low"}))


def test_joining_nothing_gives_no_points() -> None:
    assert len(join_points([None, None])) == 0
