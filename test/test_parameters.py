"""A parameter refuses what it cannot be, in words that name it."""

from __future__ import annotations

import pytest

from omsm_ros.errors import ConfigurationError
from omsm_ros.quantities import LAG, PERCENT, Parameter

LAMP = Parameter("lamp", -1.0, "brightness [%]; -1 = as it is", PERCENT, unset=-1.0)


@pytest.mark.parametrize(
    ("parameter", "value", "expected"),
    [
        (LAMP, 50, 50.0),
        (LAMP, 0.0, 0.0),
        (LAMP, -1.0, -1.0),
        (Parameter("on", True, ""), False, False),
        (Parameter("sign", 1, "", choices=(1, -1)), -1, -1),
        (Parameter("port", "", "", required=True), "/dev/x", "/dev/x"),
    ],
)
def test_what_will_do_comes_back_in_its_type(
    parameter: Parameter, value: object, expected: object
) -> None:
    found = parameter.checked(value)
    assert found == expected
    assert type(found) is type(expected)


@pytest.mark.parametrize(
    ("parameter", "value", "named"),
    [
        (LAMP, -2.0, "-2.0"),
        (LAMP, 100.1, "100.1"),
        (LAMP, float("nan"), "nan"),
        (LAMP, "bright", "expected a number"),
        (LAMP, True, "expected a number"),
        (LAMP, None, "None"),
        (Parameter("count", 1, "samples"), 1.5, "expected a whole number"),
        (Parameter("on", True, ""), 1, "true or false"),
        (Parameter("sign", 1, "", choices=(1, -1)), 0, "(1, -1)"),
        (Parameter("port", "", "", required=True), "", "must be given"),
        (Parameter("lag", 0.0, "", LAG), 10**400, "lag"),
    ],
)
def test_what_will_not_do_is_named(parameter: Parameter, value: object, named: str) -> None:
    with pytest.raises(ConfigurationError) as refused:
        parameter.checked(value)
    assert named in str(refused.value)
    assert repr(parameter.name) in str(refused.value)


def test_the_text_tells_meaning_range_and_choices() -> None:
    assert LAMP.text == "brightness [%]; -1 = as it is; from 0 to 100 %"
    assert "one of 1, -1" in Parameter("sign", 1, "turns", choices=(1, -1)).text
    assert "must be given" in Parameter("port", "", "", required=True).text
