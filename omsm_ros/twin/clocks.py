"""When each device takes its sample, against the instant that the trigger count stands for.

Not imitated: a counter that slips (see the emulators' faults), stamps of the computer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.twin.record_checks import check_numbers, is_default
from omsm_ros.units import PPM

# No draw of a normal distribution lies beyond this many sigma in a billion.
_JITTER_LIMIT = 7.0


class Instants(NamedTuple):
    """When the trigger, the encoders of Z and C, and the probe take their samples [s], (n,)."""

    trigger: FloatArray
    z: FloatArray
    c: FloatArray
    probe: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockErrors:
    """Times that are not what the trigger count says; nothing by default.

    trigger_jitter_s: rms, of all devices together;  probe_jitter_s: rms, of the probe alone
    probe_offset_s: the probe takes each sample so much later than its count says
    probe_drift_ppm: and its clock is so much slower, so that it falls behind
    z_latch_late_s, c_latch_late_s: the encoder is latched so much after the trigger
    """

    trigger_jitter_s: float = 0.0
    probe_jitter_s: float = 0.0
    probe_offset_s: float = 0.0
    probe_drift_ppm: float = 0.0
    z_latch_late_s: float = 0.0
    c_latch_late_s: float = 0.0

    def __post_init__(self) -> None:
        jitter = ("trigger_jitter_s", "probe_jitter_s")
        late = ("probe_offset_s", "z_latch_late_s", "c_latch_late_s")
        check_numbers(self, not_negative=jitter, lags=(*jitter, *late))

    @property
    def lag_s(self) -> float:
        """How much later than the reading the encoder of Z was looked at, at the start."""
        return self.z_latch_late_s - self.probe_offset_s

    def reach_s(self, duration: float) -> float:
        """Return how far a sample is taken from its nominal instant at most [s]."""
        jitter = _JITTER_LIMIT * (self.trigger_jitter_s + self.probe_jitter_s)
        late = max(abs(self.z_latch_late_s), abs(self.c_latch_late_s), abs(self.probe_offset_s))
        return jitter + late + abs(self.probe_drift_ppm) * PPM * duration

    def instants(self, time: FloatArray, random: np.random.Generator) -> Instants:
        """Return the instants of all devices for nominal ones ``time`` (n,) [s]."""
        if is_default(self):
            return Instants(time, time, time, time)
        together, alone = np.clip(random.normal(size=(2, len(time))), -_JITTER_LIMIT, _JITTER_LIMIT)
        trigger = time + self.trigger_jitter_s * together
        probe = trigger + self.probe_jitter_s * alone + self.probe_offset_s
        return Instants(
            trigger=trigger,
            z=trigger + self.z_latch_late_s,
            c=trigger + self.c_latch_late_s,
            probe=probe + self.probe_drift_ppm * PPM * time,
        )
