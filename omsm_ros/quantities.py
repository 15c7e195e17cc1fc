"""Quantities of input data with their names, units and plausible ranges; parameters of nodes.

A number that enters the package (message, bag, JSON, YAML, CSV, parameter, argument) is checked
once, where it enters, against this table. A range is wide enough for any machine, and narrow enough
that all results stay finite and fit into memory. A number outside has a wrong unit, or comes from a
damaged or forged file.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from omsm_ros.errors import ConfigurationError, DataError, OmsmError, shortened

_SHOWN_CHARACTERS = 60


@dataclass(frozen=True, slots=True)
class Quantity:
    """A physical quantity or another number.

    name: for messages;  unit: SI, empty for a pure number
    low, high: plausible range, both included
    whole: an integer;  signed: the range is that of the magnitude
    remedy: for a number outside the range
    """

    name: str
    unit: str
    low: float
    high: float
    remedy: str = "check its unit"
    whole: bool = False
    signed: bool = False

    def checked(self, value: object, error: type[OmsmError] = DataError, name: str = "") -> Any:
        """Return ``value`` as float, or as int if ``whole``; raise ``error`` if it is implausible.

        name: of the value in messages; empty takes the name of the quantity
        """
        if type(value) is (int if self.whole else float) and self.low <= value <= self.high:
            return value  # the usual case, kept fast
        number = _number(value, self.whole)
        size = abs(number) if number and self.signed else number
        if number is None or not self.low <= size <= self.high:
            raise error(self._refusal(value, name))
        return number

    @property
    def metadata(self) -> dict[str, Quantity]:
        """Metadata of a field of a :class:`CheckedRecord` that holds this quantity."""
        return {"quantity": self}

    def of_field(self, default: Any) -> Any:
        """Return such a field with a default."""
        return field(default=default, metadata=self.metadata)

    def checked_all(
        self, values: NDArray[Any], error: type[OmsmError] = DataError, name: str = ""
    ) -> NDArray[Any]:
        """Return the array (n,); raise ``error`` with the first number that is implausible."""
        good = self._plausible(values)
        if good is not None:
            place = int(np.argmin(good))
            raise error(self._refusal(values[place].item(), f"{name or self.name}[{place}]"))
        return values

    def nan_if_implausible(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return the array (n,) with NaN in place of implausible numbers.

        A single corrupt reading is counted as lost and does not stop a scan.
        """
        good = self._plausible(values)
        return values if good is None else np.where(good, values, np.nan)

    def _plausible(self, values: NDArray[Any]) -> NDArray[np.bool_] | None:
        """Return True where a number is in the range, or None if all are."""
        low, high = self.low, self.high
        if values.dtype.kind == "f":  # a float32 would round the bounds otherwise
            low, high = np.float64(low), np.float64(high)
        # Minimum and maximum are the fastest check of most arrays that starts no BLAS threads.
        if values.size and low <= values.min() and values.max() <= high:
            return None
        good = (values >= low) & (values <= high)
        return None if np.all(good) else np.asarray(good, np.bool_)

    @property
    def range_text(self) -> str:
        """The range with its unit, for messages."""
        sign, unit = "±" if self.signed else "", f" {self.unit}" if self.unit else ""
        return f"from {sign}{self.low:g} to {sign}{self.high:g}{unit}"

    def _refusal(self, value: object, name: str) -> str:
        unit = f" {self.unit}" if self.unit else ""
        kind = "a whole number" if self.whole else "a number"
        return (
            f"{name or self.name} is {shown(value)}{unit}, expected {kind} {self.range_text}; "
            f"{self.remedy}"
        )


class CheckedRecord:
    """Base of dataclasses that checks each field against its quantity; None is not stated.

    error: raised for a number outside its range
    """

    __slots__ = ()
    error: ClassVar[type[OmsmError]] = ConfigurationError

    def __post_init__(self) -> None:
        for each in fields(self):  # type: ignore[arg-type]  # each is a dataclass
            value = getattr(self, each.name)
            if value is not None and "quantity" in each.metadata:
                each.metadata["quantity"].checked(value, self.error, each.name)


def _number(value: object, whole: bool) -> float | int | None:
    """Return ``value`` as a number, or None if it is none."""
    if isinstance(value, bool | np.bool_):
        return None
    if isinstance(value, int | np.integer):
        # An integer of hundreds of digits cannot be converted to float.
        if whole:
            return int(value)
        return float(value) if abs(int(value)) < 2**63 else None
    if isinstance(value, float | np.floating) and math.isfinite(value):
        if not whole:
            return float(value)
        return int(value) if float(value).is_integer() else None
    return None


def shown(value: object) -> str:
    """Return ``repr(value)`` for a message, shortened in its middle."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # an integer of thousands of digits, a nest of lists
        text = f"a {type(value).__name__} too large to print"
    return shortened(text, _SHOWN_CHARACTERS)


# Sampled data.

SAMPLE_PERIOD = Quantity("sample period", "s", 1e-7, 10.0, "give it in seconds")
# A float represents integers up to 2**53 exactly; the margin holds the samples of one block. At
# 1 MHz this is 285 years.
COUNTER = Quantity(
    "trigger counter", "", 0, 2**53 - 2**40, "the device's counter is corrupt", whole=True
)
# Seconds of ROS time have 32 bits.
_MAX_STAMP_NS = 2**31 * 10**9
STAMP = Quantity(
    "stamp", "ns", -_MAX_STAMP_NS, _MAX_STAMP_NS, "set the clock of the sender", whole=True
)
# Any quantity in any unit; products of four of them are finite.
SIGNAL = Quantity("signal", "", -1e50, 1e50, "scale it")
POSITION = Quantity("position", "m", -100.0, 100.0, "give it in metres")
DISTANCE = Quantity("distance", "m", -100.0, 100.0, "give it in metres")
# The angle of a spindle is unwrapped: a year at 30 rpm is 1e8 rad.
ANGLE = Quantity("angle", "rad", -1e9, 1e9, "give it in radians")
ACCELERATION = Quantity("acceleration", "m/s²", -1e6, 1e6, "give it in m/s²")
TEMPERATURE = Quantity("temperature", "°C", -100.0, 200.0, "give it in degrees Celsius")
TIME = Quantity("time", "s", -1e10, 1e10, "give it in seconds")
# Waiting samples of a minute at 20 kHz need 250 MB.
WAIT = Quantity("waiting time", "s", 1e-3, 60.0, "give it in seconds")
DURATION = Quantity("duration", "s", 0.0, 1e7, "give it in seconds; 0 = all")

# Dynamics.

DELAY = Quantity("delay", "s", 0.0, 1.0, "identify again; the loop's delay is milliseconds")
# A drift over hours is no dynamics of a servo; below a nanosecond no sensor resolves it.
TIME_CONSTANT = Quantity("time constant", "s", 1e-10, 1000.0, "identify again")
ACCELERATION_LIMIT = Quantity("acceleration", "m/s²", 1e-9, 1e5, "give it in m/s²")
FREQUENCY = Quantity("frequency", "Hz", 1e-6, 1e9, "give it in hertz")
GAIN = Quantity("static gain", "", 1e-6, 1e6, "check the units of encoder and probe")
MAX_DELAY_SAMPLES = Quantity("longest delay", "samples", 0, 50, "0 = none", whole=True)
ORDER = Quantity("order", "", 0, 40, "0 = choose", whole=True)

# Machine and surface.

LENGTH = Quantity("length", "m", -10.0, 10.0, "give it in metres")
RADIUS = Quantity("radius", "m", 1e-6, 1e10, "give it in metres, negative if convex", signed=True)
FEED = Quantity("feed of a turn", "m", 1e-9, 1.0, "give it in metres")
SPOT = Quantity("spot", "m", 0.0, 1e-2, "give its diameter in metres")
FOCAL_LENGTH = Quantity("focal length", "m", 1e-6, 1e10, "give it in metres")
CONIC_CONSTANT = Quantity("conic constant", "", -1e4, 1e4, "0 is a sphere, -1 a paraboloid")
# Coefficient of a surface term; its square is finite at the largest power and length.
COEFFICIENT = Quantity("coefficient", "", -1e40, 1e40, "check its unit and its sign")
# Coefficient of a term over a disc; its square is finite at the smallest disc and highest order.
TERM_SIZE = Quantity("coefficient", "m", -10.0, 10.0, "give it in metres")
DISC_RADIUS = Quantity("radius of the disc", "m", 1e-4, 1e2, "give it in metres")
TERM_ORDER = Quantity("power", "", 0, 20, "give a smaller one", whole=True)
TURN = Quantity("angle", "rad", -3.15, 3.15, "give it in radians")
TABLE_ANGLE = Quantity("angle of B", "rad", -6.3, 6.3, "give it in radians")
PROBE_ANGLE = Quantity("angle to the normal", "rad", 0.0, 1.5708, "give it in radians")
SLOPE = Quantity("slope", "", -1.0, 1.0, "give the tangent of the angle")
PITCH = Quantity("pitch", "rad", -1.0, 1.0, "give it in radians")
MASS = Quantity("mass", "kg", 1e-6, 1e6, "give it in kilograms")
SPACING = Quantity("spacing", "m", 1e-9, 1.0, "give it in metres")
# Positions closer than a tenth of an atom are equal.
MAP_SPACING = Quantity("spacing of the map", "m", 1e-12, 1.0, "give it in metres")
# Pixels of the largest interferometer camera, 3.4 k × 3.4 k; reading them needs 0.7 GB.
MAP_POINTS = Quantity(
    "number of points", "", 1, 12_000_000, "write their true number, or thin them", whole=True
)
# Records of a file whose length confirms their number; each needs 24 bytes.
CLOUD_POINTS = Quantity(
    "number of points", "", 1, 40_000_000, "write their true number, or thin them", whole=True
)
STEP = Quantity("length", "m", 1e-10, 1.0, "give it in metres")

# Uncertainty.

UNCERTAINTY = Quantity("standard uncertainty", "m", 0.0, 10.0, "give it in metres, k = 1")
TIME_UNCERTAINTY = Quantity("standard uncertainty", "s", 0.0, 1.0, "give it in seconds, k = 1")
GAIN_UNCERTAINTY = Quantity("standard uncertainty", "", 0.0, 1e6, "give it as a share, k = 1")
TOLERANCE = Quantity("tolerance", "m", 1e-12, 1.0, "give it in metres, peak to valley")
BUDGET = Quantity("allowed error", "m", 1e-15, 1.0, "give it in metres, k = 2")
ANGLE_UNCERTAINTY = Quantity(
    "standard uncertainty", "rad", 0.0, 10.0, "give it in radians, k = 1; 10 = not known"
)
SLOPE_ERROR = Quantity("standard uncertainty", "m/rad", 0.0, 1.0, "give it in m/rad, k = 1")
RATE = Quantity("speed", "m/s", 1e-9, 100.0, "give it in m/s")
RATE_UNCERTAINTY = Quantity("standard uncertainty", "m/s", 0.0, 1.0, "give it in m/s, k = 1")
WALK_UNCERTAINTY = Quantity("standard uncertainty", "m/√s", 0.0, 1.0, "give it in m/√s, k = 1")
PER_TURN = Quantity("waves a turn", "", 1, 10_000, "negative turns against it", True, True)
SPIRAL_PLACES = Quantity("places a turn", "", 3, 10_000, "360 is usual", whole=True)
PERIOD = Quantity("period", "m", 1e-9, 100.0, "give it in metres")
CORRELATION_TIME = Quantity("correlation time", "s", 1e-3, 1e7, "give it in seconds")
LAG = Quantity("probe latency", "s", 0.0, 1.0, "give it in seconds")

COUNTER_OFFSET = Quantity(
    "counter offset", "samples", -(2**53), 2**53, "give it in samples", whole=True
)
STAMP_TOLERANCE = Quantity("stamp tolerance", "s", 0.0, 10.0, "give it in seconds")
STAMP_DELAY = Quantity("delay of the exposure", "s", -10.0, 10.0, "give it in seconds")
EXPOSURE = Quantity("exposure", "s", 0.0, 10.0, "give it in seconds")

# Arguments, parameters.

DWELL = Quantity("dwell", "s", 1e-6, 100.0, "give it in seconds")
RISE = Quantity("rise", "s", 1e-7, 100.0, "give it in seconds")

# An hour at 20 kHz; five channels need 3 GB.
BUFFER_SAMPLES = Quantity(
    "samples kept", "", 1000, 72_000_000, "keep as many as memory holds", whole=True
)
COUNT = Quantity("count", "", 1, 100_000, "give a smaller number", whole=True)
PROCESSES = Quantity("processes", "", 1, 1024, "one a core serves best", whole=True)
SEED = Quantity("seed", "", 0, 2**63 - 1, "give a whole number", whole=True)
PLAY_RATE = Quantity("rate of playing", "", 0.0, 1e4, "1 = as recorded, 0 = as fast as can be")
PLAY_TIME = Quantity("time within a recording", "s", 0.0, 1e8, "give it in seconds")
# Messages of a day in blocks of 0.1 s.
QUEUE_DEPTH = Quantity("depth of a queue", "", 1, 1e6, "give a number of messages", whole=True)
DOMAIN = Quantity("domain", "", 0, 232, "below 102 Linux leaves its ports to it", whole=True)
LISTENERS = Quantity("listeners", "", 0, 1000, "0 = begin at once", whole=True)
TIME_LAPSE = Quantity("time lapse", "", 1e-3, 1e4, "1 = real time")
# Noise may make a latency negative, or larger than a very small lag.
SHARE = Quantity("share", "", -1e6, 1e6, "give it as a share")
HARMONICS = Quantity("harmonics of a turn", "", 1, 60, "12 serve most surfaces", whole=True)
SPEED = Quantity("spindle speed", "rpm", 1e-3, 1e5, "give it in turns a minute", signed=True)

# Devices.

BAUD_RATE = Quantity("baud rate", "bit/s", 50, 50_000_000, "as the device has it", whole=True)
SILENCE = Quantity("silence", "s", 0.0, 86_400.0, "0 = as long as it may be")
TCP_PORT = Quantity("TCP port", "", 0, 65535, "0 = none", whole=True)
BLOCK_SAMPLES = Quantity("samples in a block", "", 1, 4_000_000, "100 serve most", whole=True)
COUNTS_PER_UNIT = Quantity(
    "counts per metre or radian", "", 1e-3, 1e15, "see the encoder's data sheet; sign turns it"
)
OFFSET = Quantity("offset", "m or rad", -1e9, 1e9, "give it in metres or radians")
WRAP = Quantity("counts at which an encoder wraps", "", 0, 2**62, "0 = as the device", whole=True)
VOLTS_PER_METRE = Quantity("sensitivity", "V/m", 1.0, 1e9, "give it in volts per metre")
VOLTS_PER_G = Quantity("sensitivity", "V/g", 1e-4, 100.0, "give it in volts per g")
FULL_SCALE = Quantity("measuring range", "m", 1e-9, 10.0, "give it in metres")
INTENSITY_READING = Quantity("intensity", "", -1e9, 1e9, "give the device's own reading")
INTENSITY = Quantity("full intensity", "", 1e-9, 1e9, "give the device's own reading")
PROBABILITY = Quantity("probability", "", 0.0, 1.0, "give a share between 0 and 1")
PERCENT = Quantity("brightness", "%", 0.0, 100.0, "give it in per cent")
AVERAGING = Quantity("samples averaged", "", 0, 1_000_000, "as the device can", whole=True)
THRESHOLD = Quantity("threshold", "", 0.0, 1e9, "as the device states it")
SENSOR_HEAD = Quantity("sensor head", "", 0, 15, "count from 0", whole=True)
CHANNEL = Quantity("channel", "", 1, 64, "count from 1", whole=True)


# Integers up to here are exact as floats.
_EXACT = 2**53
_KINDS = {bool: "true or false", int: "a whole number", float: "a number", str: "a text"}


@dataclass(frozen=True, slots=True)
class Parameter:
    """A parameter of a node or a device, with the same name in ROS and YAML.

    default: gives the type of the parameter
    quantity: range and unit of a number;  choices: the allowed values, if they can be listed
    unset: value outside the range that means "not stated"
    required: the default is not allowed;  fixed: read once, when the node starts
    """

    name: str
    default: bool | int | float | str
    description: str
    quantity: Quantity | None = None
    choices: tuple[int | str, ...] = ()
    unset: int | float | str | None = None
    required: bool = False
    fixed: bool = False

    @property
    def text(self) -> str:
        """Meaning, range and choices, for help texts."""
        parts = [self.description]
        if self.quantity is not None:
            parts.append(self.quantity.range_text)
        if self.choices:
            parts.append(f"one of {', '.join(map(repr, self.choices))}")
        if self.required:
            parts.append("must be given")
        return "; ".join(parts)

    def checked(self, value: object) -> Any:
        """Return ``value`` in the parameter's type; raise ConfigurationError if not allowed.

        An integer is accepted for a float, but not a float for an integer.
        """
        called = f"parameter {self.name!r} ({self.description})"
        kind = type(self.default)
        if kind is float and type(value) is int and abs(value) < _EXACT:
            value = float(value)
        if type(value) is not kind:
            raise ConfigurationError(f"{called} is {shown(value)}, expected {_KINDS[kind]}")
        if self.required and value == self.default:
            raise ConfigurationError(f"{called} must be given; it has no default")
        if self.choices and value not in self.choices:
            raise ConfigurationError(f"{called} is {shown(value)}, expected {self.choices!r}")
        if self.quantity is None or (self.unset is not None and value == self.unset):
            return value
        return self.quantity.checked(value, ConfigurationError, called)
