"""A node killed at any moment and restarted works within seconds, and reports its losses."""

import random
import signal

import pytest
from omsm_msgs.msg import AxisBlock, DistanceBlock
from omsm_msgs.srv import Identify, PredictError
from std_srvs.srv import Trigger

from omsm_ros.io import message_mapping
from omsm_ros.io.calibration_file import save_calibration
from omsm_ros.nodes.topics import REQUESTS_QOS
from omsm_ros.twin.cell import blocks_of

LAPSE = 2.0
SCANS = 6  # a minute, more than a busy computer needs to start a node; it is stopped before its end
SCAN = 20_000


def start_scanning(cell, calibration):
    cell.start_correcting(calibration, time_lapse=LAPSE, start_radius=SCANS * 1e-3)
    assert cell.call(Trigger, "cell_emulator/scan").success


def stop_scanning(cell, *counts):
    """Stop once the corrector has ``counts``, and return how many samples were played."""
    value = cell.operator.value
    cell.wait("counts", lambda: all(value("corrector", name) > 0 for name in counts))
    assert cell.call(Trigger, "cell_emulator/stop").success
    cell.settle("cell_emulator", "samples_played")
    cell.settle("corrector", "axes_received")
    return value("cell_emulator", "samples_played")


def kill_at(cell, node, samples, restart):
    cell.wait(
        f"sample {samples}",
        lambda: cell.operator.value("cell_emulator", "samples_played") >= samples,
    )
    cell.processes.end(node, how=signal.SIGKILL)
    cell.operator.forget(node)
    restart()
    cell.wait(f"the new {node}", lambda: cell.operator.text(node, "lifecycle") == "active")


def seeds(many):
    """One for each run of the tests, more in the soak."""
    return [0, *(pytest.param(k, marks=pytest.mark.soak) for k in range(1, many))]


@pytest.mark.parametrize("seed", seeds(10))
def test_a_killed_driver_leaves_a_gap_that_is_counted(cell, true_calibration, seed):
    """corrected + counted reasons + missing are what the emulator sent."""
    start_scanning(cell, true_calibration)
    when = random.Random(seed).randrange(1000, SCAN // 3)
    kill_at(cell, "confocal_driver", when, cell.start_driver)
    sent = stop_scanning(cell, "missing_axes", "missing_distance", "axes_corrected")
    for stream in ("axes", "distance"):
        missing = cell.operator.value("corrector", f"missing_{stream}")
        assert cell.closed_account(stream) + missing == sent


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(10))
def test_a_killed_corrector_goes_on_where_it_comes_back(cell, true_calibration, seed):
    start_scanning(cell, true_calibration)
    path = str(cell.folder / "cal.json")
    when = random.Random(seed).randrange(1000, SCAN // 3)
    kill_at(cell, "corrector", when, lambda: cell.processes.start("corrector", calibration=path))
    sent = stop_scanning(cell, "axes_corrected")
    # It says where it came in; from there on none is missing. Streams are found a moment apart.
    for stream in ("axes", "distance"):
        assert cell.operator.value("corrector", f"missing_{stream}") == 0
        begins_at = cell.operator.value("corrector", f"begins_at_{stream}")
        assert 0 < begins_at == sent - cell.closed_account(stream)
    assert cell.operator.value("confocal_driver", "delivered") == sent


def single_samples(cell, count):
    """Blocks of one sample at 1 kHz to the corrector."""
    axes, distance = cell.publisher("axes", AxisBlock), cell.publisher("confocal", DistanceBlock)
    messages = message_mapping.ros_messages()
    zero = [0.0]
    common = {"sample_period": 1e-3}
    made = (
        AxisBlock(**common, **dict.fromkeys("xybcz", zero)),
        DistanceBlock(**common, distance=zero),
    )
    start = cell.operator.get_clock().now().nanoseconds
    for k in range(count):
        due = start + k * 1_000_000
        while cell.operator.get_clock().now().nanoseconds < due:
            pass
        for publisher, message in zip((axes, distance), made, strict=True):
            message.first_sample = k
            message.header = message_mapping.header(messages, due, "")
            publisher.publish(message)


@pytest.mark.soak
@pytest.mark.timeout(0)  # five minutes
@pytest.mark.parametrize("count", [3000, 300_000])
def test_blocks_of_one_sample_are_all_in_the_account(cell, true_calibration, count):
    path = cell.folder / "cal.json"
    save_calibration(path, true_calibration)
    cell.processes.start("corrector", calibration=str(path))
    single_samples(cell, count)
    for stream in ("axes", "distance"):
        cell.settle("corrector", f"{stream}_received")
        received = cell.closed_account(stream)
        assert received + cell.operator.value("corrector", f"missing_{stream}") == count


@pytest.mark.soak
def test_two_hundred_calls_at_once_are_all_answered(cell, step_test):
    """The first are worked on, the others are told to come again; no sample waits for them."""
    cell.processes.start("calibrator", output=str(cell.folder / "new.json"))
    axes, distance = cell.publisher("axes", AxisBlock), cell.publisher("confocal", DistanceBlock)
    messages = message_mapping.ros_messages()
    for pair in blocks_of(step_test):
        axes.publish(message_mapping.block_message(messages, pair[0]))
        distance.publish(message_mapping.block_message(messages, pair[1]))
    held = len(step_test.axes)
    cell.wait("all of it", lambda: cell.operator.value("calibrator", "axes_held") == held)
    # A caller that is late reads as many answers as its queue holds.
    client = cell.operator.create_client(
        Identify, "/omsm/calibrator/identify", qos_profile=REQUESTS_QOS
    )
    assert client.wait_for_service(10.0)
    cell.settle("calibrator", "axes_held")
    futures = [client.call_async(Identify.Request(order=99)) for _ in range(100)]
    futures += [client.call_async(Identify.Request(order=2)) for _ in range(100)]
    cell.wait("all answers", lambda: all(future.done() for future in futures))
    answers = [future.result() for future in futures]
    assert all("order" in answer.message for answer in answers[:100])
    busy = [answer for answer in answers[100:] if "busy" in answer.message]
    assert len(busy) >= 80
    assert sum(answer.success for answer in answers) == 100 - len(busy)
    assert cell.operator.value("calibrator", "defects") == 0


@pytest.mark.soak
def test_a_prediction_does_not_stop_the_samples(cell, true_calibration, small_scan_blocks):
    path = cell.folder / "cal.json"
    save_calibration(path, true_calibration)
    cell.processes.start("corrector", calibration=str(path))
    axes, distance = cell.publisher("axes", AxisBlock), cell.publisher("confocal", DistanceBlock)
    messages = message_mapping.ros_messages()
    client = cell.operator.create_client(PredictError, "/omsm/corrector/predict_error")
    assert client.wait_for_service(10.0)
    z = [1e-6 * (k % 50) for k in range(200_000)]
    futures = [client.call_async(PredictError.Request(z=z, sample_period=1e-3)) for _ in range(3)]
    for pair in small_scan_blocks[:100]:
        axes.publish(message_mapping.block_message(messages, pair[0]))
        distance.publish(message_mapping.block_message(messages, pair[1]))
    sent = sum(len(pair[0]) for pair in small_scan_blocks[:100])
    cell.wait("all samples", lambda: cell.operator.value("corrector", "distance_received") == sent)
    cell.wait("all answers", lambda: all(future.done() for future in futures))
    assert cell.closed_account("axes") == sent
