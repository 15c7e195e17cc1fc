"""Every device from its parameters, nothing touched before it is opened."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import pytest

from omsm_ros.errors import ConfigurationError
from omsm_ros.instruments import parameters
from omsm_ros.instruments.chrocodile import device as chrocodile
from omsm_ros.instruments.chrocodile.telegram import LATCHES
from omsm_ros.instruments.emulator_factory import EMULATED, emulated
from omsm_ros.instruments.factory import make_accelerometer, make_axes, make_device, make_reference
from omsm_ros.instruments.parameters import (
    ACCELEROMETER_PARAMETERS,
    AXIS_PARAMETERS,
    PARAMETERS,
    REFERENCE_PARAMETERS,
    command_transport,
    defaults,
)
from omsm_ros.instruments.registry import ACCELEROMETERS, PROBES, REFERENCES, Model, loaded
from omsm_ros.instruments.six_channel.protocol import COLUMNS

# The scales of a device must be stated; here those of the emulated one.
STATED = emulated("six_channel").driver


@pytest.mark.parametrize("name", PROBES)
def test_every_device_is_made_from_the_defaults(name: str) -> None:
    stated = {} if name == "linuxcnc" else STATED  # LinuxCNC sends positions, not counts
    device = make_device(defaults() | stated | {"device": name, "port": "tcp://device.invalid:1"})
    assert device.statistics.decoded == 0
    assert device.identity == {}


def test_every_emulated_device_has_its_driver() -> None:
    # LinuxCNC is emulated by itself.
    assert set(EMULATED) == {*PROBES, "capancdt"} - {"linuxcnc"}
    names = {parameter.name for parameter in PARAMETERS}
    # A probe without encoders is no whole cell.
    second = emulated("confocaldt").second
    assert second is not None
    assert second.node == "axis_driver"
    for name in EMULATED:
        assert set(emulated(name).driver) <= names


@pytest.mark.parametrize(
    "model", [*PROBES.values(), *REFERENCES.values(), *ACCELEROMETERS.values()]
)
def test_every_place_in_the_table_of_models_exists(model: Model) -> None:
    assert callable(loaded(model.driver))
    if model.emulator:
        assert callable(loaded(model.emulator).make)


def test_the_words_of_the_parameters_are_those_of_the_device() -> None:
    """The table of parameters is read without loading a device."""
    assert tuple(chrocodile.TRIGGERS) == parameters.TRIGGERS
    assert tuple(chrocodile.FORMATS) == parameters.FORMATS
    assert tuple(LATCHES) == parameters.LATCHES
    assert defaults()["columns"].split() == list(COLUMNS)


def test_no_device_is_loaded_before_it_is_asked_for() -> None:
    look = "; ".join(
        (
            "import sys",
            "from omsm_ros.instruments import emulator_factory, factory",
            "print([m for m in sys.modules if m.startswith('omsm_ros.instruments.')"
            " and m.endswith(('device', 'emulator')) and m.count('.') > 2])",
        )
    )
    done = subprocess.run([sys.executable, "-c", look], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_an_accelerometer_is_made_from_its_defaults() -> None:
    values = defaults(ACCELEROMETER_PARAMETERS) | {"port": "synthetic://"}
    assert make_accelerometer(values).counts()["decoded"] == 0
    with pytest.raises(ConfigurationError, match="device 'ruler'"):
        make_accelerometer(values | {"device": "ruler"})


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"device": "ruler"}, "device 'ruler', expected one of"),
        ({"device": "chrocodile", "signals": "83 x"}, "signals '83 x'"),
        ({"device": "chrocodile", "encoders": "XYZ"}, "encoders 'XYZ'"),
        ({"port": "tcp://host"}, "tcp://host:port"),
        ({"z.counts_per_unit": 0.0}, "'z.counts_per_unit' is not stated"),
        (
            {"device": "six_channel_text", "b.counts_per_unit": 0.0},
            "'b.counts_per_unit' is not stated",
        ),
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
