"""Parameters of a node: checked, named, with the nearest of what is unknown; what they make."""

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

from dataclasses import fields
from types import SimpleNamespace

from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters, SetParametersAtomically

from omsm_ros import quantities
from omsm_ros.core.kinematics.kinematics import Geometry
from omsm_ros.errors import ConfigurationError
from omsm_ros.nodes.correction_parameters import PARAMETERS as OF_CORRECTOR
from omsm_ros.nodes.correction_parameters import accuracy_of, options_of, trigger_of
from omsm_ros.nodes.managed import DeclaredParameters
from omsm_ros.quantities import Parameter

from .fake_node import FakeNode

PARAMETERS = (
    Parameter("window", 1.0, "length", quantities.WAIT),
    Parameter("block_size", 100, "samples", quantities.BLOCK_SAMPLES),
    Parameter("mount", "probe", "where", choices=("probe", "carriage")),
    Parameter("accuracy", -1.0, "asked for", quantities.BUDGET, unset=-1.0),
    Parameter("port", "", "where it is", required=True),
    Parameter("speed", 30.0, "either way", quantities.SPEED),
)
PORT = {"port": "tcp://probe:7891"}


def declared(given=None, refusal=""):
    node = FakeNode("driver", {**PORT, **(given or {})})
    return node, DeclaredParameters(node, PARAMETERS, lambda: refusal)


def test_what_is_not_given_has_its_default_and_a_whole_number_is_a_number():
    _, made = declared({"window": 2})
    values = made.values()
    assert values == {
        "window": 2.0, "block_size": 100, "mount": "probe", "accuracy": -1.0, "speed": 30.0, **PORT,
    }  # fmt: skip
    assert type(values["window"]) is float


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({"window": 99.0}, "window"),
        ({"window": "long"}, "window"),
        ({"block_size": 1.5}, "block_size"),
        ({"mount": "floor"}, "'floor'"),
        ({"port": ""}, "must be given"),
        ({"blok_size": 5}, "did you mean 'block_size'"),
        ({"zzz": 5}, "ros2 param list"),
        ({"z" * 100_000: 5}, "^.{1,200}$"),
    ],
)
def test_configuration_errors_are_reported_with_the_node(given, named):
    _, made = declared(given)
    with pytest.raises(ConfigurationError, match=named) as refused:
        made.values()
    assert str(refused.value).startswith("driver: ")


def test_what_was_wrong_may_be_set_right():
    node, made = declared({"window": 99.0})
    node.parameters["window"].value = 2.0
    (on_set,) = node.callbacks
    assert on_set([SimpleNamespace(name="window", value=2.0)]).successful
    assert made.values()["window"] == 2.0


@pytest.mark.parametrize(("name", "value"), [("window", 1e9), ("mount", "floor"), ("port", 3)])
def test_a_wrong_value_is_refused_by_its_name(name, value):
    node, _ = declared()
    answer = node.callbacks[0]([SimpleNamespace(name=name, value=value)])
    assert not answer.successful
    assert repr(name) in answer.reason


def test_none_may_be_set_where_it_would_take_no_effect():
    node, _ = declared(refusal="takes effect later")
    answer = node.callbacks[0]([SimpleNamespace(name="window", value=2.0)])
    assert not answer.successful
    assert answer.reason == "'window' takes effect later"
    # Parameters of rclpy, such as use_sim_time, are not refused.
    assert node.callbacks[0]([SimpleNamespace(name="use_sim_time", value=True)]).successful


def test_overrides_of_a_topic_that_there_is_not_are_refused_once_topics_are_made():
    given = {"qos_overrides./omsm/axes.subscription.depth": 5}
    node, made = declared(given)
    made.values()
    with pytest.raises(ConfigurationError, match=r"qos_overrides\./omsm/axes"):
        made.check_overrides()
    node.parameters |= dict.fromkeys(given)
    made.check_overrides()


def test_parameter_ranges_are_described_and_include_the_value_for_not_stated():
    node, _ = declared()
    described = {name: each.descriptor for name, each in node.parameters.items()}
    (whole,) = described["block_size"].integer_range
    assert (whole.from_value, whole.to_value) == (1, 4_000_000)
    (span,) = described["accuracy"].floating_point_range
    assert span.from_value == -1.0
    assert span.to_value == quantities.BUDGET.high
    # Either sign may stand before it: one span from low to high would be wrong.
    assert not described["speed"].floating_point_range
    assert not described["mount"].integer_range
    assert "one of 'probe', 'carriage'" in described["mount"].description


@pytest.mark.parametrize("kind", [SetParameters, SetParametersAtomically])
def test_a_value_of_no_type_is_answered(kind):
    node = FakeNode("driver", PORT)
    node.create_service(kind, "set", lambda request, response: "rclpy's own")
    DeclaredParameters(node, PARAMETERS, str)
    (service,) = node.services
    wrong = ParameterMessage(name="window", value=ParameterValue(type=77))
    right = ParameterMessage(
        name="window", value=ParameterValue(type=ParameterType.PARAMETER_DOUBLE)
    )
    request = kind.Request(parameters=[right, wrong])
    answer = service.callback(request, kind.Response())
    results = [answer.result] if kind is SetParametersAtomically else answer.results
    assert len(results) == (1 if kind is SetParametersAtomically else 2)
    for result in results:
        assert not result.successful
        assert "'window' has type 77" in result.reason
    assert service.callback(kind.Request(parameters=[right]), kind.Response()) == "rclpy's own"


DEFAULTS = {parameter.name: parameter.default for parameter in OF_CORRECTOR}


def test_the_corrector_corrects_as_its_parameters_say():
    usual = options_of(DEFAULTS)
    assert usual.polarity == 1
    assert usual.probe_latency is None  # as calibrated
    assert usual.geometry == Geometry()
    assert accuracy_of(DEFAULTS) is None
    places = {f"geometry.{f.name}": i * 1e-3 for i, f in enumerate(fields(Geometry))}
    reported = DEFAULTS | places | {
        "polarity": -1, "override": True, "probe_latency": 0.0, "counter_offset": -7,
        "stamp_tolerance": 5e-3, "accuracy": 1e-8,
    }  # fmt: skip
    options = options_of(reported)
    assert options.polarity == -1
    assert options.accept_other_rate
    assert options.probe_latency == 0.0  # known to be none, which is not: not stated
    assert [getattr(options.geometry, f.name) for f in fields(Geometry)] == [*places.values()]
    assert (options.trigger.counter_offset, options.trigger.stamp_tolerance) == (-7, 5e-3)
    assert trigger_of(reported) == options.trigger
    assert accuracy_of(reported) == 1e-8
