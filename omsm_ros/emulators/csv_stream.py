"""The sender of the six-channel stream as text, fed by the twin.

Imitated: counts with decimals, a sequence that wraps, the sender's own time, invalid readings,
and the faults of ``Instrument``.

Not imitated: overruns as ``halsampler`` reports them, other columns than the usual.
"""

from __future__ import annotations

import numpy as np

from omsm_ros.emulators.instrument import Instrument
from omsm_ros.emulators.sources import AXES, Measured
from omsm_ros.protocols.csv_stream import COLUMNS, encode_lines, row_dtype
from omsm_ros.protocols.generic_stream import StreamScaling
from omsm_ros.units import NANOMETRE_M


class CsvStreamEmulator(Instrument):
    """One line a trigger."""

    counter_range = 2**32
    _scaling = StreamScaling()

    def pack(self, measured: Measured, counters: np.ndarray, times_ns: np.ndarray) -> list[bytes]:
        """Return the line of each sample."""
        rows = np.zeros(len(measured), row_dtype(COLUMNS))
        rows["sequence"], rows["device_time"] = counters, times_ns
        rows["status"] = measured.status
        nothing = np.isnan(measured.distance)
        rows["distance"] = np.where(
            nothing, self._scaling.probe.invalid, measured.distance / NANOMETRE_M
        )
        for name in AXES:
            axis = getattr(self._scaling, name)
            rows[name] = measured.axes[name] * axis.counts_per_unit
        return encode_lines(rows)
