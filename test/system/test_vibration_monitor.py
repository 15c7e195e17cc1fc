"""The monitor hears the emulated accelerometer, warns, and calms down."""

import numpy as np
import pytest
import yaml
from omsm_msgs.msg import AccelerationBlock as AccelerationMessage
from std_srvs.srv import Trigger

from omsm_ros.core.streams.blocks import AccelerationBlock
from omsm_ros.io import bags, message_mapping


def values(cell):
    """Texts of the diagnostics; 0 before the first."""
    return lambda key: cell.operator.text("vibration_monitor", key) or "0"


def test_the_emulated_cells_vibration_is_measured_and_warned_of(cell):
    wrong = {
        "vibration": [{"amplitude_m": 50e-9, "frequency_hz": 680.0}],
        "accelerometer": {"sample_period_s": 2.5e-4},
    }
    file = cell.folder / "wrong.yaml"
    file.write_text(yaml.safe_dump(wrong))
    path = cell.folder / "scan.mcap"
    cell.processes.start("vibration_monitor", alarm=20e-9)
    cell.processes.start("recorder", path=str(path))
    cell.start_emulator(disturbances=str(file), time_lapse=4.0)
    cell.start_driver()
    said = values(cell)
    answer = cell.call(Trigger, "cell_emulator/scan")
    assert answer.success, answer.message
    cell.wait("an alarm", lambda: said("alarms") == "1")
    assert float(said("line_frequency")) == pytest.approx(680.0, abs=1.5)
    assert float(said("height_500_2000_hz")) == pytest.approx(50e-9 / 2**0.5, rel=0.05)
    assert said("alarm") == "True"
    recorded = lambda: cell.operator.value("recorder", "/omsm/vibration")  # noqa: E731
    cell.wait("levels in the bag", lambda: recorded() >= 1)
    cell.processes.end("recorder")
    with bags.BagReader(path) as bag:
        reported = bag.vibration()[-1]
    assert reported["bands"][-1] == [500.0, 2000.0]
    assert reported["height"][-1] == pytest.approx(50e-9 / 2**0.5, rel=0.05)
    assert reported["line"]["frequency"] == pytest.approx(680.0, abs=1.5)


def test_the_alarm_ends_when_it_is_quiet(cell):
    cell.processes.start("vibration_monitor", alarm=20e-9, averages=1)
    publisher = cell.publisher("acceleration", AccelerationMessage)
    messages, time, said = message_mapping.ros_messages(), np.arange(4000) / 4000.0, values(cell)
    for k, size in enumerate((50e-9, 50e-9, 1e-9, 1e-9)):
        z = size * (2 * np.pi * 680) ** 2 * np.sin(2 * np.pi * 680 * time)
        block = AccelerationBlock(
            stamp_ns=0, first_sample=4000 * k, sample_period=2.5e-4, x=0 * z, y=0 * z, z=z
        )
        publisher.publish(message_mapping.block_message(messages, block))
    cell.wait("all samples", lambda: said("samples") == "16000")
    assert (said("alarms"), said("alarm")) == ("1", "False")
    cell.wait("the report of silence", lambda: "no acceleration for" in said("message"))
