"""Every device from its parameters, nothing touched before it is opened."""

from __future__ import annotations

from typing import Any

import pytest

from omsm_ros.devices.factory import DEVICES, PARAMETERS, defaults, make_device
from omsm_ros.emulators.players import EMULATED
from omsm_ros.errors import ConfigurationError


@pytest.mark.parametrize("name", DEVICES)
def test_every_device_is_made_from_the_defaults(name: str) -> None:
    device = make_device(defaults() | {"device": name, "port": "tcp://device.invalid:1"})
    assert device.statistics.decoded == 0
    assert device.identity == {}


def test_every_emulated_device_has_its_driver() -> None:
    assert set(EMULATED) == set(DEVICES)
    names = {parameter.name for parameter in PARAMETERS}
    for emulated in EMULATED.values():
        assert set(emulated.driver) <= names


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"device": "ruler"}, "device 'ruler', expected one of"),
        ({"device": "chrocodile", "signals": "83 x"}, "signals '83 x'"),
        ({"device": "chrocodile", "encoders": "XYZ"}, "encoders 'XYZ'"),
        ({"device": "chrocodile", "trigger": "never"}, "trigger 'never'"),
        ({"port": "tcp://host"}, "tcp://host:port"),
        ({"x.sign": 0}, "sign 0"),
    ],
)
def test_senseless_parameters_are_named(wrong: dict[str, Any], named: str) -> None:
    with pytest.raises(ConfigurationError, match=named):
        make_device(defaults() | wrong)


def test_parameters_reach_the_device() -> None:
    values = {"device": "chrocodile", "encoders": "XYZVU", "lamp": 30.0, "probe.zero": 5e-5}
    settings = make_device(defaults() | values)._wanted  # type: ignore[attr-defined]
    assert settings.encoders == (0, 1, 2, 4, 3)
    assert (settings.lamp, settings.averaging) == (30.0, None)
    assert settings.probe.zero == 5e-5
