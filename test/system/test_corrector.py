"""The corrector alone, live: what it refuses, what it says of what it was forced to use, where
its points lie, and what it predicts."""

import os
import signal
from dataclasses import replace

import numpy as np
import pytest
from certified import certified_by
from omsm_msgs.msg import Account
from omsm_msgs.msg import AxisBlock as AxisMessage
from omsm_msgs.msg import Calibration as CalibrationMessage
from omsm_msgs.msg import DistanceBlock as DistanceMessage
from omsm_msgs.srv import LoadCalibration, PredictError

from omsm_ros.core.streams.blocks import AxisBlock, DistanceBlock
from omsm_ros.io import bags, message_mapping
from omsm_ros.io.bag_writer import BagWriter
from omsm_ros.io.calibration_file import save_calibration
from omsm_ros.nodes.topics import LATCHED_QOS, SAMPLES_QOS
from omsm_ros.twin.cell import blocks_of

PERIOD, COUNT = 1e-3, 600


def blocks(z=None, distance=None, first=0, **axes):
    """One block of each stream; channels that are not given are zero."""
    zero = np.zeros(COUNT)
    common = {"stamp_ns": first * 1_000_000, "first_sample": first, "sample_period": PERIOD}
    channels = {name: axes.get(name, zero) for name in "xybc"}
    return (
        AxisBlock(**common, z=zero if z is None else z, **channels),
        DistanceBlock(**common, distance=zero if distance is None else distance),
    )


class Feed:
    """Publishes pairs of blocks to the corrector, and reads its clouds."""

    def __init__(self, cell):
        self._cell, self._messages = cell, message_mapping.ros_messages()
        self.clouds = cell.clouds()
        self._axes = cell.publisher("axes", AxisMessage)
        self._distance = cell.publisher("confocal", DistanceMessage)

    def send(self, axes, distance):
        self._axes.publish(message_mapping.block_message(self._messages, axes))
        self._distance.publish(message_mapping.block_message(self._messages, distance))

    def answer(self, axes, distance):
        """The next cloud."""
        self.clouds.clear()
        self.send(axes, distance)
        self._cell.wait("a cloud", lambda: self.clouds)
        return self.clouds[0]


def saved(cell, name, calibration):
    path = cell.folder / name
    save_calibration(path, calibration)
    return str(path)


FOREIGN = {"machine": "another", "exposure_s": 5e-4}


def test_settings_that_differ_are_refused_on_every_way_in(cell, true_calibration):
    """By the service with the reason, from the topic with a word in the log, and nothing flows."""
    cell.processes.start("corrector", settings='{"machine": "another"}')
    feed = Feed(cell)
    path = saved(cell, "foreign.json", true_calibration)
    answer = cell.call(LoadCalibration, "corrector/load_calibration", path=path)
    assert not answer.success
    assert "machine is 'another', calibrated with 'twin'" in answer.message
    assert "override" in answer.message
    assert answer.id == ""

    latched = cell.operator.create_publisher(CalibrationMessage, "/omsm/calibration", LATCHED_QOS)
    latched.publish(
        message_mapping.calibration_message(message_mapping.ros_messages(), true_calibration, 0)
    )
    log = cell.folder / "log" / "corrector.log"
    cell.wait("the refusal", lambda: "calibration refused" in log.read_text())
    feed.send(*blocks())
    cell.wait("the count", lambda: cell.operator.value("corrector", "axes_uncalibrated") == COUNT)
    assert feed.clouds == []
    assert cell.operator.value("corrector", "clouds_published") == 0

    own = replace(true_calibration, settings={"machine": "another"})
    answer = cell.call(
        LoadCalibration, "corrector/load_calibration", path=saved(cell, "own.json", own)
    )
    assert answer.success, answer.message
    assert answer.id == own.id
    assert feed.answer(*blocks(first=10_000)).header.frame_id == "workpiece"


def test_a_refused_calibration_leaves_the_one_in_force(cell, true_calibration):
    cell.processes.start("corrector", calibration=saved(cell, "good.json", true_calibration))
    rejected = replace(
        true_calibration, certificate=certified_by({"verdict": "rejected", "reasons": ["loose"]})
    )
    answer = cell.call(
        LoadCalibration, "corrector/load_calibration", path=saved(cell, "bad.json", rejected)
    )
    assert not answer.success
    assert "loose" in answer.message
    assert answer.id == true_calibration.id
    cell.wait(
        "the calibration in force",
        lambda: cell.operator.text("corrector", "calibration") == true_calibration.id,
    )


def test_requests_without_their_subject_name_what_is_missing(cell, true_calibration):
    cell.processes.start("corrector", calibration=saved(cell, "cal.json", true_calibration))
    loaded = cell.call(LoadCalibration, "corrector/load_calibration", path="")
    assert (loaded.success, loaded.id) == (False, true_calibration.id)
    assert loaded.message == "no path is given; name a file of a calibration, CAL.json"
    predicted = cell.call(PredictError, "corrector/predict_error")
    assert not predicted.safe
    assert predicted.message.startswith("no motion is given: name a bag, or give z")


def test_an_overridden_calibration_marks_every_cloud_by_its_frame(cell, true_calibration):
    """A viewer that waits for the usual frame shows nothing; one that belongs ends it."""
    path = saved(cell, "cal.json", true_calibration)
    settings = '{"machine": "another"}'
    cell.processes.start("corrector", calibration=path, settings=settings, override=True)
    feed = Feed(cell)
    for number in range(2):
        cloud = feed.answer(*blocks(first=number * COUNT))
        assert cloud.header.frame_id == "workpiece_overridden"
    cell.wait("the warning", lambda: "do not match" in cell.operator.text("corrector", "message"))
    own = replace(true_calibration, settings={"machine": "another"})
    answer = cell.call(
        LoadCalibration, "corrector/load_calibration", path=saved(cell, "own.json", own)
    )
    assert answer.success, answer.message
    assert feed.answer(*blocks(first=10_000)).header.frame_id == "workpiece"
    # Counts survive a new calibration.
    value = cell.operator.value
    cell.wait("the counts", lambda: value("corrector", "clouds_published") == 3)
    assert value("corrector", "axes_received") == 3 * COUNT
    cell.wait("no warning", lambda: cell.operator.text("corrector", "message") == "correcting")


def test_what_waits_at_the_end_is_corrected_and_named(cell, true_calibration):
    """The node is asked to end while it stands still and blocks come."""
    cell.processes.start("corrector", calibration=saved(cell, "cal.json", true_calibration))
    feed, accounts = Feed(cell), []
    cell.operator.create_subscription(Account, "/omsm/account", accounts.append, SAMPLES_QOS)
    feed.answer(*blocks())
    cell.wait("an account", lambda: accounts)
    pid = cell.processes.pid("corrector")
    os.kill(pid, signal.SIGSTOP)
    for number in range(1, 11):
        feed.send(*blocks(first=number * COUNT))
    os.kill(pid, signal.SIGINT)
    os.kill(pid, signal.SIGCONT)
    cell.processes.end("corrector")
    said = (cell.folder / "log" / "corrector.log").read_text()
    last = said[said.rindex("samples so far: ") :]
    assert last.count(f"'received': {11 * COUNT}") == 2, last
    cell.wait("the last points", lambda: sum(c.width for c in feed.clouds) > 10 * COUNT)
    cell.wait("the last account", lambda: accounts[-1].axes.received == 11 * COUNT)
    assert accounts[-1].axes.pending == accounts[-1].distance.pending == 0


def test_geometry_parameters_place_the_points(cell, true_calibration):
    """With constant z, H(z) is z, and rotation matrices give the point."""
    given = {
        "centre_x": 1e-3, "centre_y": -2e-3, "probe_x": 5e-3, "probe_z": 20e-3,
        "beam_x": 0.02, "beam_y": -0.01,
    }  # fmt: skip
    cell.processes.start(
        "corrector",
        calibration=saved(cell, "cal.json", true_calibration),
        **{f"geometry.{name}": value for name, value in given.items()},
    )
    feed = Feed(cell)
    time = np.arange(COUNT) * PERIOD
    x, y, c = 8e-3 - 1e-3 * time, 1e-4 * time, np.pi * time
    b, z, reading = 0.1 + 0.05 * time, 0.4e-3, 20e-6
    cloud = feed.answer(
        *blocks(z=np.full(COUNT, z), distance=np.full(COUNT, reading), x=x, y=y, b=b, c=c)
    )
    points = message_mapping.cloud_array(cloud)
    assert len(points) > COUNT - 50
    beam = np.array([given["beam_x"], given["beam_y"], 1.0])
    beam /= np.linalg.norm(beam)
    rest = np.array([given["probe_x"], 0.0, given["probe_z"]])
    for point in points[:: len(points) // 7]:
        k = point["sample"]
        about_y = np.array(
            [[np.cos(b[k]), 0, np.sin(b[k])], [0, 1, 0], [-np.sin(b[k]), 0, np.cos(b[k])]]
        )
        about_z = np.array([[np.cos(c[k]), np.sin(c[k])], [-np.sin(c[k]), np.cos(c[k])]])
        reach = about_y @ (rest + beam * reading / true_calibration.static_gain) - rest
        slide = np.array([x[k] - given["centre_x"], y[k] - given["centre_y"]])
        expected = about_z @ (slide + reach[:2])
        np.testing.assert_allclose([point["x"], point["y"]], expected, atol=2e-9)
        assert point["height"] == pytest.approx(z + reach[2], abs=1e-12)


def test_predict_error_of_a_sine_is_that_of_its_frequency(cell, true_calibration, tmp_path):
    """2 A |1 − G(jω)| from peak to valley; and the same from a bag."""
    cell.processes.start("corrector", calibration=saved(cell, "cal.json", true_calibration))
    amplitude, frequency = 0.3e-3, 2.0
    z = amplitude * np.sin(2 * np.pi * frequency * np.arange(5000) * PERIOD)
    ask = {"sample_period": PERIOD, "z": z.tolist()}
    answer = cell.call(PredictError, "corrector/predict_error", **ask)
    lost = abs(1 - true_calibration.dynamics.response([frequency])[0])
    assert answer.safe, answer.message
    assert answer.peak_to_valley == pytest.approx(2 * amplitude * lost, rel=1e-3)
    # Without what settles, the last turn is not a whole one.
    assert answer.rms == pytest.approx(amplitude * lost / np.sqrt(2), rel=5e-3)
    assert answer.outside_band_fraction < 1e-6
    assert "within the budget" in answer.message

    bag = tmp_path / "motion.mcap"
    zero = np.zeros(5000)
    with BagWriter(bag, (bags.AXES_TOPIC,)) as writer:
        for first in range(0, 5000, 500):
            writer.write_block(
                AxisBlock(
                    stamp_ns=first * 1_000_000,
                    first_sample=first,
                    sample_period=PERIOD,
                    z=z[first : first + 500],
                    **dict.fromkeys("xybc", zero[:500]),
                )
            )
    from_bag = cell.call(PredictError, "corrector/predict_error", bag=str(bag))
    assert from_bag.peak_to_valley == answer.peak_to_valley
    assert from_bag.rms == answer.rms

    shaken = z + 1e-6 * np.sin(2 * np.pi * 180.0 * np.arange(5000) * PERIOD)
    ask = {"sample_period": PERIOD, "z": shaken.tolist()}
    answer = cell.call(PredictError, "corrector/predict_error", **ask)
    assert not answer.safe
    # Mean square velocity of one sine over that of both.
    share = (1e-6 * 180.0) ** 2 / ((1e-6 * 180.0) ** 2 + (amplitude * frequency) ** 2)
    assert answer.outside_band_fraction == pytest.approx(share, rel=0.02)


def test_a_slip_of_the_counters_is_an_error_and_ends_the_points(cell, true_calibration):
    """The probe misses two triggers: its count is behind from then on, its stamps are not."""
    cell.processes.start("corrector", calibration=saved(cell, "cal.json", true_calibration))
    feed, length = Feed(cell), 100
    for number in range(40):
        common = {"sample_period": PERIOD, "first_sample": number * length}
        stamp = number * length * 1_000_000
        zero = np.zeros(length)
        missed = 2 if number >= 20 else 0
        feed.send(
            AxisBlock(**common, stamp_ns=stamp, z=zero, **dict.fromkeys("xybc", zero)),
            DistanceBlock(**common, stamp_ns=stamp + missed * 1_000_000, distance=zero),
        )
    cell.wait(
        "all samples of both in the account",
        lambda: all(
            cell.operator.value("corrector", f"{stream}_received") == 40 * length
            for stream in ("axes", "distance")
        ),
    )
    cell.wait("the slip", lambda: cell.operator.value("corrector", "slip_samples") == -2)
    for stream in ("axes", "distance"):
        assert cell.operator.value("corrector", f"{stream}_slipped") == 20 * length
    cell.processes.check()


def test_live_points_are_those_of_the_core(cell, true_calibration, small_scan):
    """Bit for bit, whatever was between: messages, DDS, blocks."""
    from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
    from omsm_ros.core.correction.machine_sources import NOTHING_STATED
    from omsm_ros.core.correction.surface_points import join_points, pack_points
    from omsm_ros.pipelines.measure import with_sources

    cell.processes.start("corrector", calibration=saved(cell, "cal.json", true_calibration))
    feed = Feed(cell)
    pairs = blocks_of(small_scan)[:30]
    # Sources that nobody stated are assumed, live as offline.
    options = with_sources(CorrectionOptions(), true_calibration, NOTHING_STATED, None)
    corrector = Corrector(true_calibration, options)
    parts = []
    for axes, distance in pairs:
        feed.send(axes, distance)
        corrector.push_axes(axes)
        corrector.push_distance(distance)
        parts.append(corrector.take())
    expected = pack_points(join_points([part for part in parts if part is not None]))
    cell.wait("the clouds", lambda: sum(c.width for c in feed.clouds) >= len(expected))
    assert b"".join(bytes(cloud.data) for cloud in feed.clouds) == expected.tobytes()
    # Each cloud carries the time of its own first point.
    for cloud in feed.clouds:
        first = np.frombuffer(bytes(cloud.data), expected.dtype)["sample"][0]
        stamp = cloud.header.stamp
        assert stamp.sec * 10**9 + stamp.nanosec == first * 1_000_000
