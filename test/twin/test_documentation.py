"""The fields in ``docs/twin.md`` are those of the twin."""

from __future__ import annotations

import re
import typing
from dataclasses import fields, is_dataclass
from pathlib import Path

import pytest

import omsm_ros
from omsm_ros.core.kinematics.kinematics import Geometry
from omsm_ros.twin.cell import Recording, Truth
from omsm_ros.twin.disturbances import Disturbances, TrueResponse

TEXT = (Path(omsm_ros.__file__).resolve().parent.parent / "docs" / "twin.md").read_text()
QUOTED = set(re.findall(r"`([^`\n]+)`", TEXT))


def _records(kind):
    """A record's type and those of the records in it."""
    if kind is Geometry:  # documented where GEOMETRY.yaml is
        return
    yield kind
    for hint in typing.get_type_hints(kind).values():
        for part in (hint, *typing.get_args(hint)):
            if is_dataclass(part):
                yield from _records(part)


NAMES = sorted({f.name for record in _records(Disturbances) for f in fields(record)})


def test_every_name_of_a_disturbance_is_documented():
    assert not set(NAMES) - QUOTED


def test_the_truths_are_those_that_are_documented():
    documented = {q for q in QUOTED if re.fullmatch(r"truth\.\w+", q)}
    assert documented == {f"truth.{f.name}" for f in fields(Truth)}


@pytest.mark.parametrize("name", ["static_gain", "latency_s"])
def test_the_true_response_has_what_is_documented(name):
    assert name in QUOTED
    assert hasattr(TrueResponse, name)


def test_the_example_runs():
    code = re.search(r"```python\n(.*?)```", TEXT, re.DOTALL)
    assert code is not None
    # A thousandth of the scan will do.
    example = code[1].replace("spindle_speed=60.0", "spindle_speed=60.0, start_radius=2e-4")
    namespace = {}
    exec(compile(example, "docs/twin.md", "exec"), namespace)
    assert isinstance(namespace["scan"], Recording)
    assert len(namespace["record"]) == 29_000
