"""Columns of other programs: units by their definition, counts by plain loops, each refusal."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from omsm_ros.core.streams.blocks import Status
from omsm_ros.core.streams.imported_columns import (
    CHANNELS,
    Column,
    ColumnMap,
    TableRows,
    axis_blocks,
    check_epoch,
    counter_of_times,
    counter_of_triggers,
    distance_blocks,
    period_of,
    share_trigger,
)
from omsm_ros.errors import DataError
from omsm_ros.units import UNITS, contradicts_unit

STOOD = {axis: Column("") for axis in "xybc"}
Z = {"z": Column("Z"), **STOOD}
few = settings(max_examples=40)


class TestUnits:
    @pytest.mark.parametrize(
        ("channel", "unit", "value"),
        [
            ("x", "mm", 1e-3), ("z", "um", 1e-6), ("distance", "µm", 1e-6), ("y", "nm", 1e-9),
            ("z", "m", 1.0), ("distance", "inch", 25.4e-3), ("c", "deg", np.pi / 180),
            ("b", "turn", 2 * np.pi), ("c", "mrad", 1e-3), ("intensity", "%", 0.01),
            ("time", "ms", 1e-3), ("time", "us", 1e-6), ("time", "ns", 1e-9),
            ("time", "unix_ms", 1e-3), ("time", "unix_ns", 1e-9), ("trigger", "1", 1.0),
        ],
    )  # fmt: skip
    def test_one_of_each_is_so_much_in_si(self, channel, unit, value):
        assert UNITS[channel][unit] == pytest.approx(value, rel=1e-12)

    def test_every_channel_has_one_that_is_si(self):
        assert set(UNITS) == set(CHANNELS)
        assert all(1.0 in units.values() for units in UNITS.values())

    @pytest.mark.parametrize(
        ("unit", "stated", "contradicted"),
        [("mm", "mm", False), ("mm", "um", True), ("um", "µm", False), ("mm", "furlong", False)],
    )
    def test_a_files_own_word_contradicts_where_it_means_another_one(
        self, unit, stated, contradicted
    ):
        assert contradicts_unit(stated, unit, "z") is contradicted
        assert not contradicts_unit(stated, "", "z")


class TestMap:
    def mapped(self, columns=None, **options):
        return ColumnMap(Z if columns is None else columns, **({"sample_period": 1e-3} | options))

    def test_columns_of_some_channels_are_those_that_did_not_stand_still(self):
        mapped = self.mapped({**Z, "distance": Column("D")})
        assert mapped.names(("x", "z", "distance", "intensity")) == ["Z", "D"]
        assert (mapped.has("z"), mapped.has("x"), mapped.has("time")) == (True, False, False)
        assert not mapped.dated

    @pytest.mark.parametrize("unit", ["date", "unix", "unix_ns"])
    def test_times_since_1970_are_dates_and_bear_no_start(self, unit):
        columns = {**Z, "time": Column("t", unit=unit)}
        assert self.mapped(columns).dated
        with pytest.raises(DataError, match=r"start is 1\.76e\+09 s.*holds dates; leave start out"):
            self.mapped(columns, start=1.76e9)

    @pytest.mark.parametrize(
        ("columns", "options", "said"),
        [
            ({**Z, "w": Column("W")}, {}, r"channel 'w' is unknown, expected one of x"),
            (Z, {"sample_period": None}, "neither sample_period nor a column of time"),
            (Z, {"sample_period": 1e-9}, "sample_period is 1e-09 s"),
            (Z, {"sample_period": np.nan}, "sample_period is nan"),
            (Z, {"start": np.inf}, "start is inf"),
            (Z, {"start": 3e9}, "start is 3000000000000000000"),
            (STOOD, {}, "neither z nor distance has a column"),
            ({"intensity": Column("I")}, {}, "neither z nor distance has a column"),
            ({"z": Column("Z")}, {}, r"no column for x, y, b, c, which z needs.*x: {constant: 0}"),
            ({"distance": Column("D"), "x": Column("X")}, {}, "no column for y, z, b, c, which x"),
        ],
    )
    def test_what_is_missing_or_senseless_is_named_with_its_remedy(self, columns, options, said):
        with pytest.raises(DataError, match=said):
            self.mapped(columns, **options)

    def test_a_probe_alone_needs_no_axes(self):
        assert self.mapped({"distance": Column("D")}).names(("distance",)) == ["D"]


class TestPeriods:
    @few
    @given(
        st.floats(1e-4, 1.0),
        st.lists(st.integers(1, 4), min_size=1, max_size=60),
        st.floats(0.0, 0.02),
    )
    def test_it_is_the_grid_of_the_times_whatever_is_missing(self, period, steps, jitter):
        # More neighbours than gaps, as in any recording that is mostly there.
        steps = [*steps, *([1] * (len(steps) + 2))]
        place = np.cumsum([0, *steps])
        off = jitter * np.random.default_rng(1).uniform(-1, 1, len(place))
        off[[0, -1]] = 0.0
        assert period_of(period * (place + off), None) == pytest.approx(period, rel=1e-9)

    def test_a_stated_period_stands_where_time_agrees(self):
        times = np.arange(100) * 1.0005e-3
        assert period_of(times, 1e-3) == 1e-3
        assert period_of(times, None) == pytest.approx(1.0005e-3)

    @pytest.mark.parametrize(
        ("times", "stated", "said"),
        [
            ([0.0], None, "1 rows of time, expected at least 2"),
            (
                [0.0, 1.0, 1.0],
                None,
                "time does not rise from 1 s to 1 s at row 2; sort the rows by time",
            ),
            ([0.0, 2.0, 1.0], None, "time does not rise from 2 s to 1 s at row 2"),
            ([0.0, np.nan, 1.0], None, r"time\[1\] is nan"),
            (np.arange(50) * 1.1e-3, 1e-3, r"sample_period is 0\.001 s, but .* says 0\.0011 s"),
            (np.arange(5) * 20.0, None, "sample period of the column time is 20.0 s"),
        ],
    )
    def test_times_that_are_none_are_refused_with_the_row(self, times, stated, said):
        with pytest.raises(DataError, match=said):
            period_of(np.asarray(times, float), stated)

    def test_uneven_stamps_are_distinguished_from_a_wrong_period(self):
        times = np.cumsum(np.random.default_rng(2).uniform(0.5e-3, 1.9e-3, 400))
        with pytest.raises(DataError, match=r"\d+% of the times lie off an even grid; if only"):
            period_of(times, 1e-3)

    @pytest.mark.parametrize(
        ("starts", "periods", "said"),
        [
            ([0.0, 5e-3], [1e-3, 1e-3], True),
            ([10.0, 0.0], [1e-3, 1.0005e-3], True),
            ([0.0, 5.2e-3], [1e-3, 1e-3], True),
            ([0.0, 5.5e-3], [1e-3, 1e-3], False),
            ([0.0, 5e-3], [1e-3, 1.002e-3], False),
            ([0.0, 5e-3], [1e-3, 2e-3], False),
            ([3.0], [1e-3], True),
        ],
    )
    def test_streams_in_step_have_one_period_and_fall_on_one_grid(self, starts, periods, said):
        assert share_trigger(starts, periods) is said


class TestCounting:
    @few
    @given(st.lists(st.integers(1, 5), min_size=1, max_size=40), st.floats(-0.1, 0.1))
    def test_a_gap_in_time_is_a_gap_in_the_count_in_pieces_as_at_once(self, steps, off):
        place = np.cumsum([0, *steps])
        times = 7.0 + 1e-3 * (place + off * (np.arange(len(place)) % 2))
        whole = counter_of_times(times, 1e-3, None)
        assert whole.tolist() == place.tolist()
        half = len(times) // 2
        first = counter_of_times(times[:half], 1e-3, None) if half else np.array([], int)
        before = (times[half - 1], int(first[-1])) if half else None
        then = counter_of_times(times[half:], 1e-3, before)
        assert [*first, *then] == place.tolist()

    def test_a_clock_that_drifts_by_a_sample_over_the_recording_miscounts_none(self):
        times = np.arange(20_000) * 1.0001e-3
        assert counter_of_times(times, 1e-3, None)[-1] == 19_999

    @pytest.mark.parametrize(
        ("times", "said"),
        [
            ([0.0, 1e-3, 2.5e-3], r"time 0\.0025 s comes 1\.5 periods of 0\.001 s after the row"),
            ([0.0, 1e-3, 1e-3], r"time 0\.001 s does not rise; sort the rows by time"),
            ([0.0, 2e-3, 1e-3], "does not rise"),
            ([0.0, 1e11], r"time\[1\] is 100000000000"),
        ],
    )
    def test_times_between_two_samples_or_before_one_are_refused(self, times, said):
        with pytest.raises(DataError, match=said):
            counter_of_times(np.array(times), 1e-3, None)

    def test_trigger_numbers_are_themselves(self):
        found = counter_of_triggers(np.array([5.0, 6.0, 9.0]), 4)
        assert (found.tolist(), found.dtype) == ([5, 6, 9], np.int64)

    @pytest.mark.parametrize(
        ("values", "before", "said"),
        [
            ([5.0, 6.5], 4, r"trigger is 6\.5 in the row after 5, expected whole numbers"),
            ([np.nan], 4, "trigger is nan in the row after 4"),
            ([5.0, np.inf], 4, "trigger is inf in the row after 5"),
            ([5.0, 5.0], 4, "trigger 5 is followed by 5; delete the row"),
            ([4.0], 4, "trigger 4 is followed by 4"),
            ([5.0, 9.0, 7.0], 4, "trigger 9 is followed by 7"),
            ([-5.0], -9, r"trigger\[0\] is -5"),
        ],
    )
    def test_trigger_numbers_that_are_none_are_refused_with_the_row(self, values, before, said):
        with pytest.raises(DataError, match=said):
            counter_of_triggers(np.array(values), before)


class TestEpochs:
    NOW = 1.76e9

    @pytest.mark.parametrize(
        ("raw", "unit", "factor", "start"),
        [
            (NOW, "unix", 1.0, 0.0),
            (1e3 * NOW, "unix_ms", 1e-3, 0.0),
            (0.0, "s", 1.0, 0.0),
            (NOW, "date", 1.0, 0.0),
            (NOW, "s", 1.0, NOW),
            (3.0, "ms", 1e-3, 0.0),
        ],
    )
    def test_times_of_their_own_unit_pass(self, raw, unit, factor, start):
        check_epoch(raw * factor, Column("t", factor, unit=unit), start)

    @pytest.mark.parametrize(
        ("raw", "unit", "factor", "said"),
        [
            (1e3 * NOW, "unix", 1.0, "no instant in unix; write unit: unix_ms"),
            (1e9 * NOW, "unix_us", 1e-6, "no instant in unix_us; write unit: unix_ns"),
            (NOW, "s", 1.0, "looks like a date; write unit: unix if it counts from 1970"),
            (1e3 * NOW, "ms", 1e-3, "looks like a date; write unit: unix_ms"),
        ],
    )
    def test_an_instant_of_another_unit_is_named(self, raw, unit, factor, said):
        with pytest.raises(DataError, match=said):
            check_epoch(raw * factor, Column("t", factor, unit=unit), 0.0)


class TestBlocks:
    def rows(self, counter, start=0.0, period=1e-3):
        counter = np.asarray(counter)
        return TableRows(counter, (counter - counter[0]) * period, period, start)

    @few
    @given(st.lists(st.sampled_from([1, 1, 1, 2, 7]), min_size=1, max_size=50))
    def test_parts_are_runs_of_consecutive_numbers_that_hold_every_row_once(self, steps):
        counter = np.cumsum([3, *steps])
        parts = list(self.rows(counter).parts())
        held = np.concatenate([counter[part] for part, _, _ in parts])
        np.testing.assert_array_equal(held, counter)
        for part, stamp_ns, first in parts:
            assert first == counter[part][0]
            assert np.all(np.diff(counter[part]) == 1)
            assert stamp_ns == round((first - 3) * 1e6)
        for (before, _, _), (after, _, _) in pairwise(parts):
            assert counter[after.start] - counter[before.stop - 1] > 1

    def test_long_runs_are_cut_where_a_message_would_be_too_long(self):
        parts = list(self.rows(np.arange(25_000)).parts())
        assert [part.stop - part.start for part, _, _ in parts] == [10_000, 10_000, 5000]
        assert [stamp for _, stamp, _ in parts] == [0, 10 * 10**9, 20 * 10**9]

    def test_stamps_of_today_are_right_to_the_nanosecond(self):
        """A float of seconds since 1970 is not."""
        rows = TableRows(np.array([0, 5]), np.array([0.0, 3e-9]), 1e-3, 1_760_000_000.5)
        assert [stamp for _, stamp, _ in rows.parts()] == [
            1_760_000_000_500_000_000, 1_760_000_000_500_000_003,
        ]  # fmt: skip

    def test_axes_are_in_si_and_what_stood_still_has_its_constant(self):
        mapped = ColumnMap(
            {"x": Column("X", -1e-3), "z": Column("Z", 1e-6), "y": Column("", constant=0.25),
             "b": Column(""), "c": Column("C", np.pi / 180)}, 1e-3,
        )  # fmt: skip
        table = {"X": np.array([1.0, 2.0, 3.0]), "Z": np.arange(3.0), "C": np.full(3, 90.0)}
        first, second = axis_blocks(table, mapped, self.rows([0, 1, 4]))
        np.testing.assert_allclose(first.x, [-1e-3, -2e-3])
        np.testing.assert_allclose(second.z, [2e-6])
        np.testing.assert_allclose(first.y, 0.25)
        np.testing.assert_allclose(first.c, np.pi / 2)
        assert not first.b.any()
        assert (second.first_sample, second.stamp_ns, second.sample_period) == (4, 4_000_000, 1e-3)

    def test_error_codes_and_no_numbers_are_no_target(self):
        columns = {"distance": Column("D", 1e-6), "intensity": Column("I", 0.01)}
        mapped = ColumnMap(columns, 1e-3, invalid=(-9999.0, 0.0))
        table = {
            "D": np.array([5.0, -9999.0, np.nan, 0.0, np.inf]),
            "I": np.array([50.0, 100.0, 0.0, np.nan, 20.0]),
        }
        (block,) = distance_blocks(table, mapped, self.rows(range(5)))
        assert block.distance[0] == pytest.approx(5e-6)
        assert np.isnan(block.distance[1:]).all()
        assert block.status.tolist() == [Status.OK] + [Status.NO_TARGET] * 4
        np.testing.assert_allclose(block.intensity, [0.5, 1.0, 0.0, np.nan, 0.2], rtol=1e-6)
        assert block.intensity.dtype == np.float32

    def test_without_intensity_none_is_made_up_and_a_probe_that_stood_still_may_be(self):
        table = {"D": np.zeros(4)}
        (block,) = distance_blocks(
            table, ColumnMap({"distance": Column("D")}, 1e-3), self.rows(range(4))
        )
        assert len(block.intensity) == 0
        still = ColumnMap({**Z, "distance": Column("", constant=2e-6)}, 1e-3)
        (block,) = distance_blocks({"Z": np.zeros(4)}, still, self.rows(range(4)))
        np.testing.assert_array_equal(block.distance, 2e-6)
