"""A second sensor on /omsm/reference: its scale is reported, and it can be the input."""

import json

import numpy as np
import pytest
from omsm_msgs.msg import AxisBlock as AxisMessage
from omsm_msgs.msg import DistanceBlock as DistanceMessage
from omsm_msgs.srv import Identify

from omsm_ros.core.streams.blocks import DistanceBlock
from omsm_ros.io import message_mapping
from omsm_ros.io.calibration_file import load_calibration
from omsm_ros.twin.cell import blocks_of
from omsm_ros.twin.plant import PAPER_STATIC_GAIN, Plant

# The reference reads a little more than the encoder: the paper's Eq. 3 splits the gain there.
SCALE = 1.0004


def reference_block(axes, random):
    """A capacitive sensor that sees the table itself; the farther away, the lower it is."""
    return DistanceBlock(
        stamp_ns=axes.stamp_ns,
        first_sample=axes.first_sample,
        sample_period=axes.sample_period,
        distance=SCALE * axes.z + random.normal(0.0, 1e-9, len(axes)),
    )


def test_a_reference_over_dds_is_distinguished_and_can_be_the_input(cell, step_test):
    output = cell.folder / "cal.json"
    cell.processes.start("calibrator", output=str(output))
    messages, random = message_mapping.ros_messages(), np.random.default_rng(5)
    kinds = {"axes": AxisMessage, "confocal": DistanceMessage, "reference": DistanceMessage}
    publishers = {topic: cell.publisher(topic, kind) for topic, kind in kinds.items()}
    for axes, distance in blocks_of(step_test):
        reference = reference_block(axes, random)
        publishers["axes"].publish(message_mapping.block_message(messages, axes))
        publishers["confocal"].publish(message_mapping.block_message(messages, distance))
        publishers["reference"].publish(message_mapping.block_message(messages, reference))
    samples = len(step_test.axes)
    for count in ("axes_held", "distance_held", "reference_held"):
        cell.wait(count, lambda c=count: cell.operator.value("calibrator", c) == samples)

    by_encoder = cell.call(Identify, "calibrator/identify", input="encoder")
    assert by_encoder.success, by_encoder.message
    gains = json.loads(by_encoder.calibration.certificate)["static_gain"]
    assert gains["reference_per_encoder"]["value"] == pytest.approx(SCALE, abs=1e-5)
    expected = PAPER_STATIC_GAIN / SCALE
    assert gains["probe_per_reference"]["value"] == pytest.approx(expected, abs=5e-5)

    by_reference = cell.call(Identify, "calibrator/identify", input="reference")
    assert by_reference.success, by_reference.message
    found = load_calibration(output)
    assert found.id == by_reference.calibration.id != by_encoder.calibration.id
    assert found.certificate.origin.input == "reference"
    assert found.static_gain == pytest.approx(expected, abs=5e-5)
    ratio = found.dynamics.response([1.0]) / Plant().dynamics.response([1.0])
    assert abs(np.angle(ratio[0], deg=True)) < 2e-3


def test_without_a_reference_it_cannot_be_the_input(cell, step_test):
    cell.processes.start("calibrator", output=str(cell.folder / "cal.json"))
    messages = message_mapping.ros_messages()
    axes_to = cell.publisher("axes", AxisMessage)
    distance_to = cell.publisher("confocal", DistanceMessage)
    for axes, distance in blocks_of(step_test):
        axes_to.publish(message_mapping.block_message(messages, axes))
        distance_to.publish(message_mapping.block_message(messages, distance))
    samples = len(step_test.axes)
    cell.wait("all", lambda: cell.operator.value("calibrator", "distance_held") == samples)
    answer = cell.call(Identify, "calibrator/identify", input="reference")
    assert not answer.success
    assert "publish /omsm/reference" in answer.message
    assert not (cell.folder / "cal.json").exists()
