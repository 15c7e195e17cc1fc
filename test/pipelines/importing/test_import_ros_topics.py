"""ROS topics of standard messages, written here byte by byte, become axes and distance."""

import sqlite3
import struct
from contextlib import closing

import numpy as np
import pytest
from mcap.writer import Writer

from omsm_ros.errors import BagError, FileError, OmsmError
from omsm_ros.io import bags

START_NS = 1_763_200_000_000_000_000
JOINTS = ("x_slide", "z_slide", "spindle")

TIME = "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
HEADER = "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
LINE = "=" * 80 + "\n"
DEFINITIONS = {
    "sensor_msgs/msg/JointState": "std_msgs/Header header\nstring[] name\nfloat64[] position\n"
    f"float64[] velocity\nfloat64[] effort\n{LINE}{HEADER}{LINE}{TIME}",
    "sensor_msgs/msg/Range": "uint8 ULTRASOUND=0\nuint8 INFRARED=1\nstd_msgs/Header header\n"
    "uint8 radiation_type\nfloat32 field_of_view\nfloat32 min_range\nfloat32 max_range\n"
    f"float32 range\nfloat32 variance\n{LINE}{HEADER}{LINE}{TIME}",
    "std_msgs/msg/Float64": "float64 data\n",
    "geometry_msgs/msg/PointStamped": f"std_msgs/Header header\ngeometry_msgs/Point point\n{LINE}"
    f"MSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n{LINE}{HEADER}{LINE}{TIME}",
}
MAP = """
columns:
  time: {name: header.stamp, unit: date}
  x: {name: "/joint_states.position[x_slide]", unit: m}
  y: {constant: 0}
  z: {name: "/joint_states.position[z_slide]", unit: m}
  b: {constant: 0}
  c: {name: "/joint_states.position[spindle]", unit: rad}
"""
RANGE = '  distance: {name: "/probe.range", unit: m}\n'


class Cdr:
    """Write little-endian CDR: numbers aligned to their size, after four bytes of header."""

    def __init__(self):
        self.data = bytearray()

    def put(self, kind, *values):
        for value in values:
            size = struct.calcsize(kind)
            self.data += bytes(-len(self.data) % size)
            self.data += struct.pack(f"<{kind}", value)
        return self

    def text(self, *texts):
        for text in texts:
            raw = text.encode() + b"\0"
            self.put("I", len(raw)).data += raw
        return self

    def stamp(self, at_ns):
        return self.put("i", at_ns // 10**9).put("I", at_ns % 10**9).text("frame")

    def bytes(self):
        return b"\x00\x01\x00\x00" + bytes(self.data)


def joint_state(at_ns, names, positions):
    cdr = Cdr().stamp(at_ns).put("I", len(names)).text(*names)
    cdr.put("I", len(positions)).put("d", *positions)
    return cdr.put("I", 0).put("I", 0).bytes()


def range_message(at_ns, value, low=0.0, high=0.0):
    return Cdr().stamp(at_ns).put("B", 0).put("f", 0.01, low, high, value, 0.0).bytes()


def float64(value):
    return Cdr().put("d", value).bytes()


def point(at_ns, x, y, z):
    return Cdr().stamp(at_ns).put("d", x, y, z).bytes()


def write_mcap(path, messages):
    """messages: (topic, type, log time [ns], bytes), as a recorder of ROS 2 writes them."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2", library="a plain script")
        channels = {}
        for topic, kind, at_ns, data in messages:
            if topic not in channels:
                schema = writer.register_schema(kind, "ros2msg", DEFINITIONS[kind].encode())
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channels[topic], at_ns, data, at_ns)
        writer.finish()


def axes_at(seconds):
    return 1e-3 * seconds, 1e-5 * np.sin(20 * seconds), 3.0 * seconds


def joints(count, period=1e-3, names=JOINTS):
    for i in range(count):
        at_ns = START_NS + round(i * period * 1e9)
        x, z, c = axes_at(i * period)
        values = dict(zip(JOINTS, (x, z, c), strict=True))
        data = joint_state(at_ns, names, [values[name] for name in names])
        yield "/joint_states", "sensor_msgs/msg/JointState", at_ns, data


def ranges(count, period=1e-3, late=0.0, **limits):
    for i in range(count):
        at_ns = START_NS + round((i * period + late) * 1e9)
        value = 0.02 - axes_at(i * period + late)[1]
        yield "/probe", "sensor_msgs/msg/Range", at_ns, range_message(at_ns, value, **limits)


# ROS 2.


def test_joints_and_a_range_become_axes_and_distance(importer):
    write_mcap(importer.folder / "a.mcap", [*joints(300), *ranges(300)])
    found = importer(MAP + RANGE, "a.mcap")
    assert [(f.axes, f.distance, f.rows, f.own_clock) for f in found] == [
        (True, False, 300, False),
        (False, True, 300, False),
    ]
    (axes,), (distance,) = importer.blocks(bags.AXES_TOPIC), importer.blocks()
    t = np.arange(300) * 1e-3
    x, z, c = axes_at(t)
    np.testing.assert_allclose(axes.x, x, rtol=1e-15)
    np.testing.assert_allclose(axes.z, z, rtol=1e-15)
    np.testing.assert_allclose(axes.c, c, rtol=1e-15)
    # A float32 of 20 mm resolves 2 nm, the resolution of a Range message.
    np.testing.assert_allclose(distance.distance, 0.02 - z, atol=2e-9)
    assert axes.stamp_ns == distance.stamp_ns == START_NS
    assert axes.sample_period == pytest.approx(1e-3, rel=1e-6)


def test_joints_are_taken_by_name_though_their_order_changes(importer):
    swapped = list(joints(200, names=JOINTS[::-1]))
    messages = [
        b if i % 2 else a for i, (a, b) in enumerate(zip(joints(200), swapped, strict=True))
    ]
    write_mcap(importer.folder / "a.mcap", [*messages, *ranges(200)])
    importer(MAP + RANGE, "a.mcap")
    (axes,) = importer.blocks(bags.AXES_TOPIC)
    np.testing.assert_allclose(axes.c, axes_at(np.arange(200) * 1e-3)[2], rtol=1e-15)


def test_joints_of_another_node_are_passed_over_and_counted(importer):
    gripper = joint_state(START_NS, ["gripper"], [0.1])
    other = ("/joint_states", "sensor_msgs/msg/JointState", START_NS, gripper)
    write_mcap(importer.folder / "a.mcap", [other, *joints(50), other, *ranges(50)])
    found = importer(MAP + RANGE, "a.mcap")
    assert (found[0].rows, found[0].passed_over) == (50, 2)


def test_a_message_with_some_of_the_axes_is_refused(importer):
    half = joint_state(START_NS + 50_000_000, ["x_slide", "z_slide"], [0, 0])
    torn = ("/joint_states", "sensor_msgs/msg/JointState", START_NS + 50_000_000, half)
    write_mcap(importer.folder / "a.mcap", [*joints(50), torn, *ranges(50)])
    with pytest.raises(FileError, match=r"message 50: .*spindle"):
        importer(MAP + RANGE, "a.mcap")
    assert not importer.out.exists()


def test_what_a_range_s_own_limits_exclude_is_no_reading(importer):
    write_mcap(importer.folder / "a.mcap", [*joints(300), *ranges(300, low=0.019995, high=1.0)])
    _, found = importer(MAP + RANGE, "a.mcap")
    (distance,) = importer.blocks()
    z = axes_at(np.arange(300) * 1e-3)[1]
    assert found.invalid == np.sum(0.02 - z < 0.019995) > 50
    np.testing.assert_array_equal(np.isnan(distance.distance), 0.02 - z < 0.019995)


def test_a_probe_that_begins_later_is_joined_by_its_stamps(importer):
    write_mcap(importer.folder / "a.mcap", [*joints(300), *ranges(200, late=0.05)])
    importer(MAP + RANGE, "a.mcap")
    assert importer.blocks()[0].first_sample == 50


def test_rates_of_their_own_keep_their_stamps_and_are_reported(importer):
    write_mcap(importer.folder / "a.mcap", [*joints(300, 2e-3), *ranges(500, late=0.0503)])
    found = importer(MAP + RANGE, "a.mcap")
    assert all(f.own_clock for f in found)
    (axes,), (distance,) = importer.blocks(bags.AXES_TOPIC), importer.blocks()
    assert axes.first_sample == distance.first_sample == 0
    assert distance.stamp_ns - axes.stamp_ns == pytest.approx(50_300_000, abs=1000)
    assert axes.sample_period == pytest.approx(2e-3, rel=1e-6)


def test_numbers_without_a_header_by_the_time_of_their_record(importer):
    messages = [
        ("/gap", "std_msgs/msg/Float64", START_NS + i * 10**6, float64(i * 0.5)) for i in range(99)
    ]
    write_mcap(importer.folder / "a.mcap", messages)
    mapping = "columns:\n  time: {name: log_time, unit: date}\n"
    importer(mapping + "  distance: {name: /gap.data, unit: um, sign: -1}\n", "a.mcap")
    (block,) = importer.blocks()
    np.testing.assert_allclose(block.distance, np.arange(99) * -0.5e-6)
    assert block.stamp_ns == START_NS


def test_a_point_of_geometry_by_its_field(importer):
    messages = [
        ("/gap", "geometry_msgs/msg/PointStamped", START_NS, point(START_NS + i * 10**6, 1, 2, i))
        for i in range(20)
    ]
    write_mcap(importer.folder / "a.mcap", messages)
    mapping = "columns:\n  time: {name: header.stamp, unit: date}\n"
    importer(mapping + "  distance: {name: /gap.point.z, unit: nm}\n", "a.mcap")
    np.testing.assert_allclose(importer.blocks()[0].distance, np.arange(20) * 1e-9)


def test_stamps_of_a_busy_computer_are_refused_with_the_remedy(importer):
    jitter = np.random.default_rng(1).uniform(0, 0.9e6, 200).astype(int)
    messages = [
        ("/probe", "sensor_msgs/msg/Range", START_NS, range_message(START_NS + i * 10**6 + j, 0.02))
        for i, j in enumerate(jitter.tolist())
    ]
    write_mcap(importer.folder / "a.mcap", messages)
    mapping = "columns:\n  time: {name: header.stamp, unit: date}\n" + RANGE
    with pytest.raises(OmsmError, match="leave time out and state sample_period"):
        importer(mapping, "a.mcap")
    importer("sample_period: 0.001\ncolumns:\n" + RANGE, "a.mcap")
    assert len(importer.blocks()[0]) == 200


@pytest.mark.parametrize(
    ("mapping", "said"),
    [
        (MAP + RANGE.replace("/probe.range", "/probe.data"), "/probe.data"),
        ("sample_period: 0.001\ncolumns:\n  distance: {name: /gap.range, unit: m}\n",
         r"none of the columns \['/gap.range'\], but \['/joint_states.header.stamp'"),
        (MAP.replace("unit: date", "unit: s") + RANGE, "needs unit: date"),
        (MAP + RANGE.replace(", unit: m", ""), "distance has no unit"),
    ],
)  # fmt: skip
def test_what_a_map_of_topics_leaves_unclear_is_asked_for(importer, mapping, said):
    write_mcap(importer.folder / "a.mcap", [*joints(5), *ranges(5)])
    with pytest.raises(FileError, match=said):
        importer(mapping, "a.mcap")


def test_a_sqlite_bag_without_definitions(importer):
    """Write a bag as ros2 bag of Humble does: a folder of metadata.yaml and a database."""
    folder = importer.folder / "old"
    folder.mkdir()
    messages = list(ranges(40))
    with closing(sqlite3.connect(folder / "old_0.db3")) as base, base:
        base.execute(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, "
            "serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL)"
        )
        base.execute(
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, "
            "timestamp INTEGER NOT NULL, data BLOB NOT NULL)"
        )
        base.execute("INSERT INTO topics VALUES (1, '/probe', 'sensor_msgs/msg/Range', 'cdr', '')")
        rows = [(1, at_ns, data) for _, _, at_ns, data in messages]
        base.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", rows)
    base.close()
    (folder / "metadata.yaml").write_text(
        f"""rosbag2_bagfile_information:
  version: 5
  storage_identifier: sqlite3
  duration: {{nanoseconds: {39 * 10**6}}}
  starting_time: {{nanoseconds_since_epoch: {START_NS}}}
  message_count: 40
  topics_with_message_count:
    - topic_metadata: {{name: /probe, type: sensor_msgs/msg/Range, serialization_format: cdr,
                        offered_qos_profiles: ""}}
      message_count: 40
  compression_format: ""
  compression_mode: ""
  relative_file_paths: [old_0.db3]
  files:
    - path: old_0.db3
      starting_time: {{nanoseconds_since_epoch: {START_NS}}}
      duration: {{nanoseconds: {39 * 10**6}}}
      message_count: 40
"""
    )
    mapping = "columns:\n  time: {name: header.stamp, unit: date}\n" + RANGE
    (found,) = importer(mapping, "old")
    assert found.rows == 40
    (again,) = importer.blocks()
    z = axes_at(np.arange(40) * 1e-3)[1]
    np.testing.assert_allclose(again.distance, 0.02 - z, atol=2e-9)


def test_a_bag_that_was_cut_is_named(importer):
    write_mcap(importer.folder / "a.mcap", ranges(300))
    whole = (importer.folder / "a.mcap").read_bytes()
    (importer.folder / "a.mcap").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(BagError, match=r"a\.mcap"):
        importer("sample_period: 0.001\ncolumns:\n" + RANGE, "a.mcap")
