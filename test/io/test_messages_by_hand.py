"""Messages and bags by the bytes: CDR by struct after OMG DDSI-RTPS, MCAP by its own library."""

from __future__ import annotations

import json
import math
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from omsm_ros.core.correction.surface_points import POINT_DTYPE, SurfacePoints, pack_points
from omsm_ros.core.streams.blocks import AccelerationBlock, AxisBlock, DistanceBlock
from omsm_ros.errors import BagError, CalibrationError, DataError
from omsm_ros.io import bags, message_mapping
from omsm_ros.io.bag_writer import BagWriter
from omsm_ros.io.message_mapping import bag_messages, typestore


class Cdr:
    """Plain CDR, little endian: each number at a multiple of its size, counted behind the head."""

    def __init__(self):
        self.raw = b""

    def put(self, form, *values):
        size = struct.calcsize(form)
        for value in values:
            self.raw += bytes(-len(self.raw) % size) + struct.pack(f"<{form}", value)
        return self

    def text(self, value):
        raw = value.encode() + b"\0"
        self.put("I", len(raw))
        self.raw += raw
        return self

    def row(self, form, values):
        return self.put("I", len(values)).put(form, *values)

    @property
    def message(self):
        return b"\0\1\0\0" + self.raw


def head(stamp_ns, frame):
    sec, nanosec = divmod(stamp_ns, 10**9)
    return Cdr().put("i", sec).put("I", nanosec).text(frame)


def block_head(block, frame):
    return head(block.stamp_ns, frame).put("Q", block.first_sample).put("d", block.sample_period)


def axes_by_hand(block, frame):
    cdr = block_head(block, frame)
    for name in "xyzbc":
        cdr.row("d", getattr(block, name).tolist())
    return cdr.message


def distance_by_hand(block, frame):
    cdr = block_head(block, frame).row("d", block.distance.tolist())
    return cdr.row("f", block.intensity.tolist()).row("B", block.status.tolist()).message


def acceleration_by_hand(block, frame):
    cdr = block_head(block, frame)
    for name in "xyz":
        cdr.row("d", getattr(block, name).tolist())
    return cdr.message


def written(message, kind):
    raw = typestore().serialize_cdr(message, kind)
    return bytes(raw)


def read(raw, kind):
    return typestore().deserialize_cdr(raw, kind)


STAMPS = st.integers(0, 2**31 * 10**9 - 1)
COUNTS = st.integers(0, 2**52)
PERIODS = st.floats(1e-6, 1.0)
FRAMES = st.text(st.characters(codec="ascii", min_codepoint=32), max_size=9)


def rows(low, high, count):
    return st.lists(st.floats(low, high), min_size=count, max_size=count).map(np.array)


@st.composite
def axis_blocks(draw):
    count = draw(st.integers(1, 5))
    return AxisBlock(
        stamp_ns=draw(STAMPS), first_sample=draw(COUNTS), sample_period=draw(PERIODS),
        **{name: draw(rows(-1, 1, count)) for name in "xyzbc"},
    )  # fmt: skip


@st.composite
def distance_blocks(draw):
    count = draw(st.integers(1, 5))
    bright = draw(rows(0, 1, count)) if draw(st.booleans()) else np.empty(0)
    status = draw(st.lists(st.integers(0, 4), min_size=count, max_size=count))
    return DistanceBlock(
        stamp_ns=draw(STAMPS), first_sample=draw(COUNTS), sample_period=draw(PERIODS),
        distance=draw(rows(-1, 1, count)), intensity=bright.astype(np.float32),
        status=np.array(status if draw(st.booleans()) else [], np.uint8),
    )  # fmt: skip


def same(one, other):
    names = type(one).__dataclass_fields__
    for name in names:
        a, b = getattr(one, name), getattr(other, name)
        assert np.array_equal(a, b, equal_nan=True), name
        assert getattr(a, "dtype", None) == getattr(b, "dtype", None), name


@settings(max_examples=40)
@given(axis_blocks(), FRAMES)
def test_axes_are_the_bytes_of_the_standard(block, frame):
    raw = axes_by_hand(block, frame)
    ours = written(
        message_mapping.block_message(bag_messages(), block, frame), "omsm_msgs/msg/AxisBlock"
    )
    assert ours.rstrip(b"\0") == raw.rstrip(b"\0")
    same(message_mapping.block_of(read(raw, "omsm_msgs/msg/AxisBlock")), block)


@settings(max_examples=40)
@given(distance_blocks(), FRAMES)
def test_distances_are_the_bytes_of_the_standard(block, frame):
    """The record has NaN where the probe says that a reading is none; the rest is as it was."""
    raw = distance_by_hand(block, frame)
    kind = "omsm_msgs/msg/DistanceBlock"
    ours = written(message_mapping.block_message(bag_messages(), block, frame), kind)
    assert ours.rstrip(b"\0") == raw.rstrip(b"\0")
    same(message_mapping.block_of(read(raw, kind)), block)


@pytest.mark.parametrize("count", [1, 2, 7])
def test_accelerations_are_the_bytes_of_the_standard(count):
    rng = np.random.default_rng(count)
    block = AccelerationBlock(
        stamp_ns=1_700_000_000_123_456_789, first_sample=9, sample_period=2.5e-4,
        **{name: rng.normal(size=count) for name in "xyz"},
    )  # fmt: skip
    raw, kind = acceleration_by_hand(block, "probe"), "omsm_msgs/msg/AccelerationBlock"
    ours = written(message_mapping.block_message(bag_messages(), block), kind)
    assert ours.rstrip(b"\0") == raw.rstrip(b"\0")
    same(message_mapping.block_of(read(raw, kind)), block)


def test_a_calibration_is_the_bytes_of_the_standard(true_calibration):
    message = message_mapping.calibration_message(bag_messages(), true_calibration, 5 * 10**9 + 7)
    raw = written(message, "omsm_msgs/msg/Calibration")
    dynamics = true_calibration.dynamics
    cdr = head(5 * 10**9 + 7, "machine").text(true_calibration.id)
    cdr.row("d", dynamics.numerator.tolist()).row("d", dynamics.denominator.tolist())
    cdr.put("d", dynamics.delay, true_calibration.static_gain, true_calibration.sample_period)
    cdr.put("d", true_calibration.valid_up_to)
    cdr.row("d", true_calibration.covariance.ravel().tolist())
    cdr.text(json.dumps(dict(true_calibration.settings), sort_keys=True))
    cdr.text(json.dumps(true_calibration.certificate.content(), sort_keys=True))
    assert raw.rstrip(b"\0") == cdr.message.rstrip(b"\0")
    heard = message_mapping.calibration(read(cdr.message, "omsm_msgs/msg/Calibration"))
    assert heard.id == true_calibration.id


@pytest.mark.parametrize("name", ["settings", "certificate"])
@pytest.mark.parametrize(
    ("text", "reported"),
    [
        ("[1]", "expected a JSON object"),
        ('{"a": NaN}', "NaN is not a JSON number"),
        ('{"a": 1, "a": 2}', "is repeated"),
        (" " * 2_000_001, "of 2000001 characters, at most 2000000 are accepted; shorten it"),
    ],
)
def test_a_calibration_whose_json_is_none_names_its_part(true_calibration, name, text, reported):
    message = message_mapping.calibration_message(bag_messages(), true_calibration, 0)
    setattr(message, name, text)
    with pytest.raises(CalibrationError, match=rf"^{name} .*{reported}"):
        message_mapping.calibration(message)


def cloud(count, intensity=0.5):
    ramp = np.arange(count, dtype=np.float64)
    return SurfacePoints(
        sample=np.arange(count) + 2**32 - 1, x=ramp / 3, y=-ramp / 7, height=ramp * 1e-9 + 1 / 3,
        dynamic_error=ramp * 1e-12, uncertainty=ramp * 1e-10,
        intensity=np.full(count, intensity, np.float32),
    )  # fmt: skip


@pytest.mark.parametrize("count", [0, 1, 4])
def test_a_cloud_is_read_by_what_it_says_of_its_fields(count):
    """As RViz and Foxglove do: name, offset and datatype of each, step and width."""
    points = cloud(count)
    message = message_mapping.cloud_message(bag_messages(), pack_points(points), 3 * 10**9)
    form = {6: "I", 7: "f", 8: "d"}  # UINT32, FLOAT32, FLOAT64 of sensor_msgs/PointField
    data = bytes(message.data)
    assert len(data) == message.row_step * message.height == message.point_step * message.width
    assert (message.height, message.width, message.is_bigendian) == (1, count, False)
    names = {field.name: field for field in message.fields}
    for k in range(count):
        for name, field in names.items():
            place = k * message.point_step + field.offset
            assert place % struct.calcsize(form[field.datatype]) == 0
            (value,) = struct.unpack_from(f"<{form[field.datatype]}", data, place)
            wanted = points.height if name == "z" else getattr(points, name)
            exact = {6: lambda v: int(v) % 2**32, 7: np.float32, 8: float}[field.datatype]
            assert value == exact(wanted[k]), name
    assert message.is_dense
    raw = written(message, "sensor_msgs/msg/PointCloud2")
    back = message_mapping.cloud_array(read(raw, "sensor_msgs/msg/PointCloud2"))
    assert back.tobytes() == pack_points(points).tobytes()


def test_a_cloud_with_what_nobody_measured_is_not_dense():
    packed = pack_points(cloud(3, intensity=math.nan))
    assert not message_mapping.cloud_message(bag_messages(), packed, 0).is_dense


@pytest.mark.parametrize("change", [{"point_step": 32}, {"is_bigendian": True}])
def test_a_foreign_cloud_is_reported(change):
    message = message_mapping.cloud_message(bag_messages(), pack_points(cloud(2)), 0)
    for name, value in change.items():
        setattr(message, name, value)
    reported = rf"expected {POINT_DTYPE.itemsize}; give one that the corrector published"
    with pytest.raises(DataError, match=reported):
        message_mapping.cloud_array(message)


def others_fields(message):
    message.fields[3].name = "depth"


def moved_field(message):
    message.fields[0].offset = 4


def doubled_field(message):
    message.fields.append(message.fields[0])


def half_of_the_bytes(message):
    message.data = message.data[: len(message.data) // 2]


def odd_bytes(message):
    message.data = message.data[:41]


def more_points(message):
    message.width = 2**32 - 1


@pytest.mark.parametrize(
    "spoil", [others_fields, moved_field, doubled_field, half_of_the_bytes, odd_bytes, more_points]
)
def test_a_cloud_of_another_layout_is_refused_and_never_misread(spoil):
    message = message_mapping.cloud_message(bag_messages(), pack_points(cloud(2)), 0)
    spoil(message)
    with pytest.raises(DataError, match=r"expected .*; give one that the corrector published"):
        message_mapping.cloud_array(message)


def test_a_bag_of_ours_holds_the_bytes_of_the_standard(tmp_path, small_scan_blocks):
    """Read by the library of the format: topics, times, and each message by hand."""
    path = tmp_path / "a.mcap"
    pairs = small_scan_blocks[:3]
    with BagWriter(path, (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)) as bag:
        for axes, distance in pairs:
            bag.write_block(axes)
            bag.write_block(distance)
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        found = [(s, c, m) for s, c, m in reader.iter_messages()]
    wanted = [(axes_by_hand(a, "machine"), distance_by_hand(d, "probe")) for a, d in pairs]
    for (schema, channel, message), raw in zip(found, sum(wanted, ()), strict=True):
        assert message.data.rstrip(b"\0") == raw.rstrip(b"\0")
        assert channel.message_encoding == "cdr"
        assert schema.encoding == "ros2msg"
        assert message.log_time == message.publish_time
    assert {c.topic: s.name for s, c, _ in found} == {
        bags.AXES_TOPIC: "omsm_msgs/msg/AxisBlock",
        bags.DISTANCE_TOPIC: "omsm_msgs/msg/DistanceBlock",
    }


@pytest.mark.parametrize(
    ("change", "reported"),
    [
        ({"sample_period": 0.0}, "sample_period is 0.0 s"),
        ({"sample_period": math.nan}, "sample_period is nan s"),
        ({"first_sample": 2**63}, "first_sample is 9223372036854775808"),
        ({"x": np.zeros(2)}, "different lengths"),
        ({n: np.zeros(0) for n in "xyzbc"}, "samples"),
    ],
)
def test_a_block_that_cannot_be_is_a_malformed_message_of_its_bag(
    tmp_path, small_scan_blocks, change, reported
):
    path = tmp_path / "a.mcap"
    message = message_mapping.block_message(bag_messages(), small_scan_blocks[0][0])
    for name, value in change.items():
        setattr(message, name, value)
    with BagWriter(path, (bags.AXES_TOPIC,)) as bag:
        bag.write(bags.AXES_TOPIC, 0, message)
    for read_all in (
        lambda reader: list(reader.records(bags.AXES_TOPIC)),
        lambda reader: list(reader.blocks(bags.AXES_TOPIC)),
    ):
        with (
            bags.BagReader(path) as reader,
            pytest.raises(BagError, match=rf"a.mcap' holds a malformed message: .*{reported}"),
        ):
            read_all(reader)
