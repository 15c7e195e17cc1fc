"""A driver publishes blocks, settings and state of a scripted device."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("omsm_msgs", reason="the messages are not built")

from omsm_ros.core.streams.blocks import AxisBlock, DistanceBlock
from omsm_ros.core.streams.monitoring import RecentIncrease, SampleFlow
from omsm_ros.instruments.blocks import Channels
from omsm_ros.instruments.reader import State
from omsm_ros.io import message_mapping
from omsm_ros.nodes import driver as driving
from omsm_ros.nodes.diagnostics import ERROR, OK, STALE, WARN
from omsm_ros.nodes.driver import DriverNode

from .fake_node import FakeNode


class Published(list):
    def publish(self, message):
        self.append(message)

    def get_subscription_count(self):
        return 3

    def __bool__(self):
        return True


class Driver(SimpleNamespace):
    """A DriverNode's own methods on what they need, without a node of ROS."""

    report, _publish = DriverNode.report, DriverNode._publish
    _publish_settings = DriverNode._publish_settings
    _add_faults = DriverNode._add_faults
    hardware_id, hardware = DriverNode.hardware_id, DriverNode.hardware


@pytest.fixture
def driver(monkeypatch):
    now = [50.0]
    monkeypatch.setattr(driving.time, "monotonic", lambda: now[0])
    counts = dict.fromkeys(
        ("received", "decoded", "malformed", "lost", "losses_of_sync", "restarts", "resets"), 0
    )
    made = Driver(
        now=now, counts=counts,
        values={"device": "six_channel", "port": "tcp://a:1", "sample_period": 1e-3,
                "machine_frame": "mill", "probe_frame": "needle"},
        _device=SimpleNamespace(counts=lambda: dict(counts), identity={"version": "2.1"},
                                caution="", settings={"rate_hz": 1000.0}),
        _reader=SimpleNamespace(state=State.READING, trouble="", connections=2),
        _recent=RecentIncrease(), _flow=SampleFlow(), _reported={},
        _messages=message_mapping.ros_messages(),
        _topics={AxisBlock: "axes", DistanceBlock: "confocal"},
        _publisher_of={AxisBlock: Published(), DistanceBlock: Published()},
        _settings=Published(), _plotted=Published(), get_clock=FakeNode().get_clock,
    )  # fmt: skip

    def passes(seconds, samples, **more):
        now[0] += seconds
        counts["decoded"] += samples
        for name, n in more.items():
            counts[name] += n
        return made.report()

    made.passes = passes
    made.report()
    return made


def test_a_device_that_reads_is_well_and_says_how_fast(driver):
    for _ in range(5):
        report = driver.passes(1.0, 1000)
    assert (report.level, report.text) == (OK, "reading at 1000 Hz")
    assert report.values["state"] == "reading"
    assert report.values["version"] == "2.1"
    assert report.values["connections"] == 2
    assert report.values["decoded"] == 5000
    assert report.values["axes_subscribers"] == report.values["confocal_subscribers"] == 3
    assert driver.hardware_id() == "tcp://a:1"


def test_new_faults_are_reported_by_name_while_recent(driver):
    driver.passes(1.0, 1000)
    report = driver.passes(1.0, 1000, malformed=3, losses_of_sync=1)
    assert report.level == WARN
    assert report.text == "just now: malformed 3, losses_of_sync 1"
    for _ in range(15):
        report = driver.passes(1.0, 1000)
    assert report.level == OK
    assert report.values["malformed"] == 3  # it stays in the history


def test_a_device_that_never_sent_anything_and_one_that_fell_silent(driver):
    report = driver.passes(1.0, 0)
    assert (report.level, report.text) == (STALE, "connected, but no sample has come yet")
    driver.passes(1.0, 500)
    assert driver.passes(1.9, 0).level == OK
    report = driver.passes(2.1, 0)
    assert (report.level, report.text) == (STALE, "no sample for 4 s")


def test_a_slow_device_is_not_silent_between_its_samples(driver):
    driver.values["sample_period"] = 10.0
    driver.passes(1.0, 1)
    assert driver.passes(45.0, 0).level == OK
    assert driver.passes(10.0, 0).level == STALE


@pytest.mark.parametrize("state", [State.CONNECTING, State.LOST])
def test_before_it_reads_silence_is_not_what_is_wrong(driver, state):
    driver._reader.state, driver._reader.trouble = state, "no answer from tcp://a:1"
    report = driver.passes(60.0, 0)
    assert (report.level, report.text) == (ERROR, "no answer from tcp://a:1")
    assert report.values["state"] == state.value


def pair():
    k = np.arange(4.0)
    same = {"stamp_ns": 7 * 10**9 + 5, "first_sample": 12, "sample_period": 1e-3}
    return (
        AxisBlock(x=k, y=k + 1, z=k + 2, b=k + 3, c=k + 4, **same),
        DistanceBlock(distance=k * 1e-6, **same),
    )


def test_blocks_go_out_with_their_frames_stamps_and_values(driver):
    axes, distance = pair()
    driver._publish([(axes, distance), (None, distance), (axes, None)])
    sent_axes, sent_distance = driver._publisher_of.values()
    assert (len(sent_axes), len(sent_distance)) == (2, 2)
    sent = sent_axes[0]
    assert sent.header.frame_id == "mill"
    assert (sent.header.stamp.sec, sent.header.stamp.nanosec) == (7, 5)
    assert (sent.first_sample, sent.sample_period) == (12, 1e-3)
    for name in ("x", "y", "z", "b", "c"):
        assert list(getattr(sent, name)) == list(getattr(axes, name))
    assert sent_distance[0].header.frame_id == "needle"
    assert list(sent_distance[0].distance) == [0.0, 1e-6, 2e-6, 3e-6]


def test_a_driver_of_axes_alone_passes_over_distances(driver):
    del driver._publisher_of[DistanceBlock]
    driver._publish([pair()])
    assert len(driver._publisher_of[AxisBlock]) == 1
    assert "confocal_subscribers" not in driver.passes(1.0, 1000).values


@pytest.mark.parametrize("axes", [None, ()])
def test_a_driver_publishes_axes_only_if_its_device_has_some(driver, axes):
    # The driver of the axes publishes them too: two publishers of one topic are warned of.
    device = SimpleNamespace(channels=Channels(axes=axes))
    driver._make, driver._settings_topic = lambda values, now: device, ""
    driver.get_logger = lambda: SimpleNamespace(info=None, warning=None)
    driver.publish_on = lambda undo, kind, topic: topic
    DriverNode.configure(driver, None)
    published = [*driver._publisher_of.values()]
    assert published == (["confocal"] if axes is None else ["axes", "confocal"])


def test_settings_are_reported_once_before_the_first_block_and_again_when_they_change(driver):
    order = []
    driver._settings.publish = lambda message: order.append(json.loads(message.data))
    driver._publisher_of[AxisBlock].publish = lambda message: order.append("axes")
    driver._publish([pair()])
    driver._publish([pair()])
    driver._device.settings = {"rate_hz": 2000.0}
    driver._publish([pair()])
    reported = {"probe.device": "six_channel", "probe.rate_hz": 1000.0}
    assert order == [reported, "axes", "axes", reported | {"probe.rate_hz": 2000.0}, "axes"]
    driver._settings = None
    driver._publish_settings()


def test_a_counter_that_is_reset_between_two_measurements_is_no_fault(driver):
    """The same restart while samples arrive is one."""
    assert driver.passes(1.0, 1000, restarts=1, resets=1).text.startswith("reading at")
    assert "just now: restarts 1" in driver.passes(1.0, 1000, restarts=2, resets=1).text
