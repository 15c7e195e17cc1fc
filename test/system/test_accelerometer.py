"""The accelerometer's node, live: a line in volts arrives as acceleration, in order."""

import numpy as np
import pytest
from omsm_msgs.msg import AccelerationBlock

from omsm_ros.io import message_mapping


def test_a_line_of_vibration_arrives_with_its_size(cell):
    from omsm_ros.nodes.topics import SAMPLES_QOS

    heard = []
    cell.operator.create_subscription(
        AccelerationBlock, "/omsm/acceleration", heard.append, SAMPLES_QOS
    )
    address = "synthetic://?frequency=125&amplitude=0.05&noise=0.001"
    cell.processes.start("accelerometer_driver", port=address, sample_period=5e-4, block_size=200)
    cell.wait("four thousand samples", lambda: len(heard) >= 20)
    blocks = [message_mapping.block_of(message) for message in heard[:20]]
    firsts = np.array([block.first_sample for block in blocks])
    assert np.all(np.diff(firsts) == 200)
    x = np.concatenate([block.x for block in blocks])
    spectrum = np.abs(np.fft.rfft(x)) / (len(x) / 2)
    assert np.argmax(spectrum) == 125 * len(x) * 5e-4
    # 0.05 V at 0.5 V/g are a tenth of standard gravity.
    assert spectrum.max() == pytest.approx(0.980665, rel=1e-2)
    decoded = cell.operator.value("accelerometer_driver", "decoded")
    assert decoded > 0
    assert cell.operator.value("accelerometer_driver", "lost") == 0
