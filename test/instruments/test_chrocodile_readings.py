"""Signals are converted to encoder counts, distances and status."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from omsm_ros.core.streams.blocks import Status
from omsm_ros.errors import ConfigurationError
from omsm_ros.instruments.chrocodile.telegram import (
    ENCODER_RANGE,
    LATCHES,
    SATURATED,
    TRIGGER_DELAYED,
    TRIGGER_LOST,
    check_selection,
    counts_of,
    distance_of,
    first_of,
    unit_of,
)
from omsm_ros.instruments.scaling import ProbeReading

STARTS = np.array([[0, 100, -7, 5_000, 2**31 - 10], [50, 90, -7, 5_001, 2**31 + 30]])
TRAVEL = np.array([[8, -8, 0, 3, 40], [20, -6, 0, 1, -60]])


def records(starts, travel):
    """Encoder counts as the device sends them: signed 32 bits."""

    def signed(counts):
        return ((counts + 2**31) % ENCODER_RANGE - 2**31).astype(np.int32)

    first, last = LATCHES["mean"]
    return {
        str(number): signed(counts[:, i])
        for numbers, counts in ((first, starts), (last, starts + travel))
        for i, number in enumerate(numbers)
    }


@pytest.mark.parametrize(("latch", "share"), [("start", 0.0), ("mean", 0.5), ("end", 1.0)])
def test_counts_are_those_of_the_instant_that_was_asked_for(latch, share):
    """Axes that go either way, and one whose counter wraps during the exposure."""
    found = counts_of(records(STARTS, TRAVEL), latch, range(5))
    expected = STARTS + share * TRAVEL
    off = (found - expected + 2**31) % ENCODER_RANGE - 2**31
    assert np.max(abs(off)) <= 0.5


def test_each_axis_has_the_encoder_it_is_on():
    found = counts_of(records(STARTS, TRAVEL), "start", (3, 2, 1, 0, 4))
    np.testing.assert_array_equal(found[:, :4], STARTS[:, [3, 2, 1, 0]])


# Distance signals after the manual, as exact fractions.

SCA_M = 300e-6


def telegram(**signals):
    """Records of one telegram each, by signal number: s256=(1.0, 2.0)."""
    columns = {name[1:]: np.asarray(values) for name, values in signals.items()}
    made = np.zeros(
        len(next(iter(columns.values()))), [(n, column.dtype) for n, column in columns.items()]
    )
    for name, column in columns.items():
        made[name] = column
    return made


def read(probe=None, **signals):
    numbers = [int(name[1:]) for name in signals]
    return distance_of(telegram(**signals), numbers, probe or ProbeReading(full_scale=SCA_M))


@pytest.mark.parametrize(
    ("signal", "raw", "metres"),
    [
        ("s256", np.float32([0.25, 150.0]), [0.25e-6, 150e-6]),  # µm
        ("s33024", np.int32([1, 123_456]), [1e-9, 123.456e-6]),  # nm
        ("s16640", np.int16([1, 16_384]), [SCA_M / 2**15, SCA_M / 2]),  # parts of the range
    ],
)
def test_each_distance_signal_has_its_unit(signal, raw, metres):
    distance, intensity, status = read(**{signal: raw})
    np.testing.assert_allclose(distance, metres, rtol=1e-12)
    assert np.isnan(intensity).all()
    assert status.tolist() == [Status.OK, Status.OK]
    step = unit_of(int(signal[1:]), SCA_M)
    np.testing.assert_allclose(metres / raw.astype(float), step, rtol=1e-12)


def test_the_finest_distance_that_is_there_is_taken():
    both = {"s16640": np.int16([100]), "s256": np.float32([7.0])}
    assert read(**both)[0] == pytest.approx([7e-6])
    assert read(**both, s33024=np.int32([7123]))[0] == pytest.approx([7.123e-6])
    assert first_of((257, 16641), (83, 16641, 257)) == 257
    assert first_of((257, 16641), (83,)) is None


@pytest.mark.parametrize("zero", [0.0, 120e-6])
@pytest.mark.parametrize("polarity", [1, -1])
def test_distance_is_counted_from_its_zero_and_back(polarity, zero):
    probe = ProbeReading(full_scale=SCA_M, zero=zero, polarity=polarity)
    raw = np.array([0.5e-6, 120e-6, 299e-6])
    expected = polarity * (raw - zero)
    np.testing.assert_allclose(probe.distance(raw), expected, rtol=1e-14, atol=1e-22)
    np.testing.assert_allclose(probe.raw(expected), raw, rtol=1e-14)
    np.testing.assert_allclose(read(probe, s256=np.float32(raw * 1e6))[0], expected, atol=1e-11)


def test_zero_is_no_target_only_where_the_light_is_zero_too():
    distance = np.float32([0.0, 0.0, 5.0])
    found, light, status = read(s256=distance, s257=np.float32([0.0, 3.0, 0.0]))
    assert status.tolist() == [Status.NO_TARGET, Status.OK, Status.OK]
    assert np.isnan(found).tolist() == [True, False, False]
    assert found[1:].tolist() == pytest.approx([0.0, 5e-6])
    np.testing.assert_allclose(light, [0.0, 0.03, 0.0], rtol=1e-6)
    # Without an intensity nothing else can tell.
    assert read(s256=distance)[2].tolist() == [Status.NO_TARGET, Status.NO_TARGET, Status.OK]


def test_intensity_is_a_share_of_the_full_one():
    probe = ProbeReading(full_scale=SCA_M, intensity_full_scale=1000.0)
    _, light, _ = read(probe, s256=np.float32([5.0] * 3), s16641=np.uint16([0, 250, 2000]))
    assert light.tolist() == [0.0, 0.25, 1.0]
    assert light.dtype == np.float32


def test_what_is_no_number_is_no_target():
    found, _, status = read(s256=np.float32([np.nan, np.inf, -np.inf, 5.0]))
    assert status.tolist() == [*[Status.NO_TARGET] * 3, Status.OK]
    assert np.isnan(found).tolist() == [True, True, True, False]


def test_beyond_the_range_is_reported_and_still_has_its_distance():
    nm = np.int32([-1, 1, 299_999, 300_001])
    found, _, status = read(s33024=nm)
    outside = Status.OUT_OF_RANGE
    assert status.tolist() == [outside, Status.OK, Status.OK, outside]
    np.testing.assert_allclose(found, nm * 1e-9, rtol=1e-12)


@pytest.mark.parametrize(
    ("flags", "expected"),
    [(0, Status.OK), (1, Status.SATURATED), (2, Status.OK), (4, Status.OK), (7, Status.SATURATED)],
)
def test_bit_0_alone_is_saturation(flags, expected):
    assert read(s256=np.float32([5.0]), s76=np.uint16([flags]))[2].tolist() == [expected]
    # Where there is nothing, nothing can be saturated.
    dark = read(s256=np.float32([0.0]), s257=np.float32([0.0]), s76=np.uint16([flags]))
    assert dark[2].tolist() == [Status.NO_TARGET]


def test_trigger_flags_have_their_bits():
    assert (SATURATED, TRIGGER_LOST, TRIGGER_DELAYED) == (1 << 0, 1 << 1, 1 << 2)


def test_a_selection_without_distance_counter_or_encoders_is_refused():
    with pytest.raises(ConfigurationError, match="hold no distance"):
        distance_of(telegram(s83=np.uint16([1])), [83], ProbeReading())
    with pytest.raises(ConfigurationError, match="lack 83, the sample counter"):
        check_selection([256, 65], [65])
    with pytest.raises(ConfigurationError, match=r"lack \[66, 67\], the encoders"):
        check_selection([83, 256, 65], [65, 66, 67])
    check_selection([83, 256, 65], [65])
    check_selection([83], [])


@given(start=st.integers(-(2**31), 2**31 - 1), travel=st.integers(-(2**31) + 1, 2**31 - 1))
@settings(max_examples=50)
def test_the_mean_of_a_counter_that_wraps_is_half_of_the_way(start, travel):
    """In whole numbers of any length, and wrapped at the end only."""
    found = counts_of(records(np.full((1, 5), start), np.full((1, 5), travel)), "mean", range(5))
    assert found[0].size == 5
    for count in found[0].tolist():
        assert (count - (start + travel // 2)) % ENCODER_RANGE == 0
