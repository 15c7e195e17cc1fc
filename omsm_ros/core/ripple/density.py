"""One-sided power spectral density, its noise floor, band-stop filter and alias frequencies."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy  # whose parts are loaded when they are used
from numpy.typing import ArrayLike

from omsm_ros.core.lti.discretisation import DigitalFilter
from omsm_ros.core.streams.blocks import FloatArray, IntArray
from omsm_ros.errors import ConfigurationError, DataError

# Order of each of the two passes of the band-stop filter; together -6 dB at the edges.
_ORDER = 4
# Amplitude at which the transient at an end counts as decayed.
_RUNG_OUT = 1e-3
# The power of noise at one frequency is exponentially distributed.
_MEDIAN_OVER_MEAN = float(np.log(2))
# Frequencies to either side of a median: 24 powers give it to 30 %, 800 to 5 %.
_NARROWEST, _WIDEST = 12, 400
# Half-width over frequency: noise that falls with its square changes fourfold within an octave.
_RELATIVE_WIDTH = 0.25
# Medians over a logarithmic grid; 3.5 % apart for a million frequencies.
_BANDS = 400
# Logarithm of a probability below which rounding of 1 - p matters.
_RARE = -30.0
# Zero power has no logarithm.
_LEAST_RATIO = 1e-15


@dataclass(frozen=True, eq=False)
class Density:
    """One-sided density, each array (m,).

    frequency: [Hz] over time, [1/m] along a path
    density: [m²/Hz] or [m³]; its sum times ``step`` is the mean square under the window
    """

    frequency: FloatArray
    density: FloatArray
    step: float

    def power(self, low: float, high: float) -> float:
        """Return the mean square between two frequencies, both included [m²]."""
        inside = (self.frequency >= low) & (self.frequency <= high)
        return float(np.sum(self.density[inside]) * self.step)


def density(values: FloatArray, step: float) -> Density:
    """Return the density of ``values`` (n,) every ``step`` [s] or [m], with their mean.

    ``Σ S(f) Δf = Σ (w x)² / Σ w²`` exactly, with a Blackman-Harris window w, whose side lobes below
    1e-9 of the power separate nanometres from millimetres of travel. A line of amplitude a has the
    power a²/2, spread over the main lobe of ±4 bins. Raises DataError for fewer than 16 values.
    """
    count = len(values)
    if count < 16:
        raise DataError("ripple.short_spectrum", count=count, least=16)
    frequency, power = scipy.signal.periodogram(values, 1 / step, "blackmanharris", detrend=False)
    return Density(frequency, power, 1 / (count * step))


def evenly(place: FloatArray, values: FloatArray, step: float) -> FloatArray:
    """Return values (n,) at increasing ``place`` (n,), interpolated linearly to every ``step``."""
    count = int((place[-1] - place[0]) / step) + 1
    return np.asarray(np.interp(place[0] + step * np.arange(count), place, values))


def smoothed(spectrum: Density, bins: int = 600) -> tuple[FloatArray, FloatArray]:
    """Return frequency and mean density in at most ``bins`` bands of equal ratio, for plots."""
    used = spectrum.frequency > 0
    frequency, level = spectrum.frequency[used], spectrum.density[used]
    edges = np.geomspace(frequency[0], frequency[-1] * (1 + 1e-9), bins + 1)
    band = np.unique(np.searchsorted(frequency, edges[:-1]))
    band = band[band < len(frequency)]
    length = np.diff(np.r_[band, len(frequency)])
    mean = [np.add.reduceat(v, band) / length for v in (frequency, level)]
    return mean[0], mean[1]


@dataclass(frozen=True, eq=False)
class BandStopped:
    """Result of a band-stop filter.

    removed: part of the heights (n,) [m];  rms_before, rms_after: of the heights without form [m]
    settling: duration of the transient at either end [s]
    frequency, response: of both passes together (m,) [Hz], [1], with zero phase
    """

    removed: FloatArray
    rms_before: float
    rms_after: float
    settling: float
    frequency: FloatArray
    response: FloatArray

    @property
    def rms_removed(self) -> float:
        """Root mean square of the removed part [m]."""
        return float(np.sqrt(np.mean(self.removed**2)))


def band_stop(
    sample: IntArray, values: FloatArray, period: float, bands: Sequence[tuple[float, float]]
) -> BandStopped:
    """Remove ``bands`` (from, to) [Hz] from ``values`` (n,) [m], the heights without form.

    sample: trigger counts (n,);  period: of the trigger [s]

    A Butterworth filter of fourth order runs forward and backward, so that its phase is zero. It
    interpolates missing samples. Raises ConfigurationError for a band beyond half the rate.
    """
    count = int(sample[-1] - sample[0]) + 1
    even = np.interp(np.arange(count), sample - sample[0], values)
    kept, response = even, np.ones(2048)
    frequency = np.linspace(0.0, 0.5 / period, len(response))
    settling = 0.0
    for low, high in bands:
        if not 0 < low < high < frequency[-1]:
            raise ConfigurationError("ripple.stop_band", low=low, high=high, nyquist=frequency[-1])
        sections = scipy.signal.butter(_ORDER, (low, high), "bandstop", fs=1 / period, output="sos")
        slowest = float(np.max(abs(DigitalFilter(sections, period).poles)))
        padding = int(np.ceil(np.log(_RUNG_OUT) / np.log(min(slowest, 1 - 1e-9))))
        kept = scipy.signal.sosfiltfilt(sections, kept, padlen=min(count - 1, padding))
        one = scipy.signal.freqz_sos(sections, 2 * np.pi * frequency * period)[1]
        response = response * abs(one) ** 2
        settling = max(settling, padding * period)
    removed = (even - kept)[sample - sample[0]]
    return BandStopped(
        removed=removed,
        rms_before=float(np.std(values)),
        rms_after=float(np.std(values - removed)),
        settling=settling,
        frequency=frequency,
        response=response,
    )


def noise_floor(power: FloatArray, oversampling: int = 1) -> FloatArray:
    """Return the mean power of the noise at each frequency (m,), from running medians.

    power: at equally spaced frequencies from zero (m,);  oversampling: frequencies per resolution
    """
    count = len(power)
    narrow, broad = _NARROWEST * oversampling, _WIDEST * oversampling
    centres = np.unique(np.geomspace(1, count, _BANDS).astype(np.int64)) - 1
    even = np.arange(0, count, max(broad // 2, 1))
    centres = np.unique(np.r_[0, centres, even, count - 1])
    half = np.clip(_RELATIVE_WIDTH * centres, narrow, broad).astype(np.int64)
    low, high = np.maximum(centres - half, 0), np.minimum(centres + half + 1, count)
    level = np.empty(len(centres))
    for place, (first, end) in enumerate(zip(low, high, strict=True)):
        middle = (end - first - 1) // 2, (end - first) // 2
        ordered = np.partition(power[first:end], middle)  # np.median checks it for longer
        level[place] = (ordered[middle[0]] + ordered[middle[1]]) / 2
    tiny = np.finfo(float).tiny
    logs = np.interp(np.arange(count), centres, np.log(np.maximum(level, tiny)))
    return np.asarray(np.exp(logs) / _MEDIAN_OVER_MEAN)


def significance(ratio: FloatArray, tried: float) -> FloatArray:
    """Return the significance of a line [σ], of the shape of ``ratio``.

    ratio: power of the line over the mean power of noise at one frequency
    tried: number of independent frequencies searched

    The probability of such a line from noise alone, ``1 - (1 - exp(-ratio))^tried``, as the
    quantile of the normal distribution, one-sided.
    """
    power, tried = np.asarray(ratio, np.float64), max(tried, 1.0)
    # A small probability is ``tried`` times that of one frequency, without loss by rounding.
    small = np.log(tried) - power
    none = tried * np.log1p(-np.exp(-np.clip(power, _LEAST_RATIO, np.log(tried) - _RARE)))
    log_any = np.where(small < _RARE, small, np.log(-np.expm1(none)))
    return np.asarray(-scipy.special.ndtri_exp(log_any))


def ratio_at(sigma: float, tried: float) -> float:
    """Return the ratio of powers with a significance of ``sigma``, the inverse of the above."""
    tried, log_any = max(tried, 1.0), float(scipy.special.log_ndtr(-sigma))
    if log_any < _RARE:
        return float(np.log(tried)) - log_any
    return -float(np.log(-np.expm1(scipy.special.log_ndtr(sigma) / tried)))


def aliased_frequency(frequency: ArrayLike, sample_rate: float) -> FloatArray:
    """Return the alias [Hz] of ``frequency`` [Hz] sampled at ``sample_rate`` [Hz], of its shape.

    ``|f - fs · NINT(f / fs)|`` with halves rounded up, as in the paper.
    """
    if not sample_rate > 0:
        raise DataError("ripple.sample_rate", rate=sample_rate)
    f = np.asarray(frequency, np.float64)
    return np.abs(f - sample_rate * np.floor(f / sample_rate + 0.5))
