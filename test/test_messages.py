"""Sentences exist for every code that the core states, and use the values that come with it."""

from __future__ import annotations

import ast
import string
from collections.abc import Iterator
from pathlib import Path

import pytest

import omsm_ros
from omsm_ros.core.calibration.certificate import REJECTS, Finding
from omsm_ros.errors import DataError, Notice
from omsm_ros.messages import COMMAND, NODE, PYTHON, templates, written_for

CORE = Path(omsm_ros.__file__).parent / "core"
ROOMS = {path.name for path in CORE.iterdir() if path.is_dir()}


@pytest.fixture(scope="module")
def stated() -> list[tuple[str, set[str] | None]]:
    """Return each code in the core with the names of its values; None if they are not literal."""
    return list(_stated())


def _stated() -> Iterator[tuple[str, set[str] | None]]:
    for path in sorted(CORE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Call) or not node.args:
                continue
            code = node.args[0]
            if isinstance(code, ast.Constant) and isinstance(code.value, str):
                room, _, subject = code.value.partition(".")
                if room in ROOMS and subject.isidentifier() and _states(node.func):
                    names = {each.arg for each in node.keywords}
                    # A finding has its values in a mapping, which a check makes.
                    unknown = None in names or _called(node.func) == "Finding"
                    yield code.value, None if unknown else {str(name) for name in names}


def _called(function: ast.expr) -> str:
    return str(getattr(function, "id", getattr(function, "attr", "")))


def _states(function: ast.expr) -> bool:
    name = _called(function)
    return name.endswith("Error") or name in ("Notice", "Finding", "text_of")


def fields(template: str) -> set[str]:
    """Return the names of the values that a template needs."""
    found = {name for _, name, _, _ in string.Formatter().parse(template) if name}
    return {name.partition(".")[0].partition("[")[0] for name in found} - {"opt"}


def test_every_code_has_a_sentence(stated: list[tuple[str, set[str] | None]]) -> None:
    codes = {code for code, _ in stated}
    assert len(codes) > 80
    assert codes <= set(templates())


def test_a_sentence_uses_values_that_are_given(stated: list[tuple[str, set[str] | None]]) -> None:
    known = [(code, values) for code, values in stated if values is not None]
    assert len(known) > 80
    for code, values in known:
        assert fields(templates()[code]) <= values, code


def literals() -> set[str]:
    """Return every literal text in the core."""
    return {
        node.value
        for path in CORE.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }


def test_every_code_of_a_calibration_is_a_literal_of_the_core_and_the_reverse() -> None:
    rooms = ("calibration.", "identification.")
    used = {text for text in literals() if text.startswith(rooms) and text.isascii()}
    known = {code for code in templates() if code.startswith(rooms)}
    assert len(known) > 80
    assert used == known


@pytest.mark.parametrize("code", [c for c in templates() if c.startswith("identification.")])
def test_a_sentence_of_a_finding_is_written_from_its_values(code: str) -> None:
    values = {name: [0.5] if name == "causes" else 0.5 for name in fields(templates()[code])}
    sentence = str(Finding(code, REJECTS, values))
    assert sentence != code
    assert "{" not in sentence


def test_an_option_is_named_for_its_audience() -> None:
    error = DataError("streams.no_axis_run", least=6)
    assert "6 finite axis samples" in str(error)
    offset = Notice("correction.no_whole_offset", samples=1.5, uncertainty=0.1)
    for audience, name in (
        (COMMAND, "--counter-offset"),
        (NODE, "parameter 'counter_offset'"),
        (PYTHON, "'counter_offset'"),
    ):
        with written_for(audience):
            assert str(offset).endswith(f"or state {name}")
