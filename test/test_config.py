"""The shipped YAML files name exactly the parameters that the nodes declare."""

import importlib
import json
import re
from pathlib import Path

import pytest
import yaml

import omsm_ros
from omsm_ros.core.correction.surface_points import CLOUD_FIELDS
from omsm_ros.instruments import parameters as factory
from omsm_ros.io.descriptions import load_surface
from omsm_ros.io.topics import POINTS_TOPIC, TOPIC_TYPES
from omsm_ros.nodes import start

ROOT = Path(omsm_ros.__file__).resolve().parent.parent
NO_PARAMETERS = {"diagnostic_aggregator", "paper_mirror", "disturbances", "limits", "sources"}
NODES = sorted({path.stem for path in (ROOT / "config").glob("*.yaml")} - NO_PARAMETERS)


TABLES = {
    "confocal_driver": factory.PARAMETERS,
    "axis_driver": factory.AXIS_PARAMETERS,
    "reference_driver": factory.REFERENCE_PARAMETERS,
    "accelerometer_driver": factory.ACCELEROMETER_PARAMETERS,
}
FRAMES = {
    "confocal_driver": ["machine_frame", "probe_frame"],
    "axis_driver": ["machine_frame"],
    "reference_driver": ["probe_frame"],
    "accelerometer_driver": ["accelerometer_frame"],
}


def _parameters(node):
    pytest.importorskip("rclpy", reason="ROS 2 is not installed")
    module = importlib.import_module(f"omsm_ros.nodes.{start.NODES[node].split(':')[0]}")
    return TABLES.get(node) or getattr(module, "PARAMETERS", ())


def _declared(node):
    """Names of what a managed node can be set to."""
    names = [parameter.name for parameter in _parameters(node)]
    frames = FRAMES.get(node, [])
    return [*names, "autostart", *frames, *["frame_prefix"] * bool(frames)] if names else []


def _flat_items(values, prefix=""):
    for key, value in values.items():
        if isinstance(value, dict):
            yield from _flat_items(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _flat(values):
    return [name for name, _ in _flat_items(values)]


@pytest.mark.parametrize("node", NODES)
def test_every_parameter_stands_in_the_yaml(node):
    ((key, content),) = yaml.safe_load((ROOT / "config" / f"{node}.yaml").read_text()).items()
    assert key == "/**"  # in whatever namespace, under whatever name
    assert sorted(_flat(content["ros__parameters"])) == sorted(_declared(node))


@pytest.mark.parametrize("node", NODES)
def test_every_value_of_the_yaml_will_do(node):
    """Ranges and types: what is shipped must not be refused; what must be given is given."""
    content = yaml.safe_load((ROOT / "config" / f"{node}.yaml").read_text())["/**"]
    values = dict(_flat_items(content["ros__parameters"]))
    assert set(values) >= {parameter.name for parameter in _parameters(node)} > set()
    for parameter in _parameters(node):
        parameter.checked(values[parameter.name])


def test_a_default_is_still_a_text_when_it_is_read_again():
    """`ros2 param load` reads what `ros2 param dump` wrote, and then each text once more."""
    texts = [p for n in NODES for p in _parameters(n) if isinstance(p.default, str)]
    assert any(p.default for p in texts)
    assert [p.name for p in texts if not isinstance(yaml.safe_load(p.default) or "", str)] == []


def test_every_node_with_parameters_has_its_yaml():
    nodes = set(start.NODES) - {"replay"}
    assert {node for node in nodes if list(_declared(node))} == set(NODES)


def test_shipped_surface_is_the_papers():
    from omsm_ros.core.surface.nominal import PAPER_MIRROR

    assert load_surface(ROOT / "config" / "paper_mirror.yaml") == PAPER_MIRROR


def test_every_node_can_be_started_by_its_name():
    listed = (ROOT / "setup.py").read_text().split("NODES =")[1].split("\n)\n")[0]
    named = set(re.findall(r'"(\w+)"', listed))
    nodes = set(start.NODES) - {"replay", "cell"}
    assert named == nodes


def test_the_layouts_for_viewers_name_what_is_published():
    rviz = yaml.safe_load((ROOT / "config" / "cell.rviz").read_text())["Visualization Manager"]
    assert rviz["Global Options"]["Fixed Frame"] == "workpiece"
    (cloud,) = (shown for shown in rviz["Displays"] if shown["Class"].endswith("/PointCloud2"))
    assert cloud["Topic"]["Value"] == POINTS_TOPIC
    fields = {name for name, _ in CLOUD_FIELDS}
    assert cloud["Channel Name"] in fields
    panels = json.loads((ROOT / "config" / "cell.foxglove.json").read_text())["configById"]
    assert panels["3D!surface"]["followTf"] == "workpiece"
    assert {p["colorField"] for p in panels["3D!surface"]["topics"].values()} <= fields
    assert set(panels["3D!surface"]["topics"]) == {POINTS_TOPIC}
    for path in panels["Plot!axes"]["paths"]:
        topic, field = re.fullmatch(r"(/\w+/\w+)\.(\w+)\[0\]", path["value"]).groups()
        kind = TOPIC_TYPES[topic].rpartition("/")[2]
        assert f"float64[] {field}" in (ROOT / "msg_defs" / "msg" / f"{kind}.msg").read_text()
    assert panels["DiagnosticSummary!nodes"]["topicToRender"] == "/diagnostics"
