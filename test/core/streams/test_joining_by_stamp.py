"""Axes and probe with clocks of their own."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
from omsm_ros.core.correction.surface_points import join_points
from omsm_ros.core.kinematics.trajectories import Spiral
from omsm_ros.core.streams import blocks as merging
from omsm_ros.core.streams.axes_at_probe import axes_at_probe
from omsm_ros.core.streams.blocks import AxisBlock, Block, DistanceBlock
from omsm_ros.core.streams.stamps import fit_clock
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.errors import ConfigurationError, DataError
from omsm_ros.quantities import COUNTER
from omsm_ros.twin.cell import Cell, Probe, blocks_of, record
from omsm_ros.twin.plant import PAPER_STATIC_GAIN, Plant


def motion(time: np.ndarray) -> dict[str, np.ndarray]:
    return {
        "x": 12e-3 - 5e-5 * time,
        "y": np.zeros_like(time),
        "z": 0.5e-3 * np.sin(2 * np.pi * 6.0 * time),
        "b": np.zeros_like(time),
        "c": np.pi * time,
    }


def axis_blocks(
    rate: float = 4000.0, start: float = 0.0, seconds: float = 2.0, jitter: float = 0.0
) -> list[AxisBlock]:
    """Blocks of 100 samples whose true times are ``start + k / rate``."""
    random = np.random.default_rng(7)
    blocks = []
    for first in range(0, round(seconds * rate), 100):
        time = start + (first + np.arange(100)) / rate
        stamp = time[0] + jitter * random.normal()
        blocks.append(
            AxisBlock(
                stamp_ns=round(stamp * 1e9),
                first_sample=first,
                sample_period=1 / rate,
                **motion(time),
            )
        )
    return blocks


def probe_blocks(
    rate: float = 1000.0, start: float = 0.1, seconds: float = 1.5
) -> list[DistanceBlock]:
    return [
        DistanceBlock(
            stamp_ns=round((start + first / rate) * 1e9),
            first_sample=50_000 + first,
            sample_period=1 / rate,
            distance=np.zeros(70),
        )
        for first in range(0, round(seconds * rate) - 70, 70)
    ]


def joined(found: Iterable[AxisBlock]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    blocks = list(found)
    values = {n: np.concatenate([getattr(b, n) for b in blocks]) for n in "xyzbc"}
    time = np.concatenate([b.stamp_ns * 1e-9 + np.arange(len(b)) * b.sample_period for b in blocks])
    return time, values


@pytest.mark.parametrize("rate", [700.0, 1000.0, 4321.0])
def test_axes_are_interpolated_to_the_probes_times(rate: float) -> None:
    found = axes_at_probe(axis_blocks(rate, start=0.0123e-3), probe_blocks())
    time, values = joined(found)
    expected = motion(time)
    assert np.allclose(values["z"], expected["z"], rtol=0, atol=0.1e-9)
    assert np.allclose(values["c"], expected["c"], rtol=0, atol=1e-9)


def test_blocks_carry_the_probes_counts_and_stamps() -> None:
    probe = probe_blocks()
    found = axes_at_probe(axis_blocks(), probe)
    assert [(b.first_sample, b.stamp_ns, b.sample_period, len(b)) for b in found] == [
        (b.first_sample, b.stamp_ns, b.sample_period, len(b)) for b in probe
    ]


def test_a_delay_of_the_probe_is_taken_off() -> None:
    _, values = joined(axes_at_probe(axis_blocks(), probe_blocks(), delay=0.4e-3))
    time, _ = joined(axes_at_probe(axis_blocks(), probe_blocks()))
    assert np.allclose(values["z"], motion(time + 0.4e-3)["z"], rtol=0, atol=0.1e-9)


def test_an_exposure_averages_the_motion() -> None:
    exposure = 5e-3
    time, values = joined(axes_at_probe(axis_blocks(), probe_blocks(), exposure=exposure))
    expected = motion(time)["z"] * np.sinc(6.0 * exposure)
    assert np.allclose(values["z"], expected, rtol=0, atol=0.2e-9)
    assert 1 - np.sinc(6.0 * exposure) > 1e-4


def test_jitter_of_stamps_is_averaged_over_the_session() -> None:
    blocks = axis_blocks(jitter=0.2e-3, seconds=20.0)
    clock = fit_clock(blocks)
    time = clock.since(np.array([0.0, 40_000.0]), 0)
    # 800 stamps know their line to jitter / sqrt(800), at the ends to twice that.
    assert np.allclose(time, [0.0, 10.0], rtol=0, atol=50e-6)


def test_a_clock_that_runs_fast_is_followed() -> None:
    true_rate = 1000.0 * (1 + 50e-6)
    blocks = [
        Block(stamp_ns=round(k * 100 / true_rate * 1e9), first_sample=k * 100, sample_period=1e-3)
        for k in range(600)
    ]
    clock = fit_clock(blocks)
    assert clock.period_ns == pytest.approx(1e9 / true_rate, rel=1e-9)


def test_stamps_in_time_lapse_are_refused() -> None:
    blocks = [replace(b, stamp_ns=b.stamp_ns // 10) for b in axis_blocks()]
    with pytest.raises(DataError, match="time lapse"):
        fit_clock(blocks)


@pytest.mark.parametrize("last_ms", [0, -200, 150, 600])
def test_a_few_stamps_that_scatter_say_nothing_of_the_rate(last_ms: int) -> None:
    """A line through three stamps, one of them a second late, would let time fall."""
    still = np.zeros(100)
    blocks = [
        AxisBlock(
            stamp_ns=stamp * 1_000_000,
            first_sample=100 * k,
            sample_period=1e-3,
            **dict.fromkeys("xyzbc", still),
        )
        for k, stamp in enumerate((500, 1500, 500 + last_ms))
    ]
    clock = fit_clock(blocks)
    assert clock.period_ns == 1e6
    assert clock.since(np.array([100.0]), 0)[0] == pytest.approx((2.5 + last_ms / 1e3) / 3)
    axes_at_probe(blocks, probe_blocks())


def test_what_the_axes_do_not_cover_is_no_number() -> None:
    axes = axis_blocks()
    found = axes_at_probe(axes[:30] + axes[40:], probe_blocks(start=-0.05))
    time, values = joined(found)
    lost = ~np.isfinite(values["z"])
    gap = (time > 2999 / 4000) & (time < 1.0 - 1e-9)
    assert np.array_equal(lost, gap | (time < 0))


def test_repeated_blocks_bring_nothing_new() -> None:
    axes = axis_blocks()
    once = joined(axes_at_probe(axes, probe_blocks()))[1]["z"]
    twice = joined(axes_at_probe([b for a in axes for b in (a, a)], probe_blocks()))[1]["z"]
    assert np.array_equal(once, twice)


def test_too_few_axis_samples_are_refused() -> None:
    with pytest.raises(DataError, match="run of 6 finite axis samples"):
        axes_at_probe([], probe_blocks())


@pytest.mark.parametrize("wrong", [{"exposure": -1e-3}, {"exposure": np.inf}, {"delay": np.nan}])
def test_a_senseless_exposure_or_delay_is_named(wrong: dict[str, float]) -> None:
    with pytest.raises(ConfigurationError, match=next(iter(wrong))):
        axes_at_probe(axis_blocks(), probe_blocks(), **wrong)


def test_a_scan_with_two_clocks_is_corrected_like_one_with_a_trigger() -> None:
    probe = Probe(noise=0.0, resolution=0.0)
    spiral = Spiral(PAPER_MIRROR, start_radius=12.7e-3, feed_per_turn=5e-3, spindle_speed=30.0)
    made = record(Cell(probe=probe, encoder_noise=0.0, sample_period=0.25e-3), spiral, PAPER_MIRROR)
    # The probe reads every fourth of the fine samples and counts them for itself.
    every = slice(3, None, 4)
    read = DistanceBlock(
        stamp_ns=round(3 * 0.25e-3 * 1e9),
        first_sample=9,
        sample_period=1e-3,
        distance=made.distance.distance[every],
        status=made.distance.status[every],
    )
    axes = axes_at_probe([a for a, _ in blocks_of(made, 100)], [read])
    known = Calibration(
        dynamics=Plant().dynamics,
        static_gain=PAPER_STATIC_GAIN,
        sample_period=1e-3,
        valid_up_to=100.0,
        covariance=np.zeros((7, 7)),
    )
    corrector = Corrector(known, CorrectionOptions())
    for block in axes:
        corrector.push_axes(block)
    corrector.push_distance(read)
    points = join_points([corrector.finish()])
    truth = made.surface_height[every][points.sample - 9]
    assert len(points) > 4900
    assert np.max(abs(points.height - truth)) < 0.1e-9


def test_counts_are_distinguished_up_to_the_highest_accepted() -> None:
    """Two samples beyond 2**53 had one time."""
    axes, probe = axis_blocks(), probe_blocks()
    above = int(COUNTER.high) - axes[-1].first_sample
    high = axes_at_probe([replace(b, first_sample=b.first_sample + above) for b in axes], probe)
    _, found = joined(high)
    _, usual = joined(axes_at_probe(axes, probe))
    # The middle of so high counts is known to one in 2**53, a count at most.
    np.testing.assert_allclose(found["z"], usual["z"], atol=0.5e-3 * 2 * np.pi * 6.0 / 4000)
    with pytest.raises(DataError, match="counter is corrupt"):
        replace(axes[0], first_sample=2**53)


def as_a_bag_gives_them(blocks: list[AxisBlock] | list[DistanceBlock]) -> list[Block]:
    """Messages that follow on as one block, which begins anew with each that does not."""
    runs = [[blocks[0]]]
    for block in blocks[1:]:
        if block.first_sample == runs[-1][-1].end:
            runs[-1].append(block)
        else:
            runs.append([block])
    return [
        replace(merging.joined(run), parts=np.array([(b.first_sample, b.stamp_ns) for b in run]))
        for run in runs
    ]


def test_messages_that_a_bag_joins_are_moved_as_each_by_itself() -> None:
    """Jitter, gaps, repeats, one that comes late, a device that begins anew."""
    axes, probe = axis_blocks(jitter=2e-5), probe_blocks()
    axes = axes[:20] + axes[21:30] + axes[28:]
    probe = probe[:5] + probe[6:9] + [probe[5]] + probe[7:15]
    again = [
        replace(b, first_sample=b.first_sample - 50_000, stamp_ns=b.stamp_ns + 100_000)
        for b in probe_blocks()[15:]
    ]
    expected = joined(axes_at_probe(axes, probe + again))
    together = as_a_bag_gives_them(axes), as_a_bag_gives_them(probe + again)
    assert len(together[0]) == 3
    assert len(together[1]) == 5
    found = list(axes_at_probe(*together))
    assert np.concatenate([b.stamps for b in found])[:, 1].tolist() == [
        b.stamp_ns for b in probe[:8] + probe[11:] + again
    ]
    for name, values in joined(found)[1].items():
        assert values.tobytes() == expected[1][name].tobytes(), name
