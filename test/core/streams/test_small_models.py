"""Counts, clocks and scatters against the same by sets, plain loops, polyfit and draws."""

from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from omsm_ros.core.streams.blocks import (
    MAX_BLOCK_SAMPLES,
    AccelerationBlock,
    Account,
    AxisBlock,
    Block,
    DistanceBlock,
    RejectionReason,
    Tally,
    consecutive,
    joined,
    uninterrupted,
)
from omsm_ros.core.streams.continuity import TriggerCount
from omsm_ros.core.streams.monitoring import LoadMeter, Playback, RecentIncrease, SampleFlow
from omsm_ros.core.streams.motion_record import BlockBuffer
from omsm_ros.core.streams.stamps import StampClock, fit_clock, period_fault
from omsm_ros.core.streams.statistics import (
    EvenSelection,
    RunningScatter,
    median,
    noise_of,
    spread,
    spread_about_median,
)
from omsm_ros.core.streams.stream_faults import StreamWatch, counter_skew, skew_fault
from omsm_ros.core.streams.trigger_slips import CommonTrigger
from omsm_ros.errors import DataError

few = settings(max_examples=40)
PERIOD = 1e-3


def distance(first, length=10, stamp_ns=None, values=None):
    return DistanceBlock(
        stamp_ns=first * 1_000_000 if stamp_ns is None else stamp_ns,
        first_sample=first,
        sample_period=PERIOD,
        distance=np.zeros(length) if values is None else values,
    )


blocks_in_any_order = st.lists(
    st.tuples(st.integers(0, 120), st.integers(1, 25)), min_size=1, max_size=20
)


class TestCounts:
    @few
    @given(blocks_in_any_order)
    def test_new_late_and_repeated_samples_are_those_of_sets(self, sent):
        """Gaps, overlaps, repeats and late blocks of one session, sample by sample."""
        count, seen, start, end = TriggerCount(), set(), None, None
        for first, length in sent:
            block = distance(first, length, stamp_ns=0)
            arrival = count.place(block, length)
            own = range(first, first + length)
            before = first if end is None else end
            start = first if start is None else start
            late = [k for k in own if start <= k < before and k not in seen]
            assert arrival.session == 0
            assert arrival.skip == sum(k < before for k in own)
            assert arrival.missing == max(first - before, 0)
            assert arrival.late == len(late)
            end = max(before, first + length)
            seen |= set(own)

    @few
    @given(blocks_in_any_order)
    def test_a_watch_accounts_for_every_trigger_of_its_session(self, sent):
        watch = StreamWatch()
        placed = sorted(sent)
        for first, length in placed:
            watch.add(distance(first, length))
        held = {k for first, length in placed for k in range(first, first + length)}
        spanned = max(held) - min(held) + 1
        assert watch.missing == spanned - len(held)
        assert watch.repeated == sum(length for _, length in placed) - len(held)
        assert watch.samples == sum(length for _, length in placed)
        assert next(watch.marks())[0, 1] == placed[0][0] * 1_000_000

    def test_a_late_block_that_comes_twice_fills_its_gap_once(self):
        watch = StreamWatch()
        for first in (0, 20, 40, 10, 10):
            watch.add(distance(first))
        assert (watch.missing, watch.repeated) == (10, 10)
        said = list(map(str, watch.faults("probe")))
        assert "10 trigger numbers are missing" in said[0]
        assert "10 samples repeat" in said[1]

    @few
    @given(st.lists(st.tuples(st.integers(1, 4), st.integers(1, 30)), min_size=1, max_size=30))
    def test_runs_and_joined_blocks_hold_every_sample_once_in_its_order(self, parts):
        blocks, first = [], 0
        for gap, length in parts:
            first += gap - 1 if gap < 3 else 0
            blocks.append(distance(first, length, values=np.arange(first, first + length) * 1e-9))
            first += length
        runs = uninterrupted(blocks)
        assert [b for run in runs for b in run] == blocks
        assert all(b.first_sample == a.end for run in runs for a, b in pairwise(run))
        assert all(b[0].first_sample != a[-1].end for a, b in pairwise(runs))
        made = [joined(run) for run in consecutive(blocks)]
        for whole, run in zip(made, consecutive(blocks), strict=True):
            np.testing.assert_array_equal(whole.distance, np.concatenate([b.distance for b in run]))
            assert (whole.first_sample, whole.stamp_ns) == (run[0].first_sample, run[0].stamp_ns)
            expected = np.arange(whole.first_sample, whole.end) * 1e-9
            np.testing.assert_array_equal(whole.distance, expected)
        assert sum(map(len, made)) == sum(map(len, blocks))

    @few
    @given(st.lists(st.tuples(st.sampled_from(RejectionReason), st.integers(0, 9)), max_size=12))
    def test_a_tally_is_a_sum_however_it_was_counted(self, entries):
        at_once, each, expected = Tally(), Tally(), Counter()
        for reason, samples in entries:
            at_once.count(reason, samples)
            each.count_each(np.full(samples, reason, np.uint8))
            expected[reason] += samples
        assert at_once.snapshot(2) == each.snapshot(2)
        found = at_once.snapshot(2)
        assert found.corrected == expected.pop(RejectionReason.NONE, 0)
        assert found.counted == {r.name.lower(): n for r, n in expected.items() if n}
        assert list(found.counted) == [r.name.lower() for r in RejectionReason if expected[r]]
        assert Account().as_dict()["axes"]["pending"] == 0


class TestBlocks:
    def test_a_block_ends_where_the_next_one_begins(self):
        assert distance(7, 5).end == 12
        with pytest.raises(NotImplementedError):
            len(Block(stamp_ns=0, first_sample=0, sample_period=PERIOD))

    def test_more_samples_than_any_device_sends_are_refused_by_their_number(self):
        with pytest.raises(DataError, match=f"4000001 samples, expected 1 to {MAX_BLOCK_SAMPLES}"):
            distance(0, values=np.broadcast_to(0.0, MAX_BLOCK_SAMPLES + 1))

    @pytest.mark.parametrize(
        ("made", "channel", "bad"),
        [
            (AxisBlock, "z", 101.0),
            (AxisBlock, "c", 2e9),
            (AccelerationBlock, "y", -2e6),
            (AccelerationBlock, "x", np.inf),
        ],
    )
    def test_what_is_not_plausible_was_not_measured(self, made, channel, bad):
        names = "xyzbc" if made is AxisBlock else "xyz"
        channels = {name: np.array([1.0, 2.0, 3.0]) for name in names}
        channels[channel] = np.array([1.0, bad, 3.0])
        block = made(stamp_ns=0, first_sample=0, sample_period=PERIOD, **channels)
        np.testing.assert_array_equal(getattr(block, channel), [1.0, np.nan, 3.0])
        other = next(name for name in names if name != channel)
        np.testing.assert_array_equal(getattr(block, other), [1.0, 2.0, 3.0])
        assert len(block) == 3

    @pytest.mark.parametrize("name", ["intensity", "status"])
    def test_channels_of_a_probe_fit_each_other(self, name):
        with pytest.raises(
            DataError, match=r"DistanceBlock: channels of different lengths \[2, 3\]"
        ):
            DistanceBlock(
                stamp_ns=0, first_sample=0, sample_period=PERIOD, distance=np.zeros(3),
                **{name: np.zeros(2, np.uint8)},
            )  # fmt: skip


class TestClocks:
    def stamped(self, jitter, count=40, period=PERIOD * (1 + 3e-4), seed=1, first=1_000_000):
        late = np.random.default_rng(seed).normal(0, jitter, count)
        return [
            distance(first + 50 * k, 50, round(5e9 + 1e9 * (50 * k * period + late[k])))
            for k in range(count)
        ]

    @pytest.mark.parametrize("jitter", [1e-4, 1e-3])
    def test_a_clock_is_the_line_through_its_stamps(self, jitter):
        blocks = self.stamped(jitter)
        count = np.array([b.first_sample - blocks[0].first_sample for b in blocks])
        stamps = np.array([b.stamp_ns - 5_000_000_000 for b in blocks])
        slope, start = np.polyfit(count, stamps, 1)
        clock = fit_clock(blocks)
        assert clock.period_ns == pytest.approx(slope, rel=1e-9)
        found = clock.since(np.array([1_000_000.0, 1_002_000.0]), 5_000_000_000)
        np.testing.assert_allclose(found, (start + slope * np.array([0, 2000])) / 1e9, atol=1e-9)

    def test_one_block_is_as_even_as_it_says(self):
        clock = fit_clock(self.stamped(0.0, 1))
        assert clock.period_ns == PERIOD * 1e9
        assert clock.since(np.array([1_000_010.0]), 5_000_000_000) == pytest.approx(10e-3)

    def test_a_time_is_exact_however_long_ago_the_origin_is(self):
        clock = StampClock(2**52, 1_760_000_000_000_000_000, 0.25, 1e6, 0.0)
        found = clock.since(np.array([2.0**52 + 3]), 1_760_000_000_000_000_000)
        assert found[0] == pytest.approx(3e-3 + 0.25e-9, abs=1e-15)

    def test_the_stamped_period_and_its_uncertainty_are_those_of_a_fitted_line(self):
        blocks = self.stamped(1e-3)
        count = np.array([b.first_sample for b in blocks]) - 1_000_000
        stamps = np.array([b.stamp_ns - 5_000_000_000 for b in blocks]) / 1e9
        (slope, _), covariance = np.polyfit(count, stamps, 1, cov=True)
        found = StampClock.through(np.concatenate([b.stamps for b in blocks]), PERIOD * 1e9)
        assert found.period_ns == pytest.approx(1e9 * slope, rel=1e-9)
        assert found.period_uncertainty_ns == pytest.approx(
            1e9 * np.sqrt(covariance[0, 0]), rel=1e-6
        )

    def test_blocks_of_one_count_have_no_period(self):
        assert period_fault("probe", np.tile(distance(5).stamps, (6, 1)), PERIOD) is None

    def test_stamps_that_a_stated_offset_or_tolerance_explains_are_no_fault(self):
        axes, probe = StreamWatch(), StreamWatch()
        for block in self.stamped(0.0):
            axes.add(block)
        for block in self.stamped(0.0, first=1_000_003):
            probe.add(block)
        skew = counter_skew(axes, probe)
        assert skew == pytest.approx(3e-3, rel=0.01)
        (said,) = map(str, skew_fault(skew, PERIOD))
        assert "axes are stamped 3.001 ms later" in said
        assert not list(skew_fault(skew, PERIOD, CommonTrigger(counter_offset=-3)))
        assert not list(skew_fault(skew, PERIOD, CommonTrigger(stamp_tolerance=2.6e-3)))
        assert list(skew_fault(skew, PERIOD, CommonTrigger(stamp_tolerance=2.4e-3)))


class TestScatter:
    @pytest.mark.parametrize("count", [1, 2, 5, 8, 301])
    def test_the_median_is_numpys(self, count):
        values = np.random.default_rng(count).normal(size=count)
        assert median(values) == pytest.approx(np.median(values), abs=1e-15)

    def test_of_normal_values_it_is_their_deviation_whatever_some_are(self):
        values = np.random.default_rng(1).normal(0, 3.0, 20_000)
        dusty = values.copy()
        dusty[::50] = 1e6
        for found in (spread(dusty), spread_about_median(7.0 + dusty)):
            assert found == pytest.approx(3.0, rel=0.05)
        assert spread(7.0 + values) > 6.0

    def test_noise_is_distinguished_from_locally_straight_signals(self):
        rng = np.random.default_rng(2)
        place = np.arange(8000.0)
        noise = rng.normal(0, 5e-9, 8000)
        assert noise_of(noise) == pytest.approx(5e-9, rel=0.05)
        np.testing.assert_allclose(noise_of(noise + 1e-6 * place + 3.0), noise_of(noise), rtol=1e-3)
        assert noise_of(1e-6 * place) < 1e-18

    def test_a_scatter_is_that_of_the_last_two_seconds_and_no_form(self):
        rng = np.random.default_rng(3)
        time = np.arange(20_000) * PERIOD
        noise = rng.normal(0, np.where(time < 10, 5e-9, 25e-9))
        form = 0.2e-3 * np.sin(2 * np.pi * 2.0 * time)
        excess = RunningScatter(5e-9).excess(0, np.arange(20_000), form + noise)
        assert not excess[:9000].any()
        expected = 25e-9**2 - 5e-9**2
        assert np.mean(excess[18_000:]) == pytest.approx(expected, rel=0.15, abs=0)

    def test_sixth_differences_over_a_gap_are_none(self):
        """Heights before and after a pause have nothing to do with each other."""
        rng = np.random.default_rng(4)
        sample = np.r_[np.arange(3000), np.arange(9000, 12_000)]
        height = rng.normal(0, 5e-9, 6000) + np.where(sample < 3000, 0.0, 1e-3)
        assert not RunningScatter(5e-9).excess(0, sample, height).any()

    def test_without_an_expectation_every_scatter_is_excess(self):
        height = np.random.default_rng(5).normal(0, 5e-9, 9000)
        excess = RunningScatter(0.0).excess(0, np.arange(9000), height)
        assert np.mean(excess[4000:]) == pytest.approx(25e-18, rel=0.15, abs=0)
        assert not RunningScatter(0.0).excess(0, np.arange(9000), np.zeros(9000)).any()


class TestLately:
    @few
    @given(st.lists(st.tuples(st.floats(0.1, 6.0), st.integers(0, 5)), min_size=1, max_size=25))
    def test_an_increase_is_that_since_the_look_before_the_window(self, looks):
        recent, now, value, seen = RecentIncrease(), 0.0, 0, []
        for after, more in looks:
            now += after
            value += more
            seen.append((now, value))
            found = recent.update({"lost": value}, now)
            older = [v for t, v in seen if t <= now - 10.0]
            expected = value - (older[-1] if older else 0)
            assert found == ({"lost": expected} if expected else {})

    @few
    @given(st.lists(st.tuples(st.floats(0.1, 4.0), st.integers(0, 5)), min_size=2, max_size=25))
    def test_silence_and_rate_are_those_of_the_looks(self, looks):
        flow, now, samples, seen, last = SampleFlow(), 0.0, 0, [], None
        for after, more in looks:
            now += after
            samples += more
            last = now if more else last
            seen.append((now, samples))
            flow.update(samples, now)
        silent = flow.silent(now + 1.0)
        assert silent == (None if last is None else pytest.approx(now + 1.0 - last))
        older = [look for look in seen[:-1] if look[0] <= now - 10.0]
        start, before = older[-1] if older else seen[0]
        assert flow.rate == pytest.approx((samples - before) / (now - start))

    def test_the_worst_latency_is_that_since_it_was_asked_for(self):
        meter = LoadMeter()
        meter.block(0, 3_000_000)
        meter.block(0, 1_000_000)
        assert meter.worst_ms() == pytest.approx(3.0)
        assert meter.worst_ms() == 0.0
        meter.block(5_000_000, 7_000_000)
        assert meter.worst_ms() == pytest.approx(2.0)

    def test_a_time_that_is_gone_to_goes_on_from_there(self):
        playback = Playback(0, 4.0)
        playback.resume(1.0)
        playback.go_to(8_000_000_000, 2.0)
        assert not playback.paused
        assert playback.time_ns(3.0) == 12_000_000_000
        assert playback.late(12_000_000_000, 3.0) == 0.0


class TestKept:
    @few
    @given(st.lists(st.integers(0, 90), min_size=1, max_size=12), st.integers(1, 20))
    def test_who_makes_only_the_chosen_rows_keeps_the_same(self, parts, most):
        whole, chosen, first = EvenSelection(most), EvenSelection(most), 0
        for length in parts:
            rows = np.arange(first, first + length)
            whole.add(rows)
            wanted = rows[chosen.chosen(length)]
            chosen.add_chosen(wanted, length)
            first += length
        np.testing.assert_array_equal(chosen.rows(), whole.rows())
        assert chosen.every == whole.every
        np.testing.assert_array_equal(whole.rows(), np.arange(0, first, whole.every))

    def test_what_is_forgotten_by_request_is_counted_and_gone(self):
        buffer = BlockBuffer(1000)
        for first in (0, 10, 20):
            buffer.add(distance(first))
        buffer.forget()
        assert (len(buffer), buffer.forgotten, buffer.recent()) == (0, 30, [])
        buffer.add(distance(5))
        assert [block.first_sample for block in buffer.recent()] == [5]
