"""The shipped YAML files name exactly the parameters that the nodes declare."""

import ast
import re
from dataclasses import fields
from pathlib import Path

import pytest
import yaml

import omsm_ros
from omsm_ros.core.correction.uncertainty import ErrorSources
from omsm_ros.core.machine.kinematics import Geometry
from omsm_ros.devices import factory
from omsm_ros.storage.surface_file import load_surface

ROOT = Path(omsm_ros.__file__).resolve().parent.parent
NO_PARAMETERS = {"paper_mirror", "disturbances", "limits"}
NODES = sorted({path.stem for path in (ROOT / "config").glob("*.yaml")} - NO_PARAMETERS)


TABLES = {
    "confocal_driver": factory.PARAMETERS,
    "axis_driver": factory.AXIS_PARAMETERS,
    "reference_driver": factory.REFERENCE_PARAMETERS,
}


def _declared(node):
    yield from (entry.name for entry in TABLES.get(node, ()))
    tree = ast.parse((ROOT / "omsm_ros" / "nodes" / f"{node}_node.py").read_text())
    for call in ast.walk(tree):
        if isinstance(call, ast.Call) and getattr(call.func, "id", "") == "parameter":
            name = call.args[1]
            if isinstance(name, ast.Constant):
                yield name.value
            elif isinstance(name.values[0], ast.Constant):  # f"geometry.{name}"
                group = {"geometry.": Geometry, "sources.": ErrorSources}[name.values[0].value]
                yield from (f"{name.values[0].value}{field.name}" for field in fields(group))
            else:  # f"{axis}.counts_per_unit"
                yield from (f"{axis}{name.values[1].value}" for axis in "xyzbc")


def _flat(values, prefix=""):
    for key, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}"


@pytest.mark.parametrize("node", NODES)
def test_every_parameter_stands_in_the_yaml(node):
    ((key, content),) = yaml.safe_load((ROOT / "config" / f"{node}.yaml").read_text()).items()
    assert key == f"/omsm/{node}"
    assert sorted(_flat(content["ros__parameters"])) == sorted(_declared(node))


def test_every_node_with_parameters_has_its_yaml():
    nodes = {p.stem.removesuffix("_node") for p in (ROOT / "omsm_ros/nodes").glob("*_node.py")}
    assert {node for node in nodes if list(_declared(node))} == set(NODES)


def test_shipped_surface_is_the_papers():
    from omsm_ros.core.surface.nominal import PAPER_MIRROR

    assert load_surface(ROOT / "config" / "paper_mirror.yaml") == PAPER_MIRROR


def test_every_node_can_be_started_by_its_name():
    listed = (ROOT / "setup.py").read_text().split("NODES =")[1].split("\n)\n")[0]
    named = set(re.findall(r'"(\w+)"', listed))
    nodes = {p.stem.removesuffix("_node") for p in (ROOT / "omsm_ros/nodes").glob("*_node.py")}
    assert named == nodes
