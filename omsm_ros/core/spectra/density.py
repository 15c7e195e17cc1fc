"""Power spectral density: over time or along the path, one-sided, Parseval holds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from omsm_ros.core.dynamics.discretisation_error import BLACKMAN_HARRIS
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.errors import DataError


@dataclass(frozen=True, eq=False)
class Density:
    """One-sided density, each array (m,).

    frequency: [Hz] over time, [1/m] along a path
    density: [m²/Hz] or [m³]; its sum times ``step`` is the mean square under ``window``
    """

    frequency: FloatArray
    density: FloatArray
    step: float

    def power(self, low: float, high: float) -> float:
        """Return the mean square between two frequencies, both included [m²]."""
        inside = (self.frequency >= low) & (self.frequency <= high)
        return float(np.sum(self.density[inside]) * self.step)


def window(count: int) -> FloatArray:
    """Return the window (n,), scaled to a mean square of one.

    Side lobes below 1e-9 of the power, so that millimetres of travel hide no nanometre.
    """
    phase = 2 * np.pi * np.arange(count) / count
    shape = sum(a * np.cos(k * phase) for k, a in enumerate(BLACKMAN_HARRIS))
    return np.asarray(shape / np.sqrt(np.mean(shape**2)))


def density(values: FloatArray, step: float) -> Density:
    """Return the density of ``values`` (n,) every ``step`` [s] or [m], as they are.

    ``Σ S(f) Δf = Σ (w x)² / n`` exactly, w the window. A line of amplitude a has the power a²/2,
    spread over the window's main lobe of ±4 bins. Take the mean out before. Raises DataError for
    fewer than 16 values.
    """
    count = len(values)
    if count < 16:
        raise DataError(f"spectrum of {count} values, expected 16 or more; record longer")
    power = abs(np.fft.rfft(values * window(count))) ** 2 * step / count
    # All frequencies but zero and Nyquist stand for their negative as well.
    power[1 : (count + 1) // 2] *= 2
    spacing = 1.0 / (count * step)
    return Density(np.asarray(np.arange(len(power)) * spacing), np.asarray(power), spacing)


def evenly(place: FloatArray, values: FloatArray, step: float) -> FloatArray:
    """Return values (n,) at increasing ``place`` (n,), linear in between, every ``step``.

    For looking at: where samples are further apart than ``step`` the fine part is not measured.
    """
    count = int((place[-1] - place[0]) / step) + 1
    return np.asarray(np.interp(place[0] + step * np.arange(count), place, values))


def smoothed(spectrum: Density, bins: int = 600) -> tuple[FloatArray, FloatArray]:
    """Return frequency and mean density in at most ``bins`` bands of equal ratio, for drawing."""
    used = spectrum.frequency > 0
    frequency, level = spectrum.frequency[used], spectrum.density[used]
    edges = np.geomspace(frequency[0], frequency[-1] * (1 + 1e-9), bins + 1)
    band = np.unique(np.searchsorted(frequency, edges[:-1]))
    band = band[band < len(frequency)]
    length = np.diff(np.r_[band, len(frequency)])
    mean = [np.add.reduceat(v, band) / length for v in (frequency, level)]
    return mean[0], mean[1]
