"""Sensors beside the probe: which there are, what can be set on each, and how one is made."""

from __future__ import annotations

import time
from dataclasses import replace

from omsm_ros import quantities
from omsm_ros.devices.analog import (
    STANDARD_GRAVITY,
    Accelerometer,
    AnalogDevice,
    AnalogReference,
    AnalogSettings,
)
from omsm_ros.devices.analog_inputs import analog_input
from omsm_ros.devices.capancdt import CapaNcdtDevice, CapaNcdtSettings
from omsm_ros.devices.factory import (
    BLOCK_PARAMETERS,
    COMMAND_PORT,
    DEVICE,
    PORT,
    NowNs,
    Values,
    block_settings,
    command_transport,
    probe_parameters,
)
from omsm_ros.devices.stream import StreamDevice
from omsm_ros.devices.transport import transport_for
from omsm_ros.errors import ConfigurationError
from omsm_ros.parameters import Parameter
from omsm_ros.protocols.chrocodile_readings import ProbeReading

_REFERENCES = ("capancdt", "analog")
_CONVERTER = "daq://Dev1/ai0:2?range=10&clock=PFI0, or synthetic://?frequency=680&amplitude=0.01"

REFERENCE_PARAMETERS = (
    replace(DEVICE, default="capancdt", choices=_REFERENCES),
    PORT,
    COMMAND_PORT,
    *BLOCK_PARAMETERS,
    Parameter("channel", 1, "of the controller", quantities.CHANNEL),
    Parameter("triggered", False, "samples come with a trigger from outside"),
    *probe_parameters(250e-6),
    Parameter(
        "sensitivity",
        80e3,
        "of an analog sensor [V/m]; 80 mV/µm are 80000",
        quantities.VOLTS_PER_METRE,
    ),
)

ACCELEROMETER_PARAMETERS = (
    replace(DEVICE, default="analog", choices=("analog",)),
    replace(PORT, description=_CONVERTER),
    *BLOCK_PARAMETERS,
    Parameter("sensitivity", 0.5, "of each axis [V/g]; 500 mV/g are 0.5", quantities.VOLTS_PER_G),
)


def make_reference(values: Values, now_ns: NowNs = time.time_ns) -> StreamDevice | AnalogDevice:
    """Return the reference sensor that ``values`` describe, not yet connected.

    values: every name of REFERENCE_PARAMETERS. Raises ConfigurationError.
    """
    if values["device"] not in _REFERENCES:
        raise ConfigurationError(f"device {values['device']!r}, expected one of {_REFERENCES}")
    if values["device"] == "analog":
        return _analog_reference(values, now_ns)
    probe = ProbeReading(
        full_scale=values["probe.full_scale"],
        zero=values["probe.zero"],
        polarity=values["probe.polarity"],
    )
    settings = CapaNcdtSettings(
        **block_settings(values),
        probe=probe,
        channel=values["channel"],
        triggered=values["triggered"],
    )
    commands = command_transport(values["port"], values["command_port"])
    return CapaNcdtDevice(transport_for(values["port"]), settings, now_ns, commands=commands)


def make_accelerometer(values: Values, now_ns: NowNs = time.time_ns) -> Accelerometer:
    """Return the accelerometer that ``values`` describe, not yet sampling.

    values: every name of ACCELEROMETER_PARAMETERS. Raises ConfigurationError.
    """
    settings = AnalogSettings(**block_settings(values))
    sensitivity = values["sensitivity"] / STANDARD_GRAVITY
    return Accelerometer(analog_input(values["port"], 3), settings, sensitivity, now_ns=now_ns)


def _analog_reference(values: Values, now_ns: NowNs) -> AnalogReference:
    return AnalogReference(
        analog_input(values["port"], 1),
        AnalogSettings(**block_settings(values)),
        sensitivity=values["sensitivity"],
        full_scale=values["probe.full_scale"],
        polarity=values["probe.polarity"],
        zero=values["probe.zero"],
        now_ns=now_ns,
    )
