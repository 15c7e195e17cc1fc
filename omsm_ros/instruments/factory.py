"""Which devices there are, what can be set on each, and how one is made from its parameters."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

from omsm_ros import quantities
from omsm_ros.errors import ConfigurationError
from omsm_ros.instruments.analog.device import (
    STANDARD_GRAVITY,
    Accelerometer,
    AnalogDevice,
    AnalogReference,
    AnalogSettings,
    analog_input,
)
from omsm_ros.instruments.chrocodile.device import (
    FORMATS,
    TRIGGERS,
    ChrocodileDevice,
    ChrocodileSettings,
)
from omsm_ros.instruments.chrocodile.packet_device import ChrocodilePacketDevice
from omsm_ros.instruments.chrocodile.telegram import LATCHES, ProbeReading
from omsm_ros.instruments.micro_epsilon.device import (
    CapaNcdtDevice,
    CapaNcdtSettings,
    ConfocalDtDevice,
    ConfocalDtEthernetDevice,
    ConfocalDtSettings,
)
from omsm_ros.instruments.six_channel.device import (
    CsvSettings,
    CsvStreamDevice,
    GenericStreamDevice,
    StreamSettings,
)
from omsm_ros.instruments.six_channel.protocol import (
    AXES,
    COLUMNS,
    AxisScaling,
    ProbeScaling,
    StreamScaling,
)
from omsm_ros.instruments.stream import StreamDevice
from omsm_ros.instruments.trace import TracedTransport
from omsm_ros.instruments.transport import DEFAULT_BAUD_RATE, Transport, transport_for
from omsm_ros.quantities import Parameter

Values: TypeAlias = Mapping[str, Any]
NowNs: TypeAlias = Callable[[], int]


_USUAL = StreamScaling()
_SIGNS = (1, -1)
_AS_IT_IS = "as the device has it"
_PERIOD = "of the trigger, or of a device that runs freely [s]"
_STREAMS = ("six_channel", "six_channel_text")
_CHROCODILES = ("chrocodile", "chrocodile_packet")
_CONFOCALDTS = ("confocaldt", "confocaldt_ethernet")
COMMAND_PORT = Parameter(
    "command_port",
    0,
    "TCP port for commands (confocalDT, capaNCDT: 23); 0 = leave it as it is set",
    quantities.TCP_PORT,
)


def _axis_parameters(axis: str, unit: str) -> tuple[Parameter, ...]:
    # A scale that nobody stated would still give plausible positions, so there is none.
    return (
        Parameter(
            f"{axis}.counts_per_unit",
            0.0,
            f"counts per {unit}; 0 = not stated, refused for an axis that is read",
            quantities.COUNTS_PER_UNIT,
            unset=0.0,
        ),
        Parameter(f"{axis}.sign", 1, "+1 or -1", choices=_SIGNS),
        Parameter(f"{axis}.offset", 0.0, f"position at zero counts [{unit}]", quantities.OFFSET),
        Parameter(f"{axis}.wrap", 0, "counts; 0 = as the device", quantities.WRAP),
    )


def probe_parameters(full_scale: float) -> tuple[Parameter, ...]:
    """Return range, sign and zero of a sensor of displacement."""
    return (
        Parameter("probe.full_scale", full_scale, "measuring range [m]", quantities.FULL_SCALE),
        Parameter("probe.polarity", 1, "+1: falls as z rises; -1: reversed", choices=_SIGNS),
        Parameter("probe.zero", 0.0, "reading that is distance zero [m]", quantities.DISTANCE),
    )


BLOCK_PARAMETERS = (
    Parameter("sample_period", 1e-3, _PERIOD, quantities.SAMPLE_PERIOD),
    Parameter("block_size", 100, "samples in a message", quantities.BLOCK_SAMPLES),
)
PORT = Parameter(
    "port", "", "serial:///dev/ttyUSB0?baud=921600, tcp://host:port, or a path", required=True
)
DEVICE = Parameter(
    "device",
    "six_channel",
    "what is connected: see docs/devices.md",
    choices=(*_STREAMS, *_CHROCODILES, *_CONFOCALDTS),
)
RENEW = Parameter(
    "renew",
    10.0,
    "a stream over TCP that is silent for so long is connected anew [s]; 0 = never",
    quantities.SILENCE,
)
_STREAM_PARAMETERS = (
    PORT,
    RENEW,
    Parameter(
        "baud_rate",
        DEFAULT_BAUD_RATE,
        "of a serial port that does not name its own",
        quantities.BAUD_RATE,
    ),
    *BLOCK_PARAMETERS,
    *(p for axis in AXES for p in _axis_parameters(axis, "rad" if axis in "bc" else "m")),
)
_COLUMNS = "of a line of text, in order; - = one to pass over"

PARAMETERS = (
    DEVICE,
    *_STREAM_PARAMETERS,
    Parameter("trace", "", "file for a trace of the wire; empty = none"),
    Parameter("columns", " ".join(COLUMNS), _COLUMNS),
    *probe_parameters(_USUAL.probe.full_scale),
    Parameter(
        "probe.intensity_full_scale", 100.0, "reading that is intensity 1", quantities.INTENSITY
    ),
    Parameter(
        "encoders",
        "",
        "CHRocodile: its inputs on X Y Z B C, e.g. XYZUV; confocalDT: the axes on "
        "its encoders 1 2 3, e.g. XZC; empty = none wired",
    ),
    Parameter(
        "latch", "start", "encoders at the exposure's start, end, or mean", choices=tuple(LATCHES)
    ),
    Parameter("trigger", "free_run", "what starts a sample", choices=tuple(TRIGGERS)),
    Parameter("format", "binary", "of the telegrams", choices=tuple(FORMATS)),
    Parameter("signals", "", "CHRocodile: for $SODX; confocalDT RS-422: of a frame, in order"),
    COMMAND_PORT,
    Parameter("lamp", -1.0, f"brightness [%]; -1 = {_AS_IT_IS}", quantities.PERCENT, unset=-1.0),
    Parameter("averaging", -1, f"samples; -1 = {_AS_IT_IS}", quantities.AVERAGING, unset=-1),
    Parameter(
        "threshold", -1.0, f"of detection; -1 = {_AS_IT_IS}", quantities.THRESHOLD, unset=-1.0
    ),
    Parameter("sensor_head", -1, f"-1 = {_AS_IT_IS}", quantities.SENSOR_HEAD, unset=-1),
)

# Axes alone: the same streams, whose distance, if they have one, is left out.
AXIS_PARAMETERS = (
    replace(DEVICE, choices=_STREAMS),
    *_STREAM_PARAMETERS,
    Parameter("columns", " ".join(COLUMNS), _COLUMNS),
)


def defaults(parameters: Sequence[Parameter] = PARAMETERS) -> dict[str, Any]:
    """Return every parameter at its default."""
    return {parameter.name: parameter.default for parameter in parameters}


def make_device(values: Values, now_ns: NowNs = time.time_ns) -> StreamDevice:
    """Return the device that ``values`` describe, not yet connected.

    values: every name of PARAMETERS. Raises ConfigurationError.
    """
    make = DEVICES.get(values["device"])
    if make is None:
        raise ConfigurationError(f"device {values['device']!r}, expected one of {sorted(DEVICES)}")
    transport = transport_for(values["port"], values["baud_rate"])
    if values["trace"]:
        transport = TracedTransport(transport, Path(values["trace"]))
    return make(values, transport, now_ns)


def make_axes(values: Values, now_ns: NowNs = time.time_ns) -> StreamDevice:
    """Return the stream of axes that ``values`` describe, not yet connected.

    values: every name of AXIS_PARAMETERS. Raises ConfigurationError.
    """
    if values["device"] not in _STREAMS:
        raise ConfigurationError(f"device {values['device']!r}, expected one of {_STREAMS}")
    return make_device(defaults() | dict(values), now_ns)


def _axes(values: Values, wired: Sequence[str] = AXES) -> dict[str, AxisScaling]:
    """Return the scaling of every axis; ConfigurationError for one of ``wired`` without a scale."""
    for axis in wired:
        if values[f"{axis}.counts_per_unit"] == 0:
            raise ConfigurationError(
                f"parameter '{axis}.counts_per_unit' is not stated, and axis {axis} is read: give "
                "the encoder's counts per metre or radian (config/ has a YAML to copy)"
            )
    given = {
        axis: {f.name: values[f"{axis}.{f.name}"] for f in fields(AxisScaling)} for axis in AXES
    }
    return {
        axis: AxisScaling(**(each if axis in wired else each | {"counts_per_unit": 1.0}))
        for axis, each in given.items()
    }


def block_settings(values: Values) -> dict[str, Any]:
    """Return what every device needs to know of its samples."""
    return {"sample_period": values["sample_period"], "block_size": values["block_size"]}


def _stream_settings(values: Values) -> dict[str, Any]:
    """Return settings of a stream that cannot be asked whether it rests or is gone.

    A serial line is never half open.
    """
    renew = values["renew"] if values["port"].startswith("tcp://") else 0.0
    return block_settings(values) | {"renew": renew}


def _six_channel(values: Values, transport: Transport, now_ns: NowNs) -> StreamDevice:
    probe = ProbeScaling(full_scale=values["probe.full_scale"], polarity=values["probe.polarity"])
    scaling = StreamScaling(**_axes(values), probe=probe)
    settings = StreamSettings(**_stream_settings(values), scaling=scaling)
    return GenericStreamDevice(transport, settings, now_ns)


def _six_channel_text(values: Values, transport: Transport, now_ns: NowNs) -> StreamDevice:
    probe = ProbeScaling(full_scale=values["probe.full_scale"], polarity=values["probe.polarity"])
    columns = tuple(values["columns"].replace(",", " ").split())
    scaling = StreamScaling(**_axes(values, [a for a in AXES if a in columns]), probe=probe)
    settings = CsvSettings(**_stream_settings(values), columns=columns, scaling=scaling)
    return CsvStreamDevice(transport, settings, now_ns)


def _chrocodile(
    kind: type[ChrocodileDevice] | type[ChrocodilePacketDevice],
    values: Values,
    transport: Transport,
    now_ns: NowNs,
) -> StreamDevice:
    settings = ChrocodileSettings(
        **block_settings(values),
        signals=_numbers("signals", values["signals"]),
        axes=tuple(_axes(values).values()) if values["encoders"] else None,
        encoders=_encoders(values["encoders"] or "XYZUV"),
        latch=values["latch"],
        trigger=values["trigger"],
        format=values["format"],
        lamp=_unless_negative(values["lamp"]),
        averaging=_unless_negative(values["averaging"]),
        threshold=_unless_negative(values["threshold"]),
        head=_unless_negative(values["sensor_head"]),
        probe=_probe_reading(values),
    )
    return kind(transport, settings, now_ns)


def _confocaldt(values: Values, transport: Transport, now_ns: NowNs) -> StreamDevice:
    words = tuple(values["signals"].replace(",", " ").split()) or ("distance",)
    settings = ConfocalDtSettings(
        **block_settings(values),
        probe=_probe_reading(values),
        values=words,
        trigger=values["trigger"],
    )
    return ConfocalDtDevice(transport, settings, now_ns)


def _confocaldt_ethernet(values: Values, transport: Transport, now_ns: NowNs) -> StreamDevice:
    settings = ConfocalDtSettings(
        **block_settings(values),
        probe=_probe_reading(values),
        axes=tuple(_axes(values, values["encoders"].lower()).values())
        if values["encoders"]
        else None,
        wired=_wired(values["encoders"]),
        trigger=values["trigger"],
    )
    commands = command_transport(values["port"], values["command_port"])
    return ConfocalDtEthernetDevice(transport, settings, now_ns, commands=commands)


def command_transport(address: str, port: int) -> Transport | None:
    """Return the port for commands of the device at ``address``; None for port 0."""
    if port == 0:
        return None
    host, colon, _ = address.rpartition(":")
    if not address.startswith("tcp://") or not colon:
        raise ConfigurationError(f"command_port {port!r} needs a port tcp://host:port")
    return transport_for(f"{host}:{port}")


def _wired(text: str) -> tuple[int, ...]:
    letters = "XYZBC"
    if len(set(text.upper())) < len(text) or set(text.upper()) - set(letters):
        raise ConfigurationError(f"encoders {text!r}, expected some of the letters {letters}")
    return tuple(letters.index(letter) for letter in text.upper())


def _probe_reading(values: Values) -> ProbeReading:
    return ProbeReading(**{f.name: values[f"probe.{f.name}"] for f in fields(ProbeReading)})


def _numbers(name: str, text: str) -> tuple[int, ...]:
    try:
        return tuple(int(word) for word in text.replace(",", " ").split())
    except ValueError as err:
        raise ConfigurationError(f"{name} {text!r}, expected numbers, like '83 256 257'") from err


def _encoders(text: str) -> tuple[int, ...]:
    letters = "XYZUV"
    if sorted(text.upper()) != sorted(letters):
        raise ConfigurationError(
            f"encoders {text!r}, expected the letters {letters} in the order of X, Y, Z, B, C"
        )
    return tuple(letters.index(letter) for letter in text.upper())


def _unless_negative(value: Any) -> Any:
    return None if value < 0 else value


DEVICES: dict[str, Callable[[Values, Transport, NowNs], StreamDevice]] = {
    "six_channel": _six_channel,
    "six_channel_text": _six_channel_text,
    "chrocodile": partial(_chrocodile, ChrocodileDevice),
    "chrocodile_packet": partial(_chrocodile, ChrocodilePacketDevice),
    "confocaldt": _confocaldt,
    "confocaldt_ethernet": _confocaldt_ethernet,
}


# Sensors beside the probe: which there are, what can be set on each, and how one is made.

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
