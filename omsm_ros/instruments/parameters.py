"""The parameters of the drivers, and the settings that all devices take from them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from typing import Any, TypeAlias

from omsm_ros import quantities
from omsm_ros.errors import ConfigurationError
from omsm_ros.instruments.registry import ACCELEROMETERS, PROBES, REFERENCES
from omsm_ros.instruments.scaling import AXES, AxisScaling, ProbeReading
from omsm_ros.instruments.transport import DEFAULT_BAUD_RATE, Transport, transport_for
from omsm_ros.quantities import Parameter

Values: TypeAlias = Mapping[str, Any]
NowNs: TypeAlias = Callable[[], int]


_SIGNS = (1, -1)
_AS_IT_IS = "as the device has it"
_PERIOD = "period of the trigger, or of a free-running device [s]"
STREAMS = ("six_channel", "six_channel_text", "linuxcnc")
TRIGGERS = ("free_run", "each", "once", "window")
FORMATS = ("binary", "ascii")
LATCHES = ("start", "end", "mean")
COMMAND_PORT = Parameter(
    "command_port",
    0,
    "TCP port for commands (confocalDT, capaNCDT: 23); 0 = keep its settings",
    quantities.TCP_PORT,
)


def _axis_parameters(axis: str, unit: str) -> tuple[Parameter, ...]:
    # A default scale would give plausible but wrong positions, so there is none.
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
    """Return the parameters of range, sign and zero of a displacement sensor."""
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
    "device", "six_channel", "what is connected: see docs/devices.md", choices=tuple(PROBES)
)
RENEW = Parameter(
    "renew",
    10.0,
    "longest time between two connections to a silent TCP stream [s]; 0 = never",
    quantities.SILENCE,
)
_STREAM_PARAMETERS = (
    PORT,
    RENEW,
    Parameter(
        "baud_rate",
        DEFAULT_BAUD_RATE,
        "baud rate of a serial port whose address names none",
        quantities.BAUD_RATE,
    ),
    *BLOCK_PARAMETERS,
    *(p for axis in AXES for p in _axis_parameters(axis, "rad" if axis in "bc" else "m")),
)
# The columns of ``six_channel.protocol``.
USUAL_COLUMNS = "sequence device_time distance status x y z b c"
_COLUMNS = "columns of a line of text, in order; - = ignored"

PARAMETERS = (
    DEVICE,
    *_STREAM_PARAMETERS,
    Parameter("trace", "", "file for a trace of the wire; empty = none"),
    Parameter("columns", USUAL_COLUMNS, _COLUMNS),
    *probe_parameters(100e-6),
    Parameter(
        "probe.intensity_full_scale", 100.0, "reading that is intensity 1", quantities.INTENSITY
    ),
    Parameter(
        "encoders",
        "",
        "CHRocodile: its inputs on X Y Z B C, e.g. XYZUV; confocalDT: the axes on "
        "its encoders 1 2 3, e.g. XZC; empty = none wired",
    ),
    Parameter("latch", "start", "encoders at the exposure's start, end, or mean", choices=LATCHES),
    Parameter("trigger", "free_run", "what starts a sample", choices=TRIGGERS),
    Parameter("format", "binary", "of the telegrams", choices=FORMATS),
    Parameter("signals", "", "CHRocodile: for $SODX; confocalDT RS-422: of a frame, in order"),
    COMMAND_PORT,
    Parameter("lamp", -1.0, f"brightness [%]; -1 = {_AS_IT_IS}", quantities.PERCENT, unset=-1.0),
    Parameter("averaging", -1, f"samples; -1 = {_AS_IT_IS}", quantities.AVERAGING, unset=-1),
    Parameter(
        "threshold", -1.0, f"of detection; -1 = {_AS_IT_IS}", quantities.THRESHOLD, unset=-1.0
    ),
    Parameter("sensor_head", -1, f"-1 = {_AS_IT_IS}", quantities.SENSOR_HEAD, unset=-1),
)

# For the axes alone the same streams are read, without their distance.
AXIS_PARAMETERS = (
    replace(DEVICE, choices=STREAMS),
    *_STREAM_PARAMETERS,
    Parameter("columns", USUAL_COLUMNS, _COLUMNS),
)

_CONVERTER = "daq://Dev1/ai0:2?range=10&clock=PFI0, or synthetic://?frequency=680&amplitude=0.01"

REFERENCE_PARAMETERS = (
    replace(DEVICE, default="capancdt", choices=tuple(REFERENCES)),
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
    replace(DEVICE, default="analog", choices=tuple(ACCELEROMETERS)),
    replace(PORT, description=_CONVERTER),
    *BLOCK_PARAMETERS,
    Parameter("sensitivity", 0.5, "of each axis [V/g]; 500 mV/g are 0.5", quantities.VOLTS_PER_G),
)


def defaults(parameters: Sequence[Parameter] = PARAMETERS) -> dict[str, Any]:
    """Return every parameter at its default."""
    return {parameter.name: parameter.default for parameter in parameters}


def axes_of(values: Values, wired: Sequence[str] = AXES) -> dict[str, AxisScaling]:
    """Return the scaling of each axis; ConfigurationError for one of ``wired`` without a scale."""
    for axis in wired:
        if values[f"{axis}.counts_per_unit"] == 0:
            raise ConfigurationError(
                f"parameter '{axis}.counts_per_unit' is not stated, but axis {axis} is read; state "
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
    """Return the settings of ``BlockSettings`` that each device has."""
    return {"sample_period": values["sample_period"], "block_size": values["block_size"]}


def probe_reading_of(values: Values) -> ProbeReading:
    """Return how the probe's readings become distances; not each probe has an intensity."""
    names = [f.name for f in fields(ProbeReading) if f"probe.{f.name}" in values]
    return ProbeReading(**{name: values[f"probe.{name}"] for name in names})


def command_transport(address: str, port: int) -> Transport | None:
    """Return the port for commands of the device at ``address``; None for port 0."""
    if port == 0:
        return None
    host, colon, _ = address.rpartition(":")
    if not address.startswith("tcp://") or not colon:
        raise ConfigurationError(f"command_port {port!r} needs a port tcp://host:port")
    return transport_for(f"{host}:{port}")
