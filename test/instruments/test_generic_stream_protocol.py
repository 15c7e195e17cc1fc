"""The wire format against a second encoder, any split, any noise; scalings against algebra."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from omsm_ros.core.streams.blocks import Status
from omsm_ros.errors import ConfigurationError, DataError
from omsm_ros.instruments.parameters import PARAMETERS
from omsm_ros.instruments.scaling import AxisScaling
from omsm_ros.instruments.six_channel.protocol import (
    ENCODED_SIZE,
    FRAME,
    SEGMENT_SIZE,
    FrameArray,
    FrameDecoder,
    ProbeScaling,
    StreamScaling,
    encode_frames,
)

CHECKED = [name for name in FRAME.names if name != "crc"]

any_frames = npst.arrays(np.uint8, st.integers(1, 12).map(lambda n: n * FRAME.itemsize)).map(
    lambda raw: raw.view(FRAME)
)


def some_frames(count: int, seed: int = 0) -> FrameArray:
    raw = np.random.default_rng(seed).bytes(count * FRAME.itemsize)
    return np.frombuffer(raw, FRAME)


def assert_same(found: FrameArray, expected: FrameArray) -> None:
    for name in CHECKED:
        np.testing.assert_array_equal(found[name], expected[name])


def cobs_by_definition(data: bytes) -> bytes:
    """Cheshire and Baker's encoding below 254 bytes: runs of non-zeros, their lengths first."""
    return b"".join(bytes([len(run) + 1]) + run for run in data.split(b"\0"))


# Wire format.


def test_wire_format_is_the_documented_table() -> None:
    frame = np.zeros(1, FRAME)
    frame["sequence"], frame["device_time"] = 0x01020304, 5_000_000_000
    frame["distance"], frame["status"] = -123, 2
    frame["counts"] = [[1, -2, 3, -4, 2**62]]
    body = struct.pack("<IQiB5q", 0x01020304, 5_000_000_000, -123, 2, 1, -2, 3, -4, 2**62)
    expected = cobs_by_definition(body + struct.pack("<I", zlib.crc32(body))) + b"\0"
    assert encode_frames(frame) == expected


@given(any_frames)
def test_encoded_frames_have_one_size_and_one_zero_each(frames: FrameArray) -> None:
    wire = encode_frames(frames)
    assert len(wire) == ENCODED_SIZE * len(frames)
    assert wire.count(0) == len(frames)


def test_no_frames_are_no_bytes() -> None:
    assert encode_frames(np.empty(0, FRAME)) == b""
    assert len(FrameDecoder().feed(b"")) == 0


@given(any_frames, st.data())
def test_any_split_gives_the_same_frames(frames: FrameArray, data: st.DataObject) -> None:
    wire = encode_frames(frames)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(wire)))))
    decoder = FrameDecoder()
    parts = [
        decoder.feed(wire[start:end])
        for start, end in zip([0, *cuts], [*cuts, len(wire)], strict=True)
    ]
    assert_same(np.concatenate(parts), frames)
    assert decoder.statistics.bytes_discarded == 0


@given(any_frames)
def test_byte_by_byte(frames: FrameArray) -> None:
    decoder = FrameDecoder()
    wire = encode_frames(frames)
    parts = [decoder.feed(wire[i : i + 1]) for i in range(len(wire))]
    assert_same(np.concatenate(parts), frames)


# Damage.


@given(st.binary(max_size=400), any_frames)
def test_noise_gives_no_frame_and_costs_none_after_its_end(
    noise: bytes, frames: FrameArray
) -> None:
    decoder = FrameDecoder()
    assert len(decoder.feed(noise + b"\0")) == 0
    assert_same(decoder.feed(encode_frames(frames)), frames)


@given(st.binary(min_size=1, max_size=400).filter(lambda b: b[-1]), any_frames)
def test_noise_without_an_end_costs_the_frame_it_runs_into(
    noise: bytes, frames: FrameArray
) -> None:
    assert_same(FrameDecoder().feed(noise + encode_frames(frames)), frames[1:])


@given(st.integers(0, 3 * ENCODED_SIZE - 1), st.integers(0, 7))
def test_any_flipped_bit_is_found(place: int, bit: int) -> None:
    frames = some_frames(3)
    wire = bytearray(encode_frames(frames))
    wire[place] ^= 1 << bit
    decoder = FrameDecoder()
    found = decoder.feed(bytes(wire))
    hit, offset = divmod(place, ENCODED_SIZE)
    # Without its terminator, a frame takes the next one with it.
    spoilt = {hit, hit + 1} if offset == SEGMENT_SIZE else {hit}
    assert_same(found, frames[[i for i in range(3) if i not in spoilt]])


@given(st.integers(1, ENCODED_SIZE - 1), st.integers(0, 2))
def test_stream_joined_in_the_middle_of_a_frame(cut: int, seed: int) -> None:
    frames = some_frames(4, seed)
    assert_same(FrameDecoder().feed(encode_frames(frames)[cut:]), frames[1:])


@given(st.lists(st.binary(max_size=200), max_size=20))
def test_every_byte_is_accounted_for(portions: list[bytes]) -> None:
    decoder = FrameDecoder()
    good = encode_frames(some_frames(1))
    for portion in portions:
        decoder.feed(portion)
        decoder.feed(good)
    found = decoder.statistics
    assert found.bytes_received == sum(map(len, portions)) + len(good) * len(portions)
    assert found.bytes_discarded >= 0
    assert found.bytes_received == (
        ENCODED_SIZE * found.frames + found.bytes_discarded + found.bytes_pending
    )
    segments = b"".join(p + good for p in portions).split(b"\0")
    bad = found.bad_length + found.bad_cobs + found.bad_crc
    assert found.frames + bad == sum(map(bool, segments))


def test_reasons_are_distinguished() -> None:
    good = encode_frames(some_frames(1))
    decoder = FrameDecoder()
    decoder.feed(good[1:])
    assert decoder.statistics.bad_length == 1
    decoder.feed(bytes([200]) + good[1:])  # points beyond the end
    assert decoder.statistics.bad_cobs == 1
    altered = FrameDecoder().feed(good).copy()
    altered["distance"] += 1
    decoder.feed(cobs_by_definition(altered.tobytes()) + b"\0")
    assert decoder.statistics.bad_crc == 1
    assert decoder.statistics.frames == 0


def test_endless_noise_is_not_kept() -> None:
    decoder = FrameDecoder()
    for _ in range(100):
        decoder.feed(b"\xaa" * 10_000)
    assert decoder.statistics.bytes_pending <= SEGMENT_SIZE + 1
    assert decoder.statistics.bytes_discarded >= 1_000_000 - SEGMENT_SIZE - 1
    decoder.feed(b"\0")
    assert decoder.statistics.bad_length == 1
    assert len(decoder.feed(encode_frames(some_frames(2)))) == 2


def test_idle_line_is_no_broken_frame() -> None:
    decoder = FrameDecoder()
    decoder.feed(b"\0" * 50)
    found = decoder.statistics
    assert (found.bad_length, found.bad_cobs, found.bad_crc) == (0, 0, 0)
    assert found.bytes_discarded == 50


def test_reset_forgets_the_frame_cut_off() -> None:
    frames = some_frames(2)
    wire = encode_frames(frames)
    decoder = FrameDecoder()
    decoder.feed(wire[:30])
    decoder.reset()
    assert_same(decoder.feed(wire), frames)
    assert decoder.statistics.bad_length == 1
    assert decoder.statistics.bytes_discarded == 30


def test_a_frame_of_another_size_with_a_good_crc_is_refused() -> None:
    body = b"x" * 40
    segment = cobs_by_definition(body + struct.pack("<I", zlib.crc32(body)))
    decoder = FrameDecoder()
    assert len(decoder.feed(segment + b"\0")) == 0
    assert decoder.statistics.bad_length == 1


# Scaling.


@given(
    st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=30),
    st.sampled_from([1, -1]),
    st.floats(-0.5, 0.5),
)
def test_axis_positions_round_trip_to_half_a_count(
    values: list[float], sign: int, offset: float
) -> None:
    axis = AxisScaling(1e10, sign=sign, offset=offset)
    positions = np.array(values)
    error = axis.values(axis.counts(positions)) - positions
    # Half a count of 0.1 nm, and the rounding of a number near one metre.
    assert abs(error).max() <= 0.05e-9 + 4e-16


def test_axis_scaling_by_hand() -> None:
    axis = AxisScaling(1000.0, sign=-1, offset=2.0)
    np.testing.assert_allclose(axis.values(np.array([0, 500])), [2.0, 1.5])
    np.testing.assert_array_equal(axis.counts(np.array([2.0, 1.5])), [0, 500])


def test_a_wrapping_encoder_reports_within_one_turn() -> None:
    axis = AxisScaling(3600 / (2 * np.pi), wrap=3600)
    assert axis.counts(np.array([2 * np.pi * 5.25, -np.pi / 2])).tolist() == [900, 2700]


def test_counts_beyond_64_bits_are_refused() -> None:
    with pytest.raises(DataError, match="axis position of 1e\\+30"):
        AxisScaling(1e10).counts(np.array([0.0, 1e20]))
    with pytest.raises(DataError, match="nan"):
        AxisScaling(1e10).counts(np.array([np.nan]))


@given(st.lists(st.integers(-100_000, 100_000), min_size=1), st.sampled_from([1, -1]))
def test_probe_nanometres_survive(nanometres: list[int], polarity: int) -> None:
    probe = ProbeScaling(full_scale=1e-3, polarity=polarity)
    frames = np.zeros(len(nanometres), FRAME)
    frames["distance"] = probe.counts(np.array(nanometres) * 1e-9)
    distance, status = probe.readings(frames["distance"].astype(float), frames["status"])
    np.testing.assert_allclose(distance, np.array(nanometres) * 1e-9, atol=1e-18, rtol=1e-12)
    assert (frames["distance"] == polarity * np.array(nanometres)).all()
    assert (status == Status.OK).all()


@pytest.mark.parametrize(
    ("raw", "sent_status", "expected", "finite"),
    [
        (50_000, Status.OK, Status.OK, True),
        (100_000, Status.OK, Status.OK, True),
        (100_001, Status.OK, Status.OUT_OF_RANGE, True),
        (-100_001, Status.OK, Status.OUT_OF_RANGE, True),
        (-(2**31), Status.OK, Status.NO_TARGET, False),
        (-(2**31), Status.SATURATED, Status.SATURATED, False),
        (0, Status.NO_TARGET, Status.NO_TARGET, True),
        (500_000, Status.SATURATED, Status.SATURATED, True),
        (0, 5, Status.LOST, True),
        (0, 255, Status.LOST, True),
    ],
)
def test_verdict_on_a_reading(raw: int, sent_status: int, expected: Status, finite: bool) -> None:
    frames = np.zeros(1, FRAME)
    frames["distance"], frames["status"] = raw, sent_status
    distance, status = ProbeScaling(full_scale=100e-6).readings(
        frames["distance"].astype(float), frames["status"]
    )
    assert status.tolist() == [expected]
    assert status.dtype == np.uint8
    assert np.isfinite(distance).tolist() == [finite]


def test_no_distance_is_sent_as_the_sentinel() -> None:
    probe = ProbeScaling(invalid=-1)
    assert probe.counts(np.array([np.nan, 2e-9])).tolist() == [-1, 2]
    with pytest.raises(DataError, match="probe distance"):
        probe.counts(np.array([3.0]))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("x.counts_per_unit", -1e9),
        ("x.counts_per_unit", float("nan")),
        ("x.sign", 0),
        ("x.offset", float("inf")),
        ("x.wrap", -1),
        ("probe.full_scale", 0.0),
        ("probe.full_scale", float("inf")),
        ("probe.polarity", 2),
        ("probe.zero", float("nan")),
        ("probe.intensity_full_scale", -1.0),
        ("sample_period", -1.0),
        ("block_size", 0),
        ("trigger", "often"),
        ("format", "xml"),
        ("latch", "late"),
    ],
)
def test_senseless_parameters_are_refused(name: str, value: object) -> None:
    parameter = next(p for p in PARAMETERS if p.name == name)
    with pytest.raises(ConfigurationError, match=name):
        parameter.checked(value)


def test_default_resolution() -> None:
    scaling = StreamScaling()
    steps = [float(np.diff(axis.values(np.array([0, 1])))[0]) for axis in scaling.axes]
    np.testing.assert_allclose(steps, [1e-10, 1e-10, 1e-10, 1e-9, 1e-9])
