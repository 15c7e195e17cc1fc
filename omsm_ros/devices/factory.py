"""Which devices there are, what can be set on each, and how one is made from its parameters."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

from omsm_ros.devices.capancdt import CapaNcdtDevice, CapaNcdtSettings
from omsm_ros.devices.chrocodile import ChrocodileSettings
from omsm_ros.devices.chrocodile_dollar import ChrocodileDevice
from omsm_ros.devices.chrocodile_packet import ChrocodilePacketDevice
from omsm_ros.devices.confocaldt import (
    ConfocalDtDevice,
    ConfocalDtEthernetDevice,
    ConfocalDtSettings,
)
from omsm_ros.devices.csv_stream import CsvSettings, CsvStreamDevice
from omsm_ros.devices.generic_stream import GenericStreamDevice, StreamSettings
from omsm_ros.devices.stream import StreamDevice
from omsm_ros.devices.trace import TracedTransport
from omsm_ros.devices.transport import DEFAULT_BAUD_RATE, Transport, transport_for
from omsm_ros.errors import ConfigurationError
from omsm_ros.protocols.chrocodile_readings import ProbeReading
from omsm_ros.protocols.csv_stream import COLUMNS
from omsm_ros.protocols.generic_stream import AXES, AxisScaling, ProbeScaling, StreamScaling

Values: TypeAlias = Mapping[str, Any]
NowNs: TypeAlias = Callable[[], int]


@dataclass(frozen=True, slots=True)
class Parameter:
    """One thing that can be set; the same names in ROS, YAML and here."""

    name: str
    default: bool | int | float | str
    description: str


_USUAL = StreamScaling()

PARAMETERS = (
    Parameter("device", "six_channel", "what is connected: see the table of devices"),
    Parameter("port", "/tmp/omsm_cell", "serial:///dev/ttyUSB0?baud=921600, tcp://host:port, path"),
    Parameter("baud_rate", DEFAULT_BAUD_RATE, "of a serial port that does not name its own"),
    Parameter("trace", "", "file for a trace of the wire; empty = none"),
    Parameter("sample_period", 1e-3, "of the trigger, or of a device that runs freely [s]"),
    Parameter("block_size", 100, "samples in a message"),
    *(
        parameter
        for name, axis in zip(AXES, _USUAL.axes, strict=True)
        for parameter in (
            Parameter(f"{name}.counts_per_unit", axis.counts_per_unit, "counts per m or rad"),
            Parameter(f"{name}.sign", axis.sign, "+1 or -1"),
            Parameter(f"{name}.offset", axis.offset, "position at zero counts [m, rad]"),
            Parameter(f"{name}.wrap", axis.wrap, "counts at which it wraps; 0 = as the device"),
        )
    ),
    Parameter("columns", " ".join(COLUMNS), "of a line of text; - = one to pass over"),
    Parameter("probe.full_scale", _USUAL.probe.full_scale, "measuring range [m]"),
    Parameter("probe.polarity", _USUAL.probe.polarity, "+1: falls as z rises; -1: reversed"),
    Parameter("probe.zero", 0.0, "reading that is distance zero [m]"),
    Parameter("probe.intensity_full_scale", 100.0, "reading that is intensity 1"),
    Parameter(
        "encoders",
        "",
        "CHRocodile: its inputs on X Y Z B C, e.g. XYZUV; confocalDT: the axes on "
        "its encoders 1 2 3, e.g. XZC; empty = none wired",
    ),
    Parameter("latch", "start", "of its encoders at the exposure's start, end, or their mean"),
    Parameter("trigger", "free_run", "free_run, each, once or window"),
    Parameter("format", "binary", "of the telegrams: binary or ascii"),
    Parameter("signals", "", "CHRocodile: for $SODX; confocalDT RS-422: of a frame, in order"),
    Parameter("command_port", 0, "TCP port for commands (confocalDT: 23); 0 = leave it as set"),
    Parameter("lamp", -1.0, "brightness 0-100; negative = as the device has it"),
    Parameter("averaging", -1, "samples; negative = as the device has it"),
    Parameter("threshold", -1.0, "of detection; negative = as the device has it"),
    Parameter("sensor_head", -1, "0-15; negative = as the device has it"),
)


# Axes alone: the same streams, whose distance, if they have one, is left out.
_AXIS_NAMES = ("device", "port", "baud_rate", "sample_period", "block_size", "columns")
AXIS_PARAMETERS = tuple(
    parameter
    for parameter in PARAMETERS
    if parameter.name in _AXIS_NAMES or parameter.name[:2] in ("x.", "y.", "z.", "b.", "c.")
)

REFERENCE_PARAMETERS = (
    Parameter("device", "capancdt", "what is connected: see the table of devices"),
    Parameter("port", "tcp://169.254.168.150:10001", "tcp://host:port of the measured values"),
    Parameter("command_port", 0, "TCP port for commands (capaNCDT: 23); 0 = leave it as set"),
    Parameter("sample_period", 1e-3, "of the controller, or of its trigger [s]"),
    Parameter("block_size", 100, "samples in a message"),
    Parameter("channel", 1, "of the controller, from 1"),
    Parameter("triggered", False, "samples come with a trigger from outside"),
    Parameter("probe.full_scale", 250e-6, "measuring range of the channel [m]"),
    Parameter("probe.polarity", 1, "+1: falls as z rises; -1: reversed"),
    Parameter("probe.zero", 0.0, "reading that is distance zero [m]"),
)


def defaults(parameters: Sequence[Parameter] = PARAMETERS) -> dict[str, Any]:
    """Every parameter at its default."""
    return {parameter.name: parameter.default for parameter in parameters}


def make_device(values: Values, now_ns: NowNs = time.time_ns) -> StreamDevice:
    """The device that ``values`` describe, not yet connected.

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
    """The stream of axes that ``values`` describe, not yet connected.

    values: every name of AXIS_PARAMETERS. Raises ConfigurationError.
    """
    streams = ("six_channel", "six_channel_text")
    if values["device"] not in streams:
        raise ConfigurationError(f"device {values['device']!r}, expected one of {streams}")
    return make_device(defaults() | dict(values), now_ns)


def make_reference(values: Values, now_ns: NowNs = time.time_ns) -> StreamDevice:
    """The reference sensor that ``values`` describe, not yet connected.

    values: every name of REFERENCE_PARAMETERS. Raises ConfigurationError.
    """
    if values["device"] != "capancdt":
        raise ConfigurationError(f"device {values['device']!r}, expected 'capancdt'")
    probe = ProbeReading(
        full_scale=values["probe.full_scale"],
        zero=values["probe.zero"],
        polarity=values["probe.polarity"],
    )
    settings = CapaNcdtSettings(
        **_blocks(values), probe=probe, channel=values["channel"], triggered=values["triggered"]
    )
    commands = command_transport(values["port"], values["command_port"])
    return CapaNcdtDevice(transport_for(values["port"]), settings, now_ns, commands=commands)


def _axes(values: Values) -> dict[str, AxisScaling]:
    return {
        axis: AxisScaling(**{f.name: values[f"{axis}.{f.name}"] for f in fields(AxisScaling)})
        for axis in AXES
    }


def _blocks(values: Values) -> dict[str, Any]:
    return {"sample_period": values["sample_period"], "block_size": values["block_size"]}


def _six_channel(values: Values, transport: Transport, now_ns: NowNs) -> StreamDevice:
    probe = ProbeScaling(full_scale=values["probe.full_scale"], polarity=values["probe.polarity"])
    scaling = StreamScaling(**_axes(values), probe=probe)
    settings = StreamSettings(**_blocks(values), scaling=scaling)
    return GenericStreamDevice(transport, settings, now_ns)


def _six_channel_text(values: Values, transport: Transport, now_ns: NowNs) -> StreamDevice:
    probe = ProbeScaling(full_scale=values["probe.full_scale"], polarity=values["probe.polarity"])
    scaling = StreamScaling(**_axes(values), probe=probe)
    columns = tuple(values["columns"].replace(",", " ").split())
    settings = CsvSettings(**_blocks(values), columns=columns, scaling=scaling)
    return CsvStreamDevice(transport, settings, now_ns)


def _chrocodile(
    kind: type[ChrocodileDevice] | type[ChrocodilePacketDevice],
    values: Values,
    transport: Transport,
    now_ns: NowNs,
) -> StreamDevice:
    settings = ChrocodileSettings(
        **_blocks(values),
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
        **_blocks(values), probe=_probe_reading(values), values=words, trigger=values["trigger"]
    )
    return ConfocalDtDevice(transport, settings, now_ns)


def _confocaldt_ethernet(values: Values, transport: Transport, now_ns: NowNs) -> StreamDevice:
    settings = ConfocalDtSettings(
        **_blocks(values),
        probe=_probe_reading(values),
        axes=tuple(_axes(values).values()) if values["encoders"] else None,
        wired=_wired(values["encoders"]),
        trigger=values["trigger"],
    )
    commands = command_transport(values["port"], values["command_port"])
    return ConfocalDtEthernetDevice(transport, settings, now_ns, commands=commands)


def command_transport(address: str, port: int) -> Transport | None:
    """The port for commands of the device at ``address``; None for port 0."""
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
