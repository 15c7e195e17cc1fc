"""Every device from its parameters, nothing touched before it is opened."""

from __future__ import annotations

from typing import Any

import pytest

from omsm_ros.errors import ConfigurationError
from omsm_ros.instruments.emulator_factory import EMULATED, emulated
from omsm_ros.instruments.factory import (
    AXIS_PARAMETERS,
    DEVICES,
    PARAMETERS,
    REFERENCE_PARAMETERS,
    command_transport,
    defaults,
    make_axes,
    make_device,
    make_reference,
)

# What a device measures with must be stated; the emulated one's scales will do.
STATED = emulated("six_channel").driver


@pytest.mark.parametrize("name", DEVICES)
def test_every_device_is_made_from_the_defaults(name: str) -> None:
    device = make_device(defaults() | STATED | {"device": name, "port": "tcp://device.invalid:1"})
    assert device.statistics.decoded == 0
    assert device.identity == {}


def test_every_emulated_device_has_its_driver() -> None:
    # The reference is beside a probe of the table.
    assert set(EMULATED) == {*DEVICES, "capancdt"}
    names = {parameter.name for parameter in PARAMETERS}
    # A probe without encoders is no whole cell.
    companion = EMULATED["confocaldt"].companion
    assert companion is not None
    assert companion.node == "axis_driver"
    for each in EMULATED.values():
        assert set(each.driver) <= names


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"device": "ruler"}, "device 'ruler', expected one of"),
        ({"device": "chrocodile", "signals": "83 x"}, "signals '83 x'"),
        ({"device": "chrocodile", "encoders": "XYZ"}, "encoders 'XYZ'"),
        ({"device": "chrocodile", "trigger": "never"}, "trigger 'never'"),
        ({"port": "tcp://host"}, "tcp://host:port"),
        ({"z.counts_per_unit": 0.0}, "'z.counts_per_unit' is not stated"),
        (
            {"device": "six_channel_text", "b.counts_per_unit": 0.0},
            "'b.counts_per_unit' is not stated",
        ),
        ({"x.sign": 0}, "sign 0"),
    ],
)
def test_senseless_parameters_are_named(wrong: dict[str, Any], named: str) -> None:
    with pytest.raises(ConfigurationError, match=named):
        make_device(defaults() | STATED | wrong)


def test_parameters_reach_the_device() -> None:
    values = {"device": "chrocodile", "encoders": "XYZVU", "lamp": 30.0, "probe.zero": 5e-5}
    settings = make_device(defaults() | STATED | values)._wanted  # type: ignore[attr-defined]
    assert settings.encoders == (0, 1, 2, 4, 3)
    assert (settings.lamp, settings.averaging) == (30.0, None)
    assert settings.probe.zero == 5e-5


def test_a_reference_is_made_from_its_defaults() -> None:
    values = defaults(REFERENCE_PARAMETERS) | {"port": "tcp://169.254.168.150:10001"}
    assert make_reference(values).statistics.decoded == 0
    assert make_reference(values | {"command_port": 23}).identity == {}
    with pytest.raises(ConfigurationError, match="device 'ruler'"):
        make_reference(values | {"device": "ruler"})


def test_commands_go_to_the_same_host() -> None:
    transport = command_transport("tcp://10.0.0.7:1024", 23)
    assert transport is not None
    assert transport.name == "tcp://10.0.0.7:23"
    assert command_transport("tcp://10.0.0.7:1024", 0) is None
    with pytest.raises(ConfigurationError, match="needs a port tcp://"):
        command_transport("/dev/ttyUSB0", 23)


def test_axes_alone_are_made_from_their_defaults() -> None:
    values = defaults(AXIS_PARAMETERS) | STATED | {"columns": "sequence x y z b c"}
    device = make_axes(values | {"device": "six_channel_text"})
    assert not device.channels.distance
    with pytest.raises(ConfigurationError, match="device 'chrocodile'"):
        make_axes(values | {"device": "chrocodile"})
    with pytest.raises(ConfigurationError, match="columns"):
        make_axes(values | {"device": "six_channel_text", "columns": "x y"})
