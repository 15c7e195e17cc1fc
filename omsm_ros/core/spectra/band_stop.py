"""A band taken out of a scan without moving what is left: forward and backward, so no phase."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import signal

from omsm_ros.core.samples.blocks import FloatArray, IntArray
from omsm_ros.errors import ConfigurationError

# Of each of the two passes; -3 dB each at the edges of the band, so -6 dB together.
_ORDER = 4
# From where on the ringing of an end is below a thousandth.
_RUNG_OUT = 1e-3


@dataclass(frozen=True, eq=False)
class BandStopped:
    """A scan without its band.

    removed: what was taken out (n,) [m];  rms_before, rms_after: of the heights without form [m]
    settling: how far from either end the filter still rings [s]
    frequency, response: of the two passes together (m,) [Hz], [1]; it is real, its phase zero
    """

    removed: FloatArray
    rms_before: float
    rms_after: float
    settling: float
    frequency: FloatArray
    response: FloatArray

    @property
    def rms_removed(self) -> float:
        """Of what was removed [m]."""
        return float(np.sqrt(np.mean(self.removed**2)))


def band_stop(
    sample: IntArray, values: FloatArray, period: float, bands: Sequence[tuple[float, float]]
) -> BandStopped:
    """Take ``bands`` (from, to) [Hz] out of ``values`` (n,) [m], the heights without form.

    sample: trigger counts (n,);  period: of the trigger [s]. Missing samples are bridged by
    straight lines, in the filter only. A Butterworth filter of fourth order runs forward and
    backward: its response is the square of the magnitude of one pass. Raises ConfigurationError
    for a band that is no band below half the rate.
    """
    count = int(sample[-1] - sample[0]) + 1
    even = np.interp(np.arange(count), sample - sample[0], values)
    kept, response = even, np.ones(2048)
    frequency = np.linspace(0.0, 0.5 / period, len(response))
    settling = 0.0
    for low, high in bands:
        sections = _sections(low, high, period)
        kept = signal.sosfiltfilt(sections, kept, padlen=min(count - 1, _padding(sections)))
        one = signal.freqz_sos(sections, 2 * np.pi * frequency * period)[1]
        response = response * abs(one) ** 2
        settling = max(settling, _padding(sections) * period)
    removed = (even - kept)[sample - sample[0]]
    return BandStopped(
        removed=removed,
        rms_before=float(np.std(values)),
        rms_after=float(np.std(values - removed)),
        settling=settling,
        frequency=frequency,
        response=response,
    )


def _sections(low: float, high: float, period: float) -> FloatArray:
    nyquist = 0.5 / period
    if not 0 < low < high < nyquist:
        raise ConfigurationError(
            f"band from {low!r} to {high!r} Hz cannot be stopped, expected 0 < from < to < "
            f"{nyquist:g} Hz, half the sampling rate"
        )
    return np.asarray(signal.butter(_ORDER, (low, high), "bandstop", fs=1 / period, output="sos"))


def _padding(sections: FloatArray) -> int:
    """Return the samples until an end has rung out, by the slowest pole."""
    poles = np.concatenate([np.roots(section[3:]) for section in sections])
    slowest = float(np.max(abs(poles)))
    return int(np.ceil(np.log(_RUNG_OUT) / np.log(min(slowest, 1 - 1e-9))))
