"""Emulated Micro-Epsilon controllers: confocalDT over RS-422 and Ethernet, capaNCDT.

It sends values and error values, blocks of several frames, counters of 32 bits (18 over RS-422)
and three encoders. It has the faults of ``Instrument``.

Not imitated: exposure control, several peaks, video signals, statistics, mathematics between
channels, linearisation, the command port.
"""

from functools import partial

import numpy as np

from omsm_ros.core.streams.blocks import Status
from omsm_ros.instruments.emulator import Instrument, Measured
from omsm_ros.instruments.emulator_factory import OWN_ENCODERS, TWIN_READING, Emulated, reference_in
from omsm_ros.instruments.micro_epsilon.protocol import (
    VALUE_BITS,
    MeasurementBlock,
    confocal_dtype,
    encode_block,
    encode_frames,
    values_of,
)
from omsm_ros.instruments.scaling import AXES, ProbeReading
from omsm_ros.instruments.six_channel.emulator import SCALES, SixChannelEmulator
from omsm_ros.twin.sensors import ReferenceSensor
from omsm_ros.units import NANOMETRE_M

# Frames in a block, which fit into a TCP packet.
_FRAMES = 30
_ORDER, _SERIAL = 2_418_004, 11_020_009
# Encoders 1 to 3, counter, time, intensity, value of peak 1.
_FLAGS = (7 << 8 | 1 << 11 | 1 << 12 | 1 << 15 | 1 << 18 | 1 << 19, 0)
_NO_PEAK = 0x7FFFFF04


class ConfocalDtSerialEmulator(Instrument):
    """Sends distance, intensity and counter over RS-422, or only the first ``width`` of them."""

    width = 3

    def pack(self, measured: Measured, counters: np.ndarray, times_ns: np.ndarray) -> list[bytes]:
        """Return a frame a sample."""
        raw = self._probe.raw(measured.distance)
        seen = np.where(measured.status == Status.NO_TARGET, np.nan, raw)
        columns = [
            values_of(seen, self._probe.full_scale),
            np.rint(measured.intensity * 1024).astype(np.int64),
            counters % 2**VALUE_BITS,
        ]
        wire = encode_frames(np.stack(columns[: self.width], axis=1))
        size = 3 * self.width
        return [wire[i : i + size] for i in range(0, len(wire), size)]


class ConfocalDtEmulator(Instrument):
    """Sends encoders 1 to 3, counter, time stamp, distance and intensity over Ethernet.

    wired: the axis on each encoder (0 = X … 4 = C)
    """

    wired = (0, 2, 4)

    def pack(self, measured: Measured, counters: np.ndarray, times_ns: np.ndarray) -> list[bytes]:
        """Return the blocks, each in the place of its first sample."""
        frames = np.zeros(len(measured), confocal_dtype(_FLAGS))
        for number, axis in enumerate(self.wired, start=1):
            counts = self._axes[axis].counts(measured.axes[AXES[axis]])
            frames[f"encoder {number}"] = (counts + 2**31) % 2**32 - 2**31
        frames["counter"] = counters
        frames["time"] = (times_ns // 1000) % 2**32
        raw = np.rint(np.nan_to_num(self._probe.raw(measured.distance)) / NANOMETRE_M)
        nothing = np.isnan(measured.distance) | (measured.status == Status.NO_TARGET)
        frames["distance 1"] = np.where(nothing, _NO_PEAK, raw)
        frames["intensity 1"] = np.rint(measured.intensity * 1024)
        return _blocks("confocal", _FLAGS, counters, frames)


class CapaNcdtEmulator(Instrument):
    """A capaNCDT 62xx with two channels, of which the first measures."""

    _KIND = (0b0101, 0)

    def pack(self, measured: Measured, counters: np.ndarray, times_ns: np.ndarray) -> list[bytes]:
        """Return the blocks, each in the place of its first sample."""
        frames = np.zeros(len(measured), [("channel 1", "<i4"), ("channel 2", "<i4")])
        share = np.nan_to_num(self._probe.raw(measured.distance) / self._probe.full_scale)
        frames["channel 1"] = np.rint(np.clip(share, 0, 1) * 0xFFFFFF)
        return _blocks("capacitive", self._KIND, counters, frames)


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
    partial(ConfocalDtSerialEmulator, probe=TWIN_READING),
    {"signals": "distance intensity counter", "trigger": "each", "probe.zero": TWIN_READING.zero},
    # RS-422 carries the distance alone, so the axes come from a device of their own.
    second=Emulated(SixChannelEmulator, {"device": "six_channel"} | SCALES, node="axis_driver"),
    baud_rate=691_200,
)
# Y and B stand still in the twin's motions: three encoders are enough.
ETHERNET = Emulated(
    partial(ConfocalDtEmulator, probe=TWIN_READING), OWN_ENCODERS | {"encoders": "XZC"}, tcp=True
)
# The capacitive reference, with the six-channel stream as the probe.
_CAPACITIVE_READING = ProbeReading(
    full_scale=2 * ReferenceSensor().half_range_m, zero=ReferenceSensor().half_range_m
)
CAPACITIVE = Emulated(
    SixChannelEmulator,
    {"device": "six_channel"} | SCALES,
    second=Emulated(
        partial(CapaNcdtEmulator, probe=_CAPACITIVE_READING),
        {"device": "capancdt", "triggered": True, "probe.zero": _CAPACITIVE_READING.zero},
        tcp=True,
        node="reference_driver",
        part=reference_in,
    ),
)
