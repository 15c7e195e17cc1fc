"""Senders of the six-channel stream, binary and text, fed by the twin.

Imitated: quantisation to counts and whole nanometres, the probe's status, a sequence that wraps,
the sender's own clock, and the faults of ``Instrument``.

Not imitated: resolution of the sender's clock, overruns as ``halsampler`` reports them, commands.
"""

import numpy as np

from omsm_ros.instruments.emulator import Instrument, Measured
from omsm_ros.instruments.emulator_factory import Emulated
from omsm_ros.instruments.scaling import AXES
from omsm_ros.instruments.six_channel.protocol import (
    COLUMNS,
    ENCODED_SIZE,
    FRAME,
    StreamScaling,
    encode_frames,
    encode_lines,
    row_dtype,
)
from omsm_ros.units import NANOMETRE_M


class SixChannelEmulator(Instrument):
    """Sends one frame a trigger."""

    _scaling = StreamScaling()

    def pack(self, measured: Measured, counters: np.ndarray, times_ns: np.ndarray) -> list[bytes]:
        """Return the frame of each sample."""
        frames = np.zeros(len(measured), FRAME)
        frames["sequence"], frames["device_time"] = counters, times_ns
        frames["status"] = measured.status
        frames["distance"] = self._scaling.probe.counts(measured.distance)
        for i, (name, axis) in enumerate(zip(AXES, self._scaling.axes, strict=True)):
            frames["counts"][:, i] = axis.counts(measured.axes[name])
        wire = encode_frames(frames)
        return [wire[i : i + ENCODED_SIZE] for i in range(0, len(wire), ENCODED_SIZE)]


class CsvStreamEmulator(Instrument):
    """Sends one line a trigger."""

    _scaling = StreamScaling()

    def pack(self, measured: Measured, counters: np.ndarray, times_ns: np.ndarray) -> list[bytes]:
        """Return the line of each sample."""
        rows = np.zeros(len(measured), row_dtype(COLUMNS))
        rows["sequence"], rows["device_time"] = counters, times_ns
        rows["status"] = measured.status
        distance, invalid = measured.distance / NANOMETRE_M, self._scaling.probe.invalid
        rows["distance"] = np.where(np.isnan(distance), invalid, distance)
        for name in AXES:
            axis = getattr(self._scaling, name)
            rows[name] = measured.axes[name] * axis.counts_per_unit
        return encode_lines(rows)


SCALES: dict[str, object] = {
    f"{name}.counts_per_unit": axis.counts_per_unit
    for name, axis in zip(AXES, StreamScaling().axes, strict=True)
}
"""Parameters with which a driver reads these senders."""

BINARY = Emulated(SixChannelEmulator, SCALES)
TEXT = Emulated(CsvStreamEmulator, SCALES)
