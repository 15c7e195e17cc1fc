"""A bag played to the nodes gives what the offline command gives at any rate; nothing is lost."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import rclpy
from omsm_msgs.msg import AxisBlock, Calibration, DistanceBlock
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from omsm_ros.core.correction.correct import CorrectionOptions
from omsm_ros.core.correction.machine_sources import NOTHING_STATED
from omsm_ros.core.streams import blocks
from omsm_ros.io import bags, message_mapping
from omsm_ros.io.bag_writer import BagWriter
from omsm_ros.io.calibration_file import save_calibration
from omsm_ros.io.message_mapping import bag_messages
from omsm_ros.io.results import CloudFile
from omsm_ros.nodes.topics import LATCHED_QOS, SAMPLES_QOS
from omsm_ros.pipelines.correct import correct_bag
from omsm_ros.pipelines.demonstrate import same_points
from omsm_ros.pipelines.measure import with_sources

BLOCKS = 30  # three seconds


def record(path, pairs, calibration=None, names=None):
    topics = [bags.AXES_TOPIC, bags.DISTANCE_TOPIC]
    with BagWriter(path, [*topics, bags.CALIBRATION_TOPIC], names) as bag:
        if calibration is not None:
            stamp = pairs[0][0].stamp_ns
            message = message_mapping.calibration_message(bag_messages(), calibration, stamp)
            bag.write(bags.CALIBRATION_TOPIC, stamp, message)
        for axes, distance in pairs:
            bag.write_block(axes)
            bag.write_block(distance)
    return path


def cut(pairs, size):
    """The same samples in blocks of another size."""

    def parts(block, names):
        for start in range(0, len(block), size):
            fields = {n: getattr(block, n)[start : start + size] for n in names}
            yield type(block)(
                stamp_ns=block.stamp_ns + round(start * block.sample_period * 1e9),
                first_sample=block.first_sample + start,
                sample_period=block.sample_period,
                **fields,
            )

    for axes, distance in pairs:
        yield from zip(
            parts(axes, "xyzbc"), parts(distance, ("distance", "intensity", "status")), strict=True
        )


def play(cell, bag, **parameters):
    cell.processes.start("player", bag=str(bag), **parameters)


def first_step(cell):
    """Have a paused player publish one message, once it knows who listens; what it says."""
    while not (answer := cell.call(Trigger, "player/step")).success:
        assert "yet" in answer.message
    return answer.message


def played(cell):
    """Wait for the player's own end; its exit code."""
    process = cell.processes._running.pop("player")
    deadline = time.monotonic() + 40.0
    while process.poll() is None:
        rclpy.spin_once(cell.operator, timeout_sec=0.05)
        if time.monotonic() > deadline:
            process.kill()
            pytest.fail(f"the player does not end: {cell.operator._status.get('player')}")
    return process.returncode


def live_cloud(cell, path, calibration_file, **parameters):
    """Return the clouds of the corrector for a played bag."""
    cell.processes.start("corrector", calibration=str(calibration_file))
    clouds = cell.clouds()
    cell.wait("corrector", lambda: cell.operator.value("corrector", "points_subscribers") >= 1)
    play(cell, path, **parameters)
    assert played(cell) == 0
    cell.processes.end("corrector")
    deadline = time.monotonic() + 1.0
    while time.monotonic() < deadline:
        rclpy.spin_once(cell.operator, timeout_sec=0.05)
    cell.operator._status.clear()
    return np.concatenate([message_mapping.cloud_array(cloud) for cloud in clouds])


def test_it_begins_only_when_those_listen_who_have_to(cell, small_scan_blocks):
    for topic, kind in (("axes", AxisBlock), ("confocal", DistanceBlock)):
        cell.operator.create_subscription(kind, f"/omsm/{topic}", lambda _: None, SAMPLES_QOS)
    play(cell, record(cell.folder / "a.mcap", small_scan_blocks[:2]), wait_for="corrector")
    text = cell.operator.text
    cell.wait("its reason", lambda: "corrector must subscribe" in text("player", "message"))
    assert cell.operator.value("player", "axes") == 0


@pytest.mark.soak
def test_at_any_rate_and_offline_the_clouds_are_equal(cell, small_scan_blocks, true_calibration):
    pairs = small_scan_blocks[:BLOCKS]
    path = record(cell.folder / "scan.mcap", pairs)
    calibration_file = cell.folder / "cal.json"
    save_calibration(calibration_file, true_calibration)
    options = with_sources(CorrectionOptions(), true_calibration, NOTHING_STATED, None)
    correct_bag(path, true_calibration, cell.folder / "cloud.ply", options=options)
    offline = CloudFile(cell.folder / "cloud.ply").read()
    assert len(offline) > 80 * BLOCKS
    for rate in (1.0, 50.0, 0.0):
        cloud = live_cloud(cell, path, calibration_file, rate=rate)
        assert same_points(cloud, offline), rate


@pytest.mark.soak
def test_at_rate_0_nothing_is_lost_by_who_stops_for_a_while(
    cell, small_scan_blocks, true_calibration
):
    """Three times as many messages as a queue holds, while one who listens takes none for 2 s."""
    pairs = list(cut(small_scan_blocks[:60], 2))
    path = record(cell.folder / "scan.mcap", pairs, true_calibration)
    cell.processes.start("corrector")
    cell.processes.start("recorder", path=str(cell.folder / "again.mcap"))
    value = cell.operator.value
    play(cell, path, rate=0.0, paused=True, listeners=2)
    first_step(cell)
    stopped = cell.processes._running["corrector"]
    stopped.send_signal(signal.SIGSTOP)
    assert cell.call(Trigger, "player/resume").success
    cell.wait("the player to say what it published", lambda: value("player", "axes") > 0)
    assert cell.settle("player", "axes") <= 201  # no more than a part of its queue
    stopped.send_signal(signal.SIGCONT)
    assert played(cell) == 0
    cell.processes.end("recorder")
    for topic in (bags.AXES_TOPIC, bags.DISTANCE_TOPIC):
        assert numbers_in(cell.folder / "again.mcap", topic) == numbers_in(path, topic)
    streams = ("axes", "distance")
    cell.wait("both", lambda: min(value("corrector", f"{s}_received") for s in streams) >= 6000)
    for stream in streams:
        assert value("corrector", f"{stream}_received") == 6000
        assert value("corrector", f"missing_{stream}") == 0


def numbers_in(path, topic):
    with bags.BagReader(path) as reader:
        return [block.first_sample for _, block in reader.records(topic)]


SOMEBODY_ELSE = """
import sys, threading, rclpy
from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud2
rclpy.init()
points = []
node = rclpy.create_node("somebody_else")
node.create_subscription(
    PointCloud2, "/omsm/points", lambda cloud: points.append(cloud.width), QoSProfile(depth=2000)
)
threading.Thread(target=rclpy.spin, args=[node], daemon=True).start()
print("listens", flush=True)
sys.stdin.read()
print(sum(points), flush=True)
rclpy.try_shutdown()
"""


def test_somebody_else_who_was_there_before_hears_all(cell, small_scan_blocks, true_calibration):
    """He has no profile of ours; ``delay`` is that of replay.launch.py."""
    path = record(cell.folder / "scan.mcap", small_scan_blocks[:BLOCKS], true_calibration)
    correct_bag(path, true_calibration, cell.folder / "cloud.ply")
    truth = CloudFile(cell.folder / "cloud.ply").read()
    plain = {k: v for k, v in os.environ.items() if not k.startswith(("FASTRTPS", "RMW_FASTRTPS"))}
    with subprocess.Popen(
        [sys.executable, "-c", SOMEBODY_ELSE],
        env=plain, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
    ) as listener:  # fmt: skip
        assert listener.stdout.readline() == "listens\n"
        cell.processes.start("corrector")
        play(cell, path, rate=0.0, wait_for="corrector", delay=3.5)
        assert played(cell) == 0
        time.sleep(0.5)  # on its way through the queue
        heard, _ = listener.communicate(timeout=10.0)
    assert int(heard) == len(truth) > 80 * BLOCKS


def hear(cell, kind, topic, qos=SAMPLES_QOS):
    seen = []
    cell.operator.create_subscription(kind, topic, seen.append, qos)
    return seen


def test_recorded_points_go_elsewhere_and_only_if_asked_for(cell, small_scan_blocks):
    """A part of a bag is played, with its time on /clock."""
    from sensor_msgs.msg import PointCloud2

    pairs = small_scan_blocks[:BLOCKS]
    path = cell.folder / "scan.mcap"
    with BagWriter(path, (bags.AXES_TOPIC, bags.POINTS_TOPIC)) as bag:
        for axes, _ in pairs:
            bag.write_block(axes)
            cloud = message_mapping.cloud_message(
                bag_messages(), np.zeros(3, message_mapping.POINT_DTYPE), axes.stamp_ns
            )
            bag.write(bags.POINTS_TOPIC, axes.stamp_ns, cloud)
    live, elsewhere = cell.clouds(), hear(cell, PointCloud2, "/omsm/recorded/points")
    axes, clock = hear(cell, AxisBlock, "/omsm/axes"), hear(cell, Clock, "/clock")
    play(cell, path, rate=20.0, start=0.95, duration=1.0, clock=True, paused=True)
    # The player waits for who takes samples, not for who looks at the clock.
    cell.wait("who tells the time", lambda: cell.operator.count_publishers("/clock") > 0)
    first_step(cell)
    assert cell.call(Trigger, "player/resume").success
    assert played(cell) == 0
    assert (len(live), len(elsewhere)) == (0, 0)
    assert [a.first_sample for a in axes] == [p[0].first_sample for p in pairs[10:20]]
    times = [c.clock.sec * 10**9 + c.clock.nanosec for c in clock]
    assert times == sorted(times)
    assert pairs[9][0].stamp_ns <= times[0]
    assert times[-1] <= pairs[20][0].stamp_ns
    play(cell, path, rate=0.0, topics="axes points")
    assert played(cell) == 0
    assert (len(live), len(elsewhere)) == (0, BLOCKS)


def test_pause_step_and_what_was_latched_before_the_start(
    cell, small_scan_blocks, true_calibration
):
    pairs = small_scan_blocks[:BLOCKS]
    path = record(cell.folder / "scan.mcap", pairs, true_calibration)
    axes = hear(cell, AxisBlock, "/omsm/axes")
    hear(cell, DistanceBlock, "/omsm/confocal")
    play(cell, path, rate=0.0, start=1.0, paused=True)
    assert first_step(cell).startswith("calibration")
    reported = hear(cell, Calibration, "/omsm/calibration", LATCHED_QOS)  # who comes late
    cell.wait("the calibration", lambda: reported)
    assert reported[0].id == true_calibration.id
    assert cell.call(Trigger, "player/step").success
    cell.wait("one message", lambda: len(axes) == 1)
    assert axes[0].first_sample == pairs[10][0].first_sample
    assert cell.call(Trigger, "player/resume").success
    assert played(cell) == 0
    assert len(axes) == BLOCKS - 10


def test_a_live_cell_is_never_mixed_with_a_recorded_one(cell, small_scan_blocks):
    path = record(cell.folder / "scan.mcap", small_scan_blocks[:3])
    live = cell.operator.create_publisher(AxisBlock, "/omsm/axes", SAMPLES_QOS)
    axes = hear(cell, AxisBlock, "/omsm/axes")
    hear(cell, DistanceBlock, "/omsm/confocal")
    play(cell, path, rate=0.0)
    cell.wait("its word", lambda: "never mixed" in cell.operator.text("player", "message"))
    assert axes == []
    cell.operator.destroy_publisher(live)
    assert played(cell) == 0
    assert len(axes) == 3


def test_a_bag_of_a_second_cell_loops_until_it_is_ended(cell, small_scan_blocks):
    names = {t: t.replace("/omsm", "/cell2") for t in (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)}
    path = record(cell.folder / "second.mcap", small_scan_blocks[:3], names=names)
    axes = hear(cell, AxisBlock, "/omsm/axes")
    hear(cell, DistanceBlock, "/omsm/confocal")
    play(cell, path, rate=0.0, loop=True)
    cell.wait("three rounds", lambda: len(axes) >= 9)
    cell.processes.end("player")
    firsts = [a.first_sample for a in axes]
    once = [axes.first_sample for axes, _ in small_scan_blocks[:3]]
    assert firsts[: 3 * len(once)] == once * 3


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("topics", "points", "nothing to play on points; .*'/omsm/axes', '/omsm/confocal'"),
        ("rate", -1.0, "rate"),
        ("cell", "/cell9", "nothing to play on the topics of this cell; .*'/omsm/axes'"),
    ],
)
def test_what_cannot_be_played_is_one_line(cell, small_scan_blocks, name, value, said):
    path = record(cell.folder / "scan.mcap", small_scan_blocks[:3])
    cell.processes.start("player", bag=str(path), **{name: value})
    with pytest.raises(Exception, match=f"exit code 2.*{said}"):
        cell.wait("its end", lambda: False)
    cell.processes._running.clear()


def test_blocks_are_cut_without_a_change():
    """Check of the helper above."""
    whole = blocks.AxisBlock(
        stamp_ns=5, first_sample=7, sample_period=1e-3, **{n: np.arange(5.0) for n in "xyzbc"}
    )
    probe = blocks.DistanceBlock(
        stamp_ns=5, first_sample=7, sample_period=1e-3, distance=np.arange(5.0)
    )
    pairs = list(cut([(whole, probe)], 2))
    assert [a.first_sample for a, _ in pairs] == [7, 9, 11]
    np.testing.assert_array_equal(np.concatenate([d.distance for _, d in pairs]), np.arange(5.0))
