"""Every node is managed: its stages, its parameters, its end, as ``ros2`` sees them."""

import signal
import subprocess
import sys
import time

import pytest
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from omsm_msgs.srv import LoadCalibration
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import DescribeParameters, SetParameters, SetParametersAtomically
from rclpy.qos import ReliabilityPolicy

from omsm_ros.io.calibration_file import save_calibration

UNCONFIGURED, INACTIVE, ACTIVE = "unconfigured", "inactive", "active"
# One node of each kind: with a device, with requests, with both streams.
NODES = {"confocal_driver": {}, "calibrator": {}, "corrector": {}}


def change(cell, node, transition):
    asked = Transition(id=transition)
    return cell.call(ChangeState, f"{node}/change_state", transition=asked).success


def stage(cell, node):
    return cell.call(GetState, f"{node}/get_state").current_state.label


def put(cell, node, name, value):
    kinds = {bool: "bool", int: "integer", float: "double", str: "string"}
    kind = kinds[type(value)]
    given = ParameterValue(
        type=getattr(ParameterType, f"PARAMETER_{kind.upper()}"), **{f"{kind}_value": value}
    )
    asked = [Parameter(name=name, value=given)]
    return cell.call(SetParameters, f"{node}/set_parameters", parameters=asked).results[0]


def test_a_value_of_a_type_that_there_is_not_is_refused_not_left_without_an_answer(cell):
    cell.processes.start("calibrator", output=str(cell.folder / "cal.json"), autostart=False)
    for kind in (10, 255):
        asked = [Parameter(name="output", value=ParameterValue(type=kind))]
        several = cell.call(SetParameters, "calibrator/set_parameters", parameters=asked * 2)
        together = cell.call(
            SetParametersAtomically, "calibrator/set_parameters_atomically", parameters=asked
        )
        for result in (*several.results, together.result):
            assert not result.successful
            assert result.reason == f"'output' has type {kind}, expected 0 to 9"
        assert len(several.results) == 2


def test_a_node_is_taken_through_its_stages_and_back(cell):
    cell.processes.start("calibrator", output=str(cell.folder / "cal.json"), autostart=False)
    assert stage(cell, "calibrator") == UNCONFIGURED
    assert not change(cell, "calibrator", Transition.TRANSITION_ACTIVATE)  # refused, not raised
    for transition, reached in (
        (Transition.TRANSITION_CONFIGURE, INACTIVE),
        (Transition.TRANSITION_ACTIVATE, ACTIVE),
        (Transition.TRANSITION_DEACTIVATE, INACTIVE),
        (Transition.TRANSITION_ACTIVATE, ACTIVE),
        (Transition.TRANSITION_DEACTIVATE, INACTIVE),
        (Transition.TRANSITION_CLEANUP, UNCONFIGURED),
        (Transition.TRANSITION_CONFIGURE, INACTIVE),
        (Transition.TRANSITION_ACTIVATE, ACTIVE),
    ):
        assert change(cell, "calibrator", transition)
        assert stage(cell, "calibrator") == reached
    cell.wait("its word", lambda: cell.operator.text("calibrator", "lifecycle") == ACTIVE)
    assert cell.operator.value("calibrator", "defects") == 0


def test_a_node_that_is_shut_down_ends_well(cell):
    cell.processes.start("corrector")
    # Not ``change``, which fails when a node has ended before its answer is taken.
    asked = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_ACTIVE_SHUTDOWN))
    assert cell.operator.ask(ChangeState, "corrector/change_state", asked).success
    assert cell.processes._running["corrector"].wait(20) == 0


def test_a_parameter_acts_or_is_refused_with_the_reason(cell, true_calibration):
    """Out of range: never. In force: refused, and how it is done instead. Unconfigured: it acts."""
    path = cell.folder / "cal.json"
    save_calibration(path, true_calibration)
    cell.processes.start("corrector", calibration=str(path))
    for name, value, named in (
        ("polarity", 999, "999"),
        ("polarity", -1, "deactivate and cleanup"),
        ("geometry.centre_x", 1e6, "10"),
        ("probe_latency", float("nan"), "probe_latency"),
        ("calibration", "/etc/passwd", "deactivate and cleanup"),
        ("autostart", False, "read"),
        ("calibraton", "x.json", "did you mean 'calibration'"),
    ):
        answer = put(cell, "corrector", name, value)
        assert not answer.successful
        assert named in answer.reason
    for transition in (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP):
        assert change(cell, "corrector", transition)
    assert not put(cell, "corrector", "polarity", 999).successful
    assert put(cell, "corrector", "calibration_folders", "/nowhere").successful
    for transition in (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE):
        assert change(cell, "corrector", transition)
    answer = cell.call(LoadCalibration, "corrector/load_calibration", path=str(path))
    assert not answer.success
    assert "outside the folders" in answer.message


def test_parameters_tell_their_meaning_and_range(cell):
    cell.start_driver(port="/dev/null")
    asked = ["block_size", "sample_period", "z.counts_per_unit", "device"]
    found = cell.call(DescribeParameters, "confocal_driver/describe_parameters", names=asked)
    block_size, period, scale, device = found.descriptors
    assert (block_size.integer_range[0].from_value, block_size.integer_range[0].to_value) == (
        1,
        4_000_000,
    )
    assert period.floating_point_range[0].to_value == 10.0
    assert "[s]" in period.description
    assert "counts per m" in scale.description
    assert "chrocodile" in device.description


def test_a_domain_without_ports_is_named(monkeypatch, refused):
    monkeypatch.setenv("ROS_DOMAIN_ID", "500")
    assert "ROS_DOMAIN_ID is 500, expected a whole number from 0 to 232" in refused("corrector")


@pytest.mark.parametrize(
    ("node", "arguments", "named"),
    [
        ("corrector", ["-p", "polarty:=-1"], "did you mean 'polarity'"),
        pytest.param(
            "corrector",
            ["-p", "qos_overrides./x.publisher.depth:=5"],
            "qos_overrides./x",
            marks=pytest.mark.soak,
        ),
        (
            "corrector",
            ["-p", "qos_overrides./omsm/points.publisher.reliability:=sometimes"],
            "'points': Unexpected QoS override for policy `reliability`: `sometimes`",
        ),
        pytest.param(
            "corrector",
            ["-p", "qos_overrides./omsm/axes.subscription.depth:=99999999999"],
            "depth of a queue is 99999999999",
            marks=pytest.mark.soak,
        ),
        (
            "corrector",
            ["-r", f"__node:={'a' * 300}"],
            "should not exceed '255'; give another __node",
        ),
        ("corrector", ["--params-file", "/no/such/file.yaml"], "/no/such/file.yaml"),
        ("corrector", ["--params-file", "/etc/passwd"], "'/etc/passwd' is no file of parameters"),
        ("confocal_driver", ["-p", "block_size:=-7", "-p", "port:=/dev/null"], "block_size"),
        ("confocal_driver", ["-p", "port:=/dev/null"], "'x.counts_per_unit' is not stated"),
    ],
)
def test_what_cannot_be_meant_is_one_line_and_exit_2(refused, node, arguments, named):
    assert named in refused(node, *arguments)


def test_an_override_is_of_its_topic_alone(cell):
    """Others that are made with the same quality of service keep it."""
    cell.processes.start(
        "corrector",
        **{
            "qos_overrides./omsm/points.publisher.reliability": "best_effort",
            "qos_overrides./omsm/points.publisher.depth": 7,
        },
    )
    cell.wait("it", lambda: cell.operator.text("corrector", "lifecycle") == "active")
    (points,) = cell.operator.get_publishers_info_by_topic("/omsm/points")
    assert points.qos_profile.reliability is ReliabilityPolicy.BEST_EFFORT
    for topic in ("axes", "confocal"):
        (heard,) = cell.operator.get_subscriptions_info_by_topic(f"/omsm/{topic}")
        assert heard.qos_profile.reliability is ReliabilityPolicy.RELIABLE


@pytest.mark.parametrize(
    ("node", "after"),
    [
        ("cell_emulator", 0.5),  # while it loads
        ("cell_emulator", 4.0),
        pytest.param("confocal_driver", 4.0, marks=pytest.mark.soak),
        *(pytest.param("corrector", k / 4, marks=pytest.mark.soak) for k in range(1, 16)),
    ],
)
def test_two_interrupts_end_a_node_well(node, after, tmp_path):
    """As ``ros2 launch`` sends them: exit code 0 and no traceback, wherever they fall."""
    given = {
        "cell_emulator": ["-p", f"link:={tmp_path / 'port'}"],
        "confocal_driver": ["-p", "port:=/dev/null"]
        + [w for a in "xyzbc" for w in ("-p", f"{a}.counts_per_unit:=1.0e10")],
        "corrector": ["-p", "probe_latency:=0.0"],
    }[node]
    process = subprocess.Popen(
        [sys.executable, "-m", "omsm_ros.nodes.start", node, "--ros-args", *given],
        stderr=subprocess.PIPE,
        text=True,
    )
    time.sleep(after)
    for _ in range(2):
        process.send_signal(signal.SIGINT)
        time.sleep(0.02)
    _, said = process.communicate(timeout=200)
    assert process.returncode == 0, said
    assert "Traceback" not in said
