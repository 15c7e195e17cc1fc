"""JSON of RFC 8259 is read exactly, and nothing else is accepted."""

import json
import math

import pytest

from omsm_ros.errors import FileError
from omsm_ros.io import json_and_yaml


def read(text):
    return json_and_yaml.value_of(text, FileError, "the note")


@pytest.mark.parametrize(
    "content",
    [
        {"a": [1, -2.5, 1e-300, "µm", None, True], "b": {}},
        [],
        "text",
        0,
        -(2**63),
        2**64 - 1,
        {"": ""},
    ],
)
def test_what_is_json_comes_back_as_it_was(content):
    assert read(json.dumps(content)) == content


@pytest.mark.parametrize(
    "write", [lambda k: "[" * k + "1" + "]" * k, lambda k: '{"a":' * k + "1" + "}" * k]
)
def test_thirty_two_levels_and_no_more(write):
    assert read(write(32))
    with pytest.raises(FileError, match="deeper than 32 levels"):
        read(write(33))
    with pytest.raises(FileError, match="deeper than 32 levels"):
        read(write(100_000))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("NaN", "NaN is not a JSON number"),
        ('{"a": Infinity}', "Infinity is not a JSON number"),
        ("[1e400]", "beyond the range of a float"),
        ("-1e999", "beyond the range of a float"),
        (str(2**64), "more than 64 bits"),
        (str(-(2**63) - 1), "more than 64 bits"),
        ("9" * 5000, "more than 64 bits"),
        ('{"a": 1, "b": 2, "a": 3}', "'a' is repeated"),
        ('"\\ud800"', "is not JSON"),
        ("{'a': 1}", "is not JSON"),
        ("[1,]", "is not JSON"),
        ("", "is not JSON"),
    ],
)
def test_what_is_none_is_refused_in_one_line(text, said):
    with pytest.raises(FileError, match=r"^the note ") as refused:
        read(text)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)
    assert len(str(refused.value)) < 400


def test_an_object_is_expected():
    assert json_and_yaml.object_of('{"a": 1}', FileError, "the note") == {"a": 1}
    with pytest.raises(FileError, match="expected a JSON object"):
        json_and_yaml.object_of("[1]", FileError, "the note")


def test_an_unknown_number_is_null_and_never_nan():
    content = {"a": math.nan, "b": [math.inf, 1.0], "c": ({"d": -math.inf},), "e": "nan"}
    assert json_and_yaml.unknown_as_null(content) == {
        "a": None, "b": [None, 1.0], "c": [{"d": None}], "e": "nan",
    }  # fmt: skip
    with pytest.raises(ValueError, match="JSON"):
        json_and_yaml.text_of(math.nan)
