"""Recordings against dictionaries of their samples, and joined clocks against exact polynomials."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.recorded import record_from_arrays
from omsm_ros.core.streams.axes_at_probe import axes_at_probe
from omsm_ros.core.streams.blocks import AxisBlock, DistanceBlock, Status
from omsm_ros.core.streams.motion_record import assemble
from omsm_ros.core.streams.trigger_slips import CommonTrigger
from omsm_ros.errors import DataError

PERIOD = 1e-3
EPOCH = 1_760_000_000_000_000_000


def axis_block(first, z, period=PERIOD, stamp_ns=None):
    zeros = np.zeros(len(z))
    return AxisBlock(
        stamp_ns=EPOCH + round(first * period * 1e9) if stamp_ns is None else stamp_ns,
        first_sample=first, sample_period=period, x=zeros, y=zeros, z=np.asarray(z, float),
        b=zeros, c=zeros,
    )  # fmt: skip


def probe_block(first, values, period=PERIOD, status=None, counter=0, stamp_ns=None):
    given_status = {} if status is None else {"status": np.asarray(status, np.uint8)}
    return DistanceBlock(
        stamp_ns=EPOCH + round(first * period * 1e9) if stamp_ns is None else stamp_ns,
        first_sample=first + counter, sample_period=period, distance=np.asarray(values, float),
        **given_status,
    )  # fmt: skip


pieces = st.lists(
    st.tuples(st.integers(1, 9), st.sampled_from(["kept", "kept", "kept", "lost", "twice", "bad"])),
    min_size=3,
    max_size=12,
)


def streams(parts, make):
    """Blocks one after the other, of which some are lost, come twice, or hold no number."""
    blocks, held, first, twice = [], {}, 10, 0
    for length, fate in parts:
        values = np.arange(first, first + length) * 1e-6
        if fate == "bad":
            values = np.where(np.arange(length) % 2, values, np.nan)
        if fate != "lost":
            block = make(first, values)
            blocks += [block, block] if fate == "twice" else [block]
            twice += length * (fate == "twice")
            held |= {first + k: value for k, value in enumerate(values)}
        first += length
    return blocks, held, twice


class TestByCounter:
    @settings(max_examples=30)
    @given(pieces, pieces, st.integers(0, 2**32 - 1), st.sampled_from([0, 3, -2]))
    def test_a_record_holds_what_a_dictionary_of_its_samples_does(self, one, other, seed, offset):
        axes, positions, _ = streams(one, axis_block)
        probe, readings, repeated = streams(
            other, lambda first, values: probe_block(first, values, counter=-offset)
        )
        trigger = CommonTrigger(counter_offset=offset)
        usable = {k: v for k, v in readings.items() if np.isfinite(v)}
        known = {k: v for k, v in positions.items() if np.isfinite(v)}
        if not set(positions) & set(readings) or not known:
            return
        rng = np.random.default_rng(seed)
        shuffled = [axes[k] for k in rng.permutation(len(axes))]
        record = assemble(shuffled, [probe[k] for k in rng.permutation(len(probe))], (), trigger)
        first = min(positions)
        assert len(record) == max(positions) - first + 1
        for k in range(len(record)):
            at = first + k
            assert record.ok[k] == (at in known and at in usable)
            if at in known:
                assert record.z[k] == known[at]
            if record.ok[k]:
                assert record.distance[k] == usable[at]
        lost = [k for k in range(len(record)) if first + k not in known]
        assert (record.z_lost is None) == (not lost)
        places = sorted(known)
        expected = np.interp(first + np.arange(len(record)), places, [known[k] for k in places])
        np.testing.assert_allclose(record.z, expected, atol=1e-18)
        counts = record.counts
        assert counts["received"] == len(readings) + repeated
        assert counts["duplicates"] == repeated
        assert counts["paired"] == sum(k in known and k in usable for k in readings)
        assert counts["unmatched"] == sum(k not in positions for k in usable)
        reported = sum(counts[name] for name in ("paired", "unmatched", "not_ok", "duplicates"))
        assert reported == counts["received"]

    def test_plain_arrays_are_a_record_of_themselves(self):
        z = np.array([0.0, np.nan, 2.0, 3.0, 4.0])
        seen = np.array([1.0, 1.0, np.nan, 1.0, 1.0])
        ok = np.array([True, True, True, False, True])
        record = record_from_arrays(PERIOD, z, seen, ok, reference=z)
        np.testing.assert_array_equal(record.z, [0.0, 1.0, 2.0, 3.0, 4.0])
        np.testing.assert_array_equal(record.ok, [True, False, False, False, True])
        np.testing.assert_array_equal(record.z_lost, [False, True, False, False, False])
        assert record.counts == {"received": 5, "missing_axis": 1, "not_ok": 2, "paired": 2}
        assert record_from_arrays(PERIOD, np.arange(3), np.arange(3)).z_lost is None

    def test_an_axis_that_was_never_read_stands_at_nothing_and_nothing_is_ok(self):
        record = record_from_arrays(PERIOD, np.full(4, np.nan), np.zeros(4))
        np.testing.assert_array_equal(record.z, 0.0)
        assert not record.ok.any()

    @pytest.mark.parametrize("period", [0.0, -1e-3, np.nan, 11.0])
    def test_a_period_that_is_none_is_refused(self, period):
        with pytest.raises(DataError, match="record: sample_period is"):
            record_from_arrays(period, np.zeros(3), np.zeros(3))

    def test_a_saturated_reading_is_no_reading_and_nothing_else_changes(self):
        axes = [axis_block(0, np.arange(6.0))]
        status = [Status.OK, Status.SATURATED, Status.OK, Status.LOST, Status.OK, 9]
        record = assemble(axes, [probe_block(0, np.ones(6), status=status)])
        np.testing.assert_array_equal(record.ok, [True, False] * 3)
        assert np.isnan(record.distance[1::2]).all()


class TestByStamps:
    # A quintic is its own spline, and three nodes of Gauss integrate it exactly.
    QUINTIC = np.polynomial.Polynomial([1e-3, 2e-3, -3e-3, 1e-3, 4e-3, -2e-3])

    def axes(self, rate=2000.0, seconds=1.0, cut=160, start=0.0):
        count = round(seconds * rate)
        return [
            axis_block(
                first,
                self.QUINTIC(start + (first + np.arange(min(cut, count - first))) / rate),
                1 / rate,
                EPOCH + round((start + first / rate) * 1e9),
            )
            for first in range(0, count, cut)
        ]

    def probe(self, rate=500.0, start=0.2, count=200, counter=7000):
        stamp = EPOCH + round(start * 1e9)
        return [probe_block(counter, np.zeros(count), 1 / rate, stamp_ns=stamp)]

    @pytest.mark.parametrize("exposure", [0.0, 1e-3, 0.05])
    @pytest.mark.parametrize("delay", [-0.01, 0.0, 0.3e-3])
    def test_the_mean_of_a_quintic_over_the_exposure_is_exact(self, delay, exposure):
        (found,) = axes_at_probe(self.axes(), self.probe(), delay=delay, exposure=exposure)
        middle = 0.2 + np.arange(200) / 500 + delay
        whole = self.QUINTIC.integ()
        low, high = middle - exposure / 2, middle + exposure / 2
        expected = (whole(high) - whole(low)) / exposure if exposure else self.QUINTIC(middle)
        np.testing.assert_allclose(found.z, expected, atol=2e-13)

    def test_at_the_axes_own_instants_they_are_what_was_read(self):
        (found,) = axes_at_probe(self.axes(), self.probe(2000.0, 0.1, 300))
        read = np.concatenate([block.z for block in self.axes()])
        np.testing.assert_allclose(found.z, read[200:500], rtol=1e-9)
        assert (found.first_sample, len(found)) == (7000, 300)

    def test_over_an_exposure_that_the_axes_hardly_cover_there_is_no_number(self):
        (found,) = axes_at_probe(self.axes(), self.probe(500.0, 0.0, 500), exposure=10e-3)
        middle = np.arange(500) / 500
        end = 1999 / 2000
        inside = (middle >= 5e-3) & (middle <= end - 5e-3)
        assert np.isfinite(found.z[inside]).all()
        assert np.isnan(found.z[(middle < 3e-3) | (middle > end - 3e-3)]).all()

    def test_a_sample_of_the_axes_that_was_lost_costs_its_run_and_no_other(self):
        axes = self.axes()
        z = axes[3].z.copy()
        z[5] = np.nan
        axes[3] = axis_block(480, z, 1 / 2000, axes[3].stamp_ns)
        del axes[6]
        (found,) = axes_at_probe(axes, self.probe(500.0, 0.0, 500))
        time = np.arange(500) / 500
        np.testing.assert_array_equal(np.isfinite(found.z), (time >= 0.56) & (time < 0.9998))

    @pytest.mark.parametrize("ratio", [1, 2, 5])
    def test_a_record_of_two_rates_has_every_reading_on_its_grid(self, ratio):
        count = 1000 // ratio
        readings = np.arange(1.0, count + 1) * 1e-6
        probe = [probe_block(50, readings, ratio * 5e-4, stamp_ns=EPOCH + 100_000_000)]
        record = assemble(self.axes(), probe, by_stamps=True)
        assert record.by_stamps
        assert record.sample_period == pytest.approx(5e-4)
        np.testing.assert_allclose(record.distance[record.ok], readings)
        assert np.all(np.diff(np.flatnonzero(record.ok)) == ratio)
        instants = 0.1 + 5e-4 * np.arange(len(record))
        np.testing.assert_allclose(record.z, self.QUINTIC(instants), atol=1e-12)
        assert record.counts["paired"] == record.counts["received"] == count
