"""The vibration monitor reports known lines: levels, alarms, silence, refused blocks."""

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("omsm_msgs", reason="the messages are not built")

from omsm_msgs import msg

from omsm_ros.core.ripple.accelerometer import PROBE, SLIDE, Alarm, MonitorOptions, RunningSpectrum
from omsm_ros.core.streams.blocks import AccelerationBlock
from omsm_ros.core.streams.monitoring import RecentIncrease, SampleFlow
from omsm_ros.errors import ConfigurationError
from omsm_ros.io import message_mapping
from omsm_ros.nodes import vibration_monitor_node as module
from omsm_ros.nodes.diagnostics import OK, STALE, WARN
from omsm_ros.nodes.vibration_monitor_node import VibrationMonitorNode, _edges

RATE, LINE_HZ = 2000.0, 120.0
EMPTY = msg.AccelerationBlock(sample_period=1 / RATE)  # a message without samples
LIMIT_M = 20e-9


class Monitor(SimpleNamespace):
    """The node's own methods on what they need, without a node of ROS."""

    _take, _levels = VibrationMonitorNode._take, VibrationMonitorNode._levels
    _line = VibrationMonitorNode._line
    report = VibrationMonitorNode.report
    _use = VibrationMonitorNode._use

    def get_logger(self):
        return SimpleNamespace(warning=self.logged.append)


@pytest.fixture
def now(monkeypatch):
    time = [100.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: time[0])
    return time


@pytest.fixture
def made(now):
    def make(mount=PROBE, edges=(5.0, 50.0, 500.0)):
        reported, plotted = [], []
        options = MonitorOptions(edges=edges, mount=mount)
        return Monitor(
            _running=RunningSpectrum(options), _alarm=Alarm(LIMIT_M, 0.7), _refused="",
            _blocks_refused=0, _lately=RecentIncrease(),
            _flow=SampleFlow(), _block=0.0, _calibration=None, _task_result=0,
            reported=reported, logged=[],
            values={"mount": mount}, now=now, sent=0,
            _messages=message_mapping.ros_messages(), plotted=plotted,
            _plotted=SimpleNamespace(publish=plotted.append),
            _publisher=SimpleNamespace(publish=lambda m: reported.append(json.loads(m.data))),
        )  # fmt: skip

    return make


def shake(monitor, seconds, amplitude_m, along="z"):
    """Blocks of 0.1 s of one line whose height has this amplitude, by its second derivative."""
    block = round(RATE / 10)
    for _ in range(round(seconds * 10)):
        t = (monitor.sent + np.arange(block)) / RATE
        wave = -amplitude_m * (2 * np.pi * LINE_HZ) ** 2 * np.sin(2 * np.pi * LINE_HZ * t)
        axes = {name: wave if name == along else 0 * wave for name in ("x", "y", "z")}
        record = AccelerationBlock(
            stamp_ns=0, first_sample=monitor.sent, sample_period=1 / RATE, **axes
        )
        message = message_mapping.block_message(message_mapping.ros_messages(), record)
        monitor._take(message, {})
        monitor.sent += block
        monitor.now[0] += 0.1


def test_before_a_window_is_full_nothing_is_known(made):
    monitor = made()
    shake(monitor, 0.5, 1e-8)
    report = monitor.report()
    assert (report.level, report.text) == (STALE, "no full window of acceleration yet")
    assert report.values["samples"] == 1000
    assert monitor.reported == []


def test_a_line_is_reported_with_its_axis_frequency_size_and_effect(made):
    monitor = made()
    shake(monitor, 3.0, 10e-9)
    found = monitor.reported[-1]
    assert found["line"]["axis"] == "z"
    assert found["line"]["frequency"] == pytest.approx(LINE_HZ, abs=0.5)
    amplitude = 10e-9 * (2 * math.pi * LINE_HZ) ** 2
    assert found["line"]["amplitude"] == pytest.approx(amplitude, rel=0.02)
    assert found["rms"]["z"][1] == pytest.approx(amplitude / math.sqrt(2), rel=0.02)
    # On the probe the encoder sees none of it: the height moves as the probe does.
    assert found["height_total"] == pytest.approx(10e-9 / math.sqrt(2), rel=0.03)
    assert found["alarm"] is False
    assert found["limit"] == LIMIT_M
    report = monitor.report()
    assert report.level == OK
    assert report.values["height_50_500_hz"] == pytest.approx(found["height_total"], rel=1e-3)
    assert report.values["line_axis"] == "z"
    assert "120.0 Hz" in report.text


def test_each_spectrum_is_reported_once(made):
    monitor = made()
    shake(monitor, 4.0, 1e-9)
    # Windows of a second, half overlapping: at 1.0, 1.5, … 4.0 s.
    assert [found["windows"] for found in monitor.reported] == sorted(
        {found["windows"] for found in monitor.reported}
    )
    assert len(monitor.reported) == 7
    assert [found.windows for found in monitor.plotted] == [f["windows"] for f in monitor.reported]


def test_the_alarm_rises_once_stays_and_ends_when_it_is_quiet(made):
    # The jump itself, twice integrated, is a slow motion: it is left out.
    monitor = made(edges=(60.0, 500.0))
    shake(monitor, 3.0, 2.5 * LIMIT_M)
    assert monitor.reported[-1]["alarm"] is True
    report = monitor.report()
    assert report.level == WARN
    assert "vibration beyond 20.0 nm" in report.text
    assert report.values["alarms"] == 1
    shake(monitor, 6.0, 0.1 * LIMIT_M)
    assert monitor.reported[-1]["alarm"] is False
    assert monitor.report().values["alarms"] == 1
    assert [text.split(":")[0] for text in monitor.logged] == [
        "vibration alarm raised", "vibration alarm ended",
    ]  # fmt: skip


def test_on_the_slide_the_effect_needs_a_calibration(made, true_calibration):
    monitor = made(SLIDE)
    shake(monitor, 2.0, 10e-9)
    report = monitor.report()
    assert report.level == WARN
    assert "effect on a height not evaluated: no calibration yet" in report.text
    assert monitor.reported[-1]["height"] is None
    assert "strongest line" in report.message
    monitor._use(true_calibration, 0)
    shake(monitor, 2.0, 10e-9)
    report = monitor.report()
    assert report.values["response_valid_up_to"] == true_calibration.valid_up_to
    # The probe follows what the encoder measures, so the height changes by |1 - G| of it.
    response = complex(true_calibration.dynamics.normalised().response(np.array([LINE_HZ]))[0])
    expected = 10e-9 / math.sqrt(2) * abs(1 - response)
    assert monitor.reported[-1]["height_total"] == pytest.approx(expected, rel=0.1)


def test_silence_is_reported_and_the_levels_are_marked_as_old(made):
    monitor = made()
    shake(monitor, 2.0, 10e-9)
    monitor.report()
    monitor.now[0] += 3.0
    report = monitor.report()
    assert report.level == STALE
    assert "no acceleration for 3 s; the levels are of before" in report.text


def test_a_block_that_is_none_is_refused_by_its_reason(made):
    monitor = made()
    shake(monitor, 2.0, 10e-9)
    record = AccelerationBlock(
        stamp_ns=0,
        first_sample=0,
        sample_period=1 / RATE,
        x=np.zeros(3),
        y=np.zeros(3),
        z=np.zeros(3),
    )
    message = message_mapping.block_message(message_mapping.ros_messages(), record)
    message.sample_period = 0.0
    monitor._take(message, {})
    report = monitor.report()
    assert report.level == WARN
    assert "a block was refused: AccelerationBlock: sample_period is 0.0 s" in report.text
    assert report.values["blocks_refused"] == 1


def test_a_refusal_of_long_ago_is_a_number_only(made, now):
    monitor = made()
    monitor._take(EMPTY, {})
    assert "refused" in monitor.report().text
    for _ in range(3):
        now[0] += 6.0
        report = monitor.report()
    assert "refused" not in report.text
    assert report.values["blocks_refused"] == 1


def test_bands_are_numbers_with_spaces_between():
    assert _edges("5 50  150.5") == (5.0, 50.0, 150.5)
    with pytest.raises(ConfigurationError, match=r"parameter 'bands' is '5,50'"):
        _edges("5,50")
