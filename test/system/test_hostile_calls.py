"""No message, request or parameter ends a node, or stalls it."""

import array
import os
import signal
import subprocess
import sys
import time

import pytest
from omsm_msgs.msg import AxisBlock, Calibration, DistanceBlock
from omsm_msgs.srv import Identify, LoadCalibration, PredictError
from rclpy.qos import QoSProfile

from omsm_ros.io import message_mapping
from omsm_ros.io.calibration_file import save_calibration
from omsm_ros.nodes.topics import LATCHED_QOS

NAN, INF = float("nan"), float("inf")
WAVE = [1e-6 * (k % 50) for k in range(400)]


@pytest.fixture
def files(tmp_path, true_calibration):
    """Paths that are no bag and no calibration, and one that is."""
    folder = tmp_path / "files"
    folder.mkdir()
    save_calibration(folder / "cal.json", true_calibration)
    os.mkfifo(folder / "pipe.mcap")
    (folder / "8.mcap").write_bytes(b"8 bytes.")
    (folder / "text.json").write_text("root:x:0:0")
    names = ("pipe.mcap", "8.mcap", "text.json", "n" * 300, "none", "")
    return folder, [str(folder / name) for name in names] + ["/dev/zero", "/etc/passwd", "/", "."]


def test_hostile_calls_are_answered_and_survived(cell, files):
    folder, paths = files
    good = str(folder / "cal.json")
    cell.processes.start("corrector", calibration=good)
    cell.processes.start("calibrator", output=str(folder / "new.json"))
    load = cell.caller(LoadCalibration, "corrector/load_calibration")
    predict = cell.caller(PredictError, "corrector/predict_error")
    identify = cell.caller(Identify, "calibrator/identify")
    assert load(path=good).success
    for path in paths:
        answer = load(path=path)
        assert not answer.success
        assert answer.message
        assert "root:" not in answer.message
        assert answer.id  # the good one stays in force
    # Each is read by a process, which is that of the other node too.
    for path in (paths[0], "/"):
        assert predict(bag=path).message
    for path in (paths[1], "/dev/zero"):
        answer = identify(bag=path)
        assert not answer.success
        assert answer.message.startswith("identification failed: ")
    for period in (1e300, 1e-300, 0.0, -1.0, NAN, INF, 5e-324):
        answer = predict(z=WAVE, sample_period=period)
        assert not answer.safe
        assert answer.rms != answer.rms  # not a number: it is not known
        assert "sample_period" in answer.message
        answer = identify(duration=-period or NAN)
        assert not answer.success
    for z in ([], [0.0], [NAN] * 400, [1e300] * 400, [INF, *WAVE]):
        answer = predict(z=z, sample_period=1e-3)
        assert not answer.safe
        assert answer.message
    answer = identify(input="x" * 100_000)
    assert len(answer.message) < 2000
    assert "expected 'encoder' or 'reference'" in answer.message  # it has no samples either
    assert "are published" in identify().message
    for order in (21, 2**31, 2**32 - 1):
        assert not identify(order=order).success
    answer = predict(z=WAVE, sample_period=1e-3)
    assert answer.peak_to_valley > 0
    for node in ("corrector", "calibrator"):
        assert cell.operator.value(node, "defects") == 0
    cell.processes.check()


def test_answers_come_no_faster_than_a_client_fetches_them(cell):
    """A client holds ten answers by default; of two hundred in one go it would lose most."""
    cell.processes.start("calibrator", output=str(cell.folder / "new.json"))
    # Deeper than the default, for this process may be held up for longer than ten answers take.
    deep = QoSProfile(depth=100)
    client = cell.operator.create_client(Identify, "/omsm/calibrator/identify", qos_profile=deep)
    cell.wait("the service", client.service_is_ready)
    cell.settle("calibrator", "requests_waiting")
    asked = [Identify.Request(order=99 if k % 2 else 2) for k in range(200)]
    begin = time.monotonic()
    futures = [client.call_async(request) for request in asked]
    cell.wait("all answers", lambda: all(future.done() for future in futures))
    assert time.monotonic() - begin > 199 * 0.01
    for k, future in enumerate(futures):
        assert ("order is 99" if k % 2 else "0 axis blocks") in future.result().message


def hostile_calibrations(good):
    """Messages of a calibration with one thing wrong each, signed where they can be."""
    changes = [
        {"numerator": [NAN, 1.0]}, {"numerator": [0.0]}, {"numerator": []}, {"numerator": [5.0]},
        {"denominator": [1.0, 1e6, 1e-6]}, {"denominator": [1.0, -1e-3]}, {"denominator": []},
        {"denominator": [1.0] * 5000}, {"delay": 1000.0}, {"delay": NAN}, {"static_gain": INF},
        {"sample_period": 1e-300}, {"sample_period": 0.0}, {"valid_up_to": NAN},
        {"covariance": [NAN] * 49}, {"covariance": [1e300] * 49}, {"covariance": []},
        {"settings": "[" * 100_000}, {"settings": "NaN"}, {"certificate": '{"verdict": null}'},
        {"certificate": '{"noise_m": 1e999}'}, {"id": "x" * 10_000},
    ]  # fmt: skip
    for change in changes:
        message = message_mapping.calibration_message(message_mapping.ros_messages(), good, 0)
        for name, value in change.items():
            is_array = isinstance(value, list)
            setattr(message, name, array.array("d", value) if is_array else value)
        yield message


def test_hostile_messages_are_refused_and_survived(cell, true_calibration, small_scan_blocks):
    cell.processes.start("corrector")
    cell.processes.start("calibrator", output=str(cell.folder / "cal.json"))
    latched = cell.operator.create_publisher(Calibration, "/omsm/calibration", LATCHED_QOS)
    cell.wait("the corrector to listen", lambda: latched.get_subscription_count() >= 1)
    for message in hostile_calibrations(true_calibration):
        latched.publish(message)
    messages = message_mapping.ros_messages()
    latched.publish(message_mapping.calibration_message(messages, true_calibration, 0))
    cell.wait(
        "the good calibration to be taken",
        lambda: cell.operator.text("corrector", "calibration") == true_calibration.id,
    )
    axes = cell.publisher("axes", AxisBlock, 2)
    distance = cell.publisher("confocal", DistanceBlock, 2)
    for pair in small_scan_blocks[:20]:
        for period, first in ((1e300, 0), (1e-300, 0), (NAN, 0), (1e-3, 2**64 - 1), (1e-3, 2**53)):
            for to, make, block in zip(
                (axes, distance),
                (message_mapping.block_message, message_mapping.block_message),
                pair,
                strict=True,
            ):
                message = make(messages, block)
                message.sample_period, message.first_sample = period, first
                to.publish(message)
        axes.publish(message_mapping.block_message(messages, pair[0]))
        distance.publish(message_mapping.block_message(messages, pair[1]))
    cell.wait(
        "the good blocks to be counted",
        lambda: cell.operator.value("corrector", "axes_received") >= 2000,
    )
    assert cell.settle("corrector", "axes_refused") > 0
    assert cell.operator.value("corrector", "axes_corrected") > 0
    assert cell.operator.value("corrector", "defects") == 0
    cell.processes.check()


@pytest.mark.parametrize(
    ("node", "parameter", "named"),
    [
        ("corrector", "geometry.beam_x:=.nan", "beam_x"),
        ("corrector", "settings:='[1]'", "settings"),
        ("corrector", "calibration:=/dev/zero", "no regular file"),
        ("calibrator", "buffer_samples:=many", "buffer_samples"),
        ("calibrator", "use_sim_time:=maybe", "use_sim_time"),
    ],
)
def test_a_wrong_parameter_is_one_line_and_exit_2(refused, node, parameter, named):
    assert named in refused(node, "-p", parameter)


def test_interrupts_do_not_mask_a_node_that_failed_to_start():
    """They come until the last moment, as from a launch that ends what it started."""
    command = [sys.executable, "-m", "omsm_ros.nodes.start", "corrector", "--ros-args"]
    with subprocess.Popen([*command, "-p", "polarity:=7"], stderr=subprocess.PIPE) as node:
        assert b"polarity" in node.stderr.readline()
        while node.poll() is None:
            node.send_signal(signal.SIGINT)
            time.sleep(0.001)
    assert node.returncode == 2
