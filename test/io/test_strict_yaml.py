"""YAML of plain values: what JSON can say, and a name a line."""

import math

import pytest

from omsm_ros.errors import FileError
from omsm_ros.io import json_and_yaml


def read(text):
    return json_and_yaml.mapping_of(text, FileError, "the surface")


@pytest.mark.parametrize(
    ("written", "value"),
    [
        ("1", 1), ("-7", -7), ("+3", 3), ("007", 7), ("1.5", 1.5), (".5", 0.5), ("2.", 2.0),
        ("1e-3", 1e-3), ("25.4e-3", 25.4e-3), ("-1E+2", -100.0), ("true", True), ("False", False),
        ("null", None), ("~", None), ("", None), ("no", "no"), ("on", "on"), ("0x10", "0x10"),
        ("1_000", "1_000"), ("1:30", "1:30"), ("2026-01-01", "2026-01-01"), (".inf", ".inf"),
        (".nan", ".nan"), ("'1'", "1"), ('"a: b"', "a: b"), ("[1, [2.5, x]]", [1, [2.5, "x"]]),
        ("{b: {c: null}}", {"b": {"c": None}}), ("µm", "µm"),
    ],
)  # fmt: skip
def test_a_value_is_what_it_looks_like(written, value):
    found = read(f"a: {written}")["a"]
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a: &x 1\nb: *x", "line 1: aliases and anchors"),
        ("a: !!python/object/apply:os.system [ls]", "line 1: the tag"),
        ("a: !!timestamp 2026-01-01", "line 1: the tag"),
        ("b: 1\na: 2\nb: 3", "line 3: the name 'b' is repeated"),
        ("1: 2", "is no text"),
        ("[1, 2]: 3", "is no text"),
        ("a: 1e400", "beyond the range of a float"),
        ("a: " + "9" * 400, "more than 64 bits"),
        ("- 1\n- 2", "expected 'name: value' lines"),
        ("a: [1", "line 1"),
        ("a: 1\n---\nb: 2", "is not plain YAML"),
        ("a: \x07", "is not plain YAML"),
    ],
)
def test_anything_else_is_refused_by_its_line(text, said):
    with pytest.raises(FileError, match=r"^the surface ") as refused:
        read(text)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(("left", "right"), [("[", "]"), ("{b: ", "}")])
def test_eight_levels_and_no_more(left, right):
    # The names and values around it are the first, its own value the last.
    assert read(f"a: {left * 6}1{right * 6}")
    for deeper in (7, 100_000):
        with pytest.raises(FileError, match="nested deeper than 8 levels"):
            read(f"a: {left * deeper}1{right * deeper}")


def test_a_number_is_finite():
    values = read("a: 1.7e308\nb: -1.7e308\nc: 5e-324").values()
    assert len(values) == 3
    assert all(math.isfinite(value) for value in values)


@pytest.mark.parametrize(
    ("text", "begins"),
    [
        (b"/**:\n  ros__parameters:\n    a: 1\n", True), (b"{a: 1}", True),
        (b"# of the cell\n---\na: &here 1\n", True), (b"a: 1\n b\n- c: [", True),
        (b"", False), (b"# only\n", False), (b"- a: 1\n", False), (b"3", False),
        (b"\x00\xff", False),
        (b"root:x:0:0:root:/root:/bin/sh\ndaemon:x:1:1::/:/bin/sh\n", False), (b"\t[", False),
    ],
)  # fmt: skip
def test_a_text_is_known_by_its_beginning(text, begins):
    assert json_and_yaml.begins_as_mapping(text) is begins
