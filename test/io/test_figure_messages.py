"""Figures of the nodes are messages that can be plotted, in SI units."""

import json
import math
from dataclasses import replace

import pytest

pytest.importorskip("omsm_msgs", reason="the messages are not built")

from omsm_ros.core.ripple.accelerometer import VibrationLevels
from omsm_ros.core.streams.blocks import Account, StreamAccount
from omsm_ros.io import figure_messages as figures
from omsm_ros.io.message_mapping import header, ros_messages

MESSAGES = ros_messages()


def test_settings_of_a_probe_are_in_si_units_and_none_is_lost():
    said = {"device": "chrocodile", "rate": "70000", "averaging": 2, "lamp": "40", "head": "3",
            "full_scale": "660"}  # fmt: skip
    message = figures.probe_message(MESSAGES, said, 5_000_000_007)
    assert (message.device, message.rate, message.averaging) == ("chrocodile", 70e3, 2)
    assert (message.lamp, message.full_scale) == pytest.approx((0.4, 660e-6))
    assert json.loads(message.other) == {"head": "3"}
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (5, 7)
    silent = figures.probe_message(MESSAGES, {"device": "x", "rate": "auto"}, 0)
    assert math.isnan(silent.rate)
    assert (silent.averaging, silent.model) == (0, "")
    assert json.loads(silent.other) == {"rate": "auto"}


def test_an_account_closes():
    axes = StreamAccount(10, 6, 1, {"late": 2, "unmatched": 1}, missing=4)
    account = Account(axes, replace(axes, counted={}, corrected=9))
    outside = {"uncalibrated": {"axes": 3, "distance": 0}, "refused": {"axes": 0, "distance": 8}}
    message = figures.account_message(MESSAGES, account, outside, 12, 0)
    for stream in (message.axes, message.distance):
        assert stream.received == stream.corrected + stream.pending + sum(stream.samples)
    assert dict(zip(message.axes.reasons, message.axes.samples, strict=True)) == {
        "late": 2,
        "unmatched": 1,
    }
    assert (message.axes.uncalibrated, message.distance.refused, message.clouds) == (3, 8, 12)


def test_vibration_has_a_level_for_each_band_and_nan_without_a_calibration():
    levels = VibrationLevels(
        bands=((5.0, 50.0), (50.0, 500.0)),
        rms=dict.fromkeys("xyz", (1e-3, 2e-3)),
        line=("z", 79.0, 3e-3), height=None, height_total=None, height_noise=None,
        windows=4, height_line=None,
    )  # fmt: skip
    message = figures.vibration_message(MESSAGES, levels, False, 20e-9, header(MESSAGES, 0, "p"))
    assert (list(message.low), list(message.high)) == ([5.0, 50.0], [50.0, 500.0])
    assert list(message.rms_z) == [1e-3, 2e-3]
    unknown = [*message.height, message.height_total, message.height_noise]
    assert all(map(math.isnan, unknown))
    known = replace(levels, height=(1e-9, 2e-9), height_total=3e-9, height_noise=4e-9)
    message = figures.vibration_message(MESSAGES, known, False, 20e-9, message.header)
    assert (message.height_total, message.height_noise) == (3e-9, 4e-9)
    assert message.header.frame_id == "p"


def test_a_certificate_states_the_lag_and_nan_for_what_it_does_not_know(true_calibration):
    message = figures.certificate_message(MESSAGES, true_calibration)
    dynamics = true_calibration.dynamics
    lag = dynamics.delay + dynamics.denominator[1] - dynamics.numerator[1:2].sum()
    assert message.lag == pytest.approx(lag)
    assert message.id == true_calibration.id
    assert math.isnan(message.residual_rms)
