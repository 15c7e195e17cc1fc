"""Intended use of a calibration: Z motion of the scans to be corrected, and their accuracy."""

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import ConfigurationError
from omsm_ros.quantities import FREQUENCY, UNCERTAINTY

# Fewer samples have no spectrum.
_LEAST_SAMPLES = 16
# Bands of a spectrum in an octave: errors of a response change little within one.
_BANDS_PER_OCTAVE = 6
# Bands with a smaller share of the mean square speed are noise of the encoder.
_LEAST_SHARE = 1e-3
# Share of the mean square speed below the highest content of a motion.
_CONTENT = 0.999


@dataclass(frozen=True)
class IntendedUse:
    """The motion along Z of the scans that a calibration will correct.

    spectrum: frequency [Hz] and rms [m] of each component of Z; what moves over minutes counts
        as rest and is no part of it
    accuracy_m: asked for, of a height, k = 2 [m]; None where nothing is asked for

    Raises ConfigurationError for a spectrum without motion, or values that no machine has.
    """

    spectrum: tuple[tuple[float, ...], ...]
    accuracy_m: float | None = None

    # Twice this is the accuracy that limits are derived from where none is asked for: errors of
    # 5 nm on the scan are then harmless, a tenth of the figure of a good optical surface.
    UNASKED_ACCURACY_M: ClassVar[float] = 20e-9
    # An error of this share of the accuracy (k = 2) is half a standard uncertainty: it makes the
    # combined uncertainty larger by an eighth.
    HARMLESS_SHARE: ClassVar[float] = 0.25
    # Transients, and harmonics that a spectrum leaves out, reach some three times its content.
    BAND_OVER_CONTENT: ClassVar[float] = 10.0 / 3.0

    def __post_init__(self) -> None:
        if not self.spectrum or any(len(line) != 2 for line in self.spectrum):
            raise ConfigurationError("calibration.empty_spectrum")
        for frequency, rms in self.spectrum:
            FREQUENCY.checked(frequency, ConfigurationError, "frequency of the intended use")
            UNCERTAINTY.checked(rms, ConfigurationError, "rms of the intended use")
        if not self.speed_m_s > 0:
            raise ConfigurationError("calibration.empty_spectrum")
        if self.accuracy_m is not None:
            UNCERTAINTY.checked(self.accuracy_m, ConfigurationError, "accuracy")
            if not self.accuracy_m > 0:
                raise ConfigurationError("calibration.accuracy")

    @cached_property
    def frequencies_hz(self) -> FloatArray:
        """Frequencies of the spectrum (k,) [Hz]."""
        return np.array([frequency for frequency, _ in self.spectrum])

    @cached_property
    def rms_m(self) -> FloatArray:
        """Rms of Z at each frequency (k,) [m]."""
        return np.array([rms for _, rms in self.spectrum])

    @cached_property
    def speed_m_s(self) -> float:
        """Rms speed of Z [m/s]."""
        return float(np.sqrt(np.sum((2 * np.pi * self.frequencies_hz * self.rms_m) ** 2)))

    @property
    def harmless_delay_s(self) -> float:
        """Delay of Z [s] whose error on the scan is small against the accuracy asked for."""
        accuracy = self.UNASKED_ACCURACY_M if self.accuracy_m is None else self.accuracy_m
        return self.HARMLESS_SHARE * accuracy / self.speed_m_s

    @property
    def highest_hz(self) -> float:
        """Frequency [Hz] below which nearly all of the mean square speed lies."""
        order = np.argsort(self.frequencies_hz)
        speed = np.cumsum((self.frequencies_hz[order] * self.rms_m[order]) ** 2)
        place = int(np.searchsorted(speed, _CONTENT * speed[-1]))
        return float(self.frequencies_hz[order][place])

    @property
    def least_valid_up_to_hz(self) -> float:
        """Frequency [Hz] up to which a response must be known to be of use."""
        return self.BAND_OVER_CONTENT * self.highest_hz


def use_of_motion(
    z: FloatArray, sample_period: float, accuracy_m: float | None = None
) -> IntendedUse:
    """Return the intended use of a scan that moves as ``z`` (n,) [m], sampled evenly [s].

    The linear trend is taken out, and neighbouring frequencies are joined to bands that keep rms
    and speed. Raises ConfigurationError for a motion without samples or without movement.
    """
    if len(z) < _LEAST_SAMPLES or not np.all(np.isfinite(z)):
        raise ConfigurationError("calibration.empty_spectrum")
    slope = np.linspace(-1.0, 1.0, len(z))
    moved = z - np.mean(z) - slope * float(slope @ z) / float(slope @ slope)
    window = np.hanning(len(z))
    power = 2 * np.abs(np.fft.rfft(window * moved)) ** 2 / (len(z) * float(window @ window))
    frequency = np.fft.rfftfreq(len(z), sample_period)
    power, frequency = power[1:], frequency[1:]
    band = np.floor(_BANDS_PER_OCTAVE * np.log2(frequency / frequency[0])).astype(np.int64)
    in_band, speed = np.bincount(band, power), np.bincount(band, power * frequency**2)
    kept = speed > _LEAST_SHARE * np.sum(speed)
    mean = np.sqrt(speed[kept] / in_band[kept])
    pairs = zip(mean.tolist(), np.sqrt(in_band[kept]).tolist(), strict=True)
    return IntendedUse(tuple(pairs), accuracy_m)


# The paper's scan, 30 rpm over its mirror: harmonics of Z, rms weighted by area.
PAPER_USE = IntendedUse(((0.5, 22.3e-6), (1.0, 114.4e-6), (1.5, 4.4e-6)))
"""The default of the command where no scan is stated."""
