"""Latched topics are silent while nothing changes, under simulated time too."""

import os
import time

import pytest
import rclpy
from omsm_msgs.msg import Calibration as CalibrationMessage
from soaked import soaked

from omsm_ros.io.calibration_file import save_calibration
from omsm_ros.nodes.topics import LATCHED_BY_MANY_QOS


@pytest.mark.parametrize("simulated", [True, *soaked(False)])
def test_calibration_of_tomorrow_is_published_once(cell, true_calibration, simulated):
    path = cell.folder / "cal.json"
    save_calibration(path, true_calibration)
    tomorrow = time.time() + 86_400
    os.utime(path, (tomorrow, tomorrow))
    heard = []
    cell.operator.create_subscription(
        CalibrationMessage, "/omsm/calibration", heard.append, LATCHED_BY_MANY_QOS
    )
    cell.processes.start("corrector", calibration=str(path), use_sim_time=simulated)
    cell.wait("the calibration", lambda: heard)
    end = time.monotonic() + 3.0
    while time.monotonic() < end:
        rclpy.spin_once(cell.operator, timeout_sec=0.1)
    assert 1 <= len(heard) <= 2
    assert {message.id for message in heard} == {true_calibration.id}
