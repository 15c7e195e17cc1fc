"""Estimate the exposure of the probe from textures seen at several speeds, and undo it.

During an exposure T a texture of wavelength λ passes at speed v. Its amplitude falls to
``|sinc(T v / λ)|``, less at each speed. The spot averages across the part: it lowers a texture
alike at all speeds, so that amplitudes at several speeds do not show it, and it is declared.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from omsm_ros.core.ripple.ripple_guard import NamedLine
from omsm_ros.core.ripple.scan_signal import PATH, ScanSignal
from omsm_ros.core.ripple.source_hypotheses import ARTEFACT, PART, StudiedScan
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import ConfigurationError, Notice

# An exposure is as long as a few readings if the probe averages, and it is searched no further.
_MOST_PERIODS = 4.0
_STEPS, _FINE_STEPS = 4000, 1001
# Rise of χ² at the limits of k = 1, and the least one that excludes another exposure.
_ONE_SIGMA, _EXCLUDES = 1.0, 9.0
# Share of an amplitude below which it is not undone, as near a zero of sinc.
_LEAST_SHARE = 0.1
# Reduced χ² from which something else than the exposure is in the amplitudes.
_DOUBTFUL = 9.0
# Relative difference of the wavelengths of one texture, and samples that stand for a scan.
_SAME_WAVE, _MOST_SAMPLES = 0.02, 500


def exposure_share(passing: FloatArray, exposure: ArrayLike) -> FloatArray:
    """Return the share of an amplitude that ``exposure`` [s] leaves [1], of its shape.

    passing: frequency at which the texture passes, at samples of the scan (m,) [Hz]
    """
    return np.asarray(abs(np.mean(np.sinc(np.multiply.outer(exposure, passing)), axis=-1)))


def spot_share(wavelength: float, spot: float) -> float:
    """Return the share of an amplitude that a disc of diameter ``spot`` [m] leaves [1]."""
    place = np.pi * spot / wavelength
    return float(abs(2 * special.j1(place) / place)) if place else 1.0


@dataclass(frozen=True, eq=False)
class PassingTexture:
    """One texture in several scans: its frequency of passing [Hz], amplitude and σ [m] in each."""

    passing: Sequence[FloatArray]
    amplitude: FloatArray
    uncertainty: FloatArray


@dataclass(frozen=True, kw_only=True)
class Exposure:
    """Exposure of the probe.

    seconds, uncertainty: estimate and its standard uncertainty [s]
    longest: upper limit, k = 2 [s];  resolved: False if no exposure at all, or another, would do
    reduced_chi_squared: of the amplitudes, None without degrees of freedom
    declared: known instead of estimated
    """

    seconds: float
    uncertainty: float
    longest: float
    resolved: bool
    reduced_chi_squared: float | None = None
    declared: bool = False

    def finding(self) -> Notice:
        """Return what is known of the exposure."""
        if self.declared:
            return Notice("ripple.exposure_declared", seconds=self.seconds)
        if not self.resolved:
            return Notice("ripple.exposure_not_resolved", longest=self.longest)
        found = Notice("ripple.exposure", seconds=self.seconds, uncertainty=self.uncertainty)
        if (self.reduced_chi_squared or 0.0) < _DOUBTFUL:
            return found
        return Notice("ripple.exposure_doubtful", found=found, chi=self.reduced_chi_squared)

    def undone(
        self, passing: FloatArray, spot: float, wavelength: float, amplitude: float, sigma: float
    ) -> tuple[float, float] | None:
        """Return amplitude on the part and its σ [m]; None where it is unknown."""
        if not (self.resolved or self.declared):
            return None
        part = spot_share(wavelength, spot)
        share = part * float(exposure_share(passing, self.seconds))
        if share < _LEAST_SHARE:
            return None
        ends = exposure_share(
            passing, np.maximum(self.seconds + self.uncertainty * np.array([-1, 1]), 0.0)
        )
        on_part = amplitude / share
        return on_part, float(np.hypot(sigma / share, on_part * part * np.ptp(ends) / 2 / share))


def declared_exposure(seconds: float) -> Exposure:
    """Return an exposure that is known; ConfigurationError if it is negative."""
    if not 0 <= seconds < np.inf:
        raise ConfigurationError("ripple.bad_exposure", exposure=seconds)
    return Exposure(seconds=seconds, uncertainty=0.0, longest=seconds, resolved=True, declared=True)


def estimate_exposure(textures: Sequence[PassingTexture], period: float) -> Exposure | None:
    """Return the exposure that the amplitudes of ``textures`` show, None without two scans of one.

    period: from reading to reading [s]

    Each texture has an unknown amplitude on the part, for which the best value is taken at each
    trial. If χ² exceeds its degrees of freedom, the uncertainty is that much larger.
    """
    used = [t for t in textures if len(t.amplitude) > 1]
    if not used:
        return None
    trial = np.linspace(0.0, _MOST_PERIODS * period, _STEPS)
    misfit = _misfit(used, trial)
    best = int(np.argmin(misfit))
    spare = sum(len(t.amplitude) - 1 for t in used) - 1
    reduced = float(misfit[best] / spare) if spare > 0 else None
    unit = max(reduced or 1.0, 1.0)
    rise = (misfit - misfit[best]) / unit
    # A second minimum that the amplitudes do not exclude makes the estimate ambiguous.
    possible = np.flatnonzero(rise < _EXCLUDES)
    one_range = bool(np.all(np.diff(possible) == 1))
    ends = trial[np.flatnonzero(rise <= _ONE_SIGMA)[[0, -1]]] + np.array([-1, 1]) * trial[1]
    fine = np.linspace(max(ends[0], 0.0), ends[1], _FINE_STEPS)
    near = _misfit(used, fine)
    inside = fine[near - near.min() <= _ONE_SIGMA * unit]
    return Exposure(
        seconds=float(fine[np.argmin(near)]),
        uncertainty=float(np.ptp(inside)) / 2,
        longest=float(trial[np.flatnonzero(rise <= 4 * _ONE_SIGMA)[-1]] + trial[1]),
        resolved=bool(one_range and rise[0] >= _EXCLUDES and possible[-1] < _STEPS - 1),
        reduced_chi_squared=reduced,
    )


def _misfit(textures: Sequence[PassingTexture], trial: FloatArray) -> FloatArray:
    """Return χ² (k,) at each ``trial`` (k,) [s], with the best amplitudes on the part."""
    total = np.zeros(len(trial))
    for texture in textures:
        share = np.array([exposure_share(p, trial) for p in texture.passing])
        weight = 1 / texture.uncertainty[:, np.newaxis] ** 2
        wanted = texture.amplitude[:, np.newaxis]
        on_part = np.sum(weight * share * wanted, axis=0) / np.sum(weight * share**2, axis=0)
        total += np.sum(weight * (wanted - on_part * share) ** 2, axis=0)
    return total


def wavelength_of(row: NamedLine) -> float | None:
    """Return the wavelength along the path [m] of a line on the part or its image, else None."""
    along = row.line.possible.get(PATH)
    if row.kind == PART and along:
        return 1 / along
    return row.wavelength if row.kind == ARTEFACT else None


def passing_frequency(signal: ScanSignal, wavelength: float) -> FloatArray:
    """Return at which frequencies a texture passes in the course of a scan (m,) [Hz]."""
    speed = np.abs(np.diff(signal.path)) / np.diff(signal.sample) / signal.period
    return np.asarray(speed[:: max(len(speed) // _MOST_SAMPLES, 1)] / wavelength)


def passing_textures(
    scans: Sequence[tuple[StudiedScan, Sequence[NamedLine]]],
) -> list[PassingTexture]:
    """Return the textures of all scans, largest line of a scan first, by wavelength."""
    found: list[tuple[float, dict[int, NamedLine]]] = []
    for k, (_, named) in enumerate(scans):
        for row in sorted(named, key=lambda one: -one.line.amplitude):
            if (wave := wavelength_of(row)) is None or row.also:
                continue
            same = next((own for at, own in found if abs(wave / at - 1) < _SAME_WAVE), None)
            if same is None:
                found.append((wave, {k: row}))
            else:
                same.setdefault(k, row)
    return [
        PassingTexture(
            [passing_frequency(scans[k][0].signal, wave) for k in own],
            np.array([row.line.amplitude for row in own.values()]),
            np.array([row.line.amplitude_uncertainty for row in own.values()]),
        )
        for wave, own in found
    ]
