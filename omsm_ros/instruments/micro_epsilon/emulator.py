"""Emulated Micro-Epsilon controllers: confocalDT over RS-422 and Ethernet, capaNCDT.

It sends values and error values, blocks of several frames, counters of 32 bits (18 over RS-422)
and three encoders. It rounds or refuses rates, has the echo and prompt of the command port, and
the faults of ``Instrument``.

Not imitated: exposure control, several peaks, video signals, statistics, mathematics between
channels, linearisation, most commands (they are answered as unknown).
"""

from functools import partial
from typing import Any

import numpy as np

from omsm_ros.core.streams.blocks import Status
from omsm_ros.instruments.emulator import AXIS_SCALING, Instrument, InstrumentLink, Measured, Source
from omsm_ros.instruments.emulator_factory import (
    OWN_ENCODERS,
    TWIN_READING,
    Emulated,
    SecondDevice,
    reference_in,
)
from omsm_ros.instruments.micro_epsilon.protocol import (
    VALUE_BITS,
    MeasurementBlock,
    confocal_dtype,
    encode_block,
    encode_frames,
    values_of,
)
from omsm_ros.instruments.scaling import AXES, AxisScaling, ProbeReading
from omsm_ros.instruments.six_channel.emulator import SCALES, SixChannelEmulator
from omsm_ros.twin.sensors import ReferenceSensor
from omsm_ros.units import MICROSECOND_S, NANOMETRE_M

# Frames in a block, which fit into a TCP packet.
_FRAMES = 30
_ORDER, _SERIAL = 2_418_004, 11_020_009
# Encoders 1 to 3, counter, time, intensity, value of peak 1.
_FLAGS = (7 << 8 | 1 << 11 | 1 << 12 | 1 << 15 | 1 << 18 | 1 << 19, 0)
_NO_PEAK = 0x7FFFFF04
_RATES_KHZ = (0.1, 0.2, 0.3, 1, 2.5, 5, 10, 25, 50, 70)
_SAMPLE_STEP_US = 4


class Controller(Instrument):
    """A controller with a second line for commands."""

    counter_range = 2**32

    def __init__(
        self,
        line: InstrumentLink,
        source: Source | None = None,
        *,
        probe: ProbeReading | None = None,
        commands: InstrumentLink | None = None,
        **options: Any,
    ) -> None:
        self._probe = probe or ProbeReading()
        self._commands = commands
        self._typed = b""
        super().__init__(line, source, **options)

    def reset(self) -> None:
        """Go back to the settings after switching on."""
        self._period = 1e-3
        self._typed = b""

    def rate(self) -> float:
        """Return samples per second as set."""
        return super().rate() if self._triggered else 1 / self._period

    def obey(self, line: str) -> str:
        """Return the answer to a command, prompt included."""
        raise NotImplementedError

    def work(self) -> None:
        """Answer the commands that arrived."""
        if self._commands is None:
            return
        typed = self._typed + self._commands.read()
        *lines, self._typed = typed.replace(b"\r", b"\n").split(b"\n")
        for line in lines:
            if line:
                self._commands.write(self.obey(line.decode("latin-1").strip()).encode())


class ConfocalDtSerialEmulator(Controller):
    """Sends distance, intensity and counter over RS-422, or only the first of them."""

    def __init__(self, *arguments: object, width: int = 1, **options: object) -> None:
        """width: values in a frame, 1 to 3."""
        self._width = width
        super().__init__(*arguments, **options)  # type: ignore[arg-type]

    def pack(self, measured: Measured, counters: np.ndarray, times_ns: np.ndarray) -> list[bytes]:
        """Return a frame a sample."""
        raw = self._probe.raw(measured.distance)
        seen = np.where(measured.status == Status.NO_TARGET, np.nan, raw)
        columns = [
            values_of(seen, self._probe.full_scale),
            np.rint(measured.intensity * 1024).astype(np.int64),
            counters % 2**VALUE_BITS,
        ]
        wire = encode_frames(np.stack(columns[: self._width], axis=1))
        size = 3 * self._width
        return [wire[i : i + size] for i in range(0, len(wire), size)]


class ConfocalDtEmulator(Controller):
    """Sends encoders 1 to 3, counter, time stamp, distance and intensity over Ethernet.

    wired: the axis on each encoder (0 = X … 4 = C)
    """

    def __init__(
        self,
        *arguments: object,
        axes: tuple[AxisScaling, ...],
        wired: tuple[int, int, int] = (0, 2, 4),
        **options: object,
    ) -> None:
        self._axes, self._wired = axes, wired
        super().__init__(*arguments, **options)  # type: ignore[arg-type]

    def pack(self, measured: Measured, counters: np.ndarray, times_ns: np.ndarray) -> list[bytes]:
        """Return the blocks, each in the place of its first sample."""
        frames = np.zeros(len(measured), confocal_dtype(_FLAGS))
        for number, axis in enumerate(self._wired, start=1):
            counts = self._axes[axis].counts(measured.axes[AXES[axis]])
            frames[f"encoder {number}"] = (counts + 2**31) % 2**32 - 2**31
        frames["counter"] = counters
        frames["time"] = (times_ns // 1000) % 2**32
        raw = np.rint(np.nan_to_num(self._probe.raw(measured.distance)) / NANOMETRE_M)
        nothing = np.isnan(measured.distance) | (measured.status == Status.NO_TARGET)
        frames["distance 1"] = np.where(nothing, _NO_PEAK, raw)
        frames["intensity 1"] = np.rint(measured.intensity * 1024)
        return _blocks("confocal", _FLAGS, counters, frames)

    def obey(self, line: str) -> str:
        """Return the answer to a command, prompt included."""
        words = line.split()
        if words[0] == "GETINFO":
            return f"{line}\r\nName: IFC2451\r\nSerial: {_SERIAL}\r\nArticle: {_ORDER}\r\n->"
        if words[0] == "MEASRATE" and len(words) == 2:
            if float(words[1]) not in _RATES_KHZ:
                return f"{line}\r\nE06 Parameter out of range\r\n->"
            self._period = 1e-3 / float(words[1])
            return f"{line}\r\n->"
        if words[0] == "MEASRATE":
            return f"{line}\r\nMEASRATE {1e-3 / self._period:g}\r\n->"
        return f"{line}\r\nE01 Unknown command\r\n->"


class CapaNcdtEmulator(Controller):
    """A capaNCDT 62xx with two channels, of which the first measures."""

    _KIND = (0b0101, 0)

    def pack(self, measured: Measured, counters: np.ndarray, times_ns: np.ndarray) -> list[bytes]:
        """Return the blocks, each in the place of its first sample."""
        frames = np.zeros(len(measured), [("channel 1", "<i4"), ("channel 2", "<i4")])
        share = np.nan_to_num(self._probe.raw(measured.distance) / self._probe.full_scale)
        frames["channel 1"] = np.rint(np.clip(share, 0, 1) * 0xFFFFFF)
        return _blocks("capacitive", self._KIND, counters, frames)

    def obey(self, line: str) -> str:
        """Return the answer to a command, prompt included."""
        if line == "$VER":
            return "$VERDT6230;V1.2a;8010074OK\r\n"
        if line.startswith("$STI") and line[4:].isdecimal():
            step = max(1, round(int(line[4:]) / _SAMPLE_STEP_US)) * _SAMPLE_STEP_US
            self._period = step * MICROSECOND_S
            return f"{line},{step}OK\r\n"
        if line.startswith("$TRG"):
            return f"{line}OK\r\n"
        return f"{line}$UNKNOWN COMMAND\r\n"


def _blocks(
    form: str, kind: tuple[int, int], counters: np.ndarray, frames: np.ndarray
) -> list[bytes]:
    pieces = [b""] * len(frames)
    raw = frames.view(np.uint8).reshape(len(frames), frames.dtype.itemsize)
    # A counter that starts again begins a new block.
    anew = np.flatnonzero(np.diff(counters) != 1) + 1
    starts = sorted({*range(0, len(frames), _FRAMES), *anew.tolist()})
    for start, end in zip(starts, [*starts[1:], len(frames)], strict=True):
        block = MeasurementBlock(_ORDER, _SERIAL, kind, int(counters[start]), raw[start:end])
        pieces[start] = encode_block(form, block)
    return pieces


SERIAL = Emulated(
    partial(ConfocalDtSerialEmulator, probe=TWIN_READING, width=3),
    {"signals": "distance intensity counter", "trigger": "each", "probe.zero": TWIN_READING.zero},
    # RS-422 carries the distance alone, so the axes come from a device of their own.
    second=SecondDevice("axis_driver", SixChannelEmulator, {"device": "six_channel"} | SCALES),
    baud_rate=691_200,
)
# Y and B stand still in the twin's motions: three encoders are enough.
ETHERNET = Emulated(
    partial(ConfocalDtEmulator, probe=TWIN_READING, axes=AXIS_SCALING),
    OWN_ENCODERS | {"encoders": "XZC"},
    tcp=True,
)
# The capacitive reference, with the six-channel stream as the probe.
_CAPACITIVE_READING = ProbeReading(
    full_scale=2 * ReferenceSensor().half_range_m, zero=ReferenceSensor().half_range_m
)
CAPACITIVE = Emulated(
    SixChannelEmulator,
    {"device": "six_channel"} | SCALES,
    second=SecondDevice(
        "reference_driver",
        partial(CapaNcdtEmulator, probe=_CAPACITIVE_READING),
        {"device": "capancdt", "triggered": True, "probe.zero": _CAPACITIVE_READING.zero},
        reference_in,
        tcp=True,
    ),
)
