"""In what is a line periodic? Over time, path, radius, turns: how far each decides.

A scan at a steady pace cannot: its coordinates are proportional. Where the pace changes, a line
is sharp in its own coordinate only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from omsm_ros.core.ripple.density import noise_floor
from omsm_ros.core.ripple.scan_signal import PATH, RADIUS, TIME, TURN, ScanSignal
from omsm_ros.core.streams.blocks import FloatArray

# The Fourier sum of samples that are not evenly spaced.
#
# ``F(k Δν) = Σ_j y_j exp(-2πi k Δν u_j)`` by spreading each sample over a fine grid with a
# Kaiser-Bessel kernel, one FFT, and division by the kernel's transform (Greengard and Lee,
# SIAM Review 46, 2004; kernel of Fessler and Sutton, IEEE Trans. Signal Process. 51, 2003).

# Eight neighbours and twice the grid: an error of 1e-7 of the largest line.
_WIDTH = 8
_OVERSAMPLING = 2
_BETA = np.pi * np.sqrt((_WIDTH / _OVERSAMPLING * (_OVERSAMPLING - 0.5)) ** 2 - 0.8)


def fourier_sum(
    place: FloatArray, values: FloatArray, spacing: float, count: int
) -> NDArray[np.complex128]:
    """Return F at 0, ``spacing``, … (count,), of ``values`` (n,) at ``place`` (n,).

    spacing: Δν [1/unit of place], at most one over the range of ``place``
    """
    grid = _even(_OVERSAMPLING * 2 * count)
    position = (place - place[0]) * spacing * grid
    first = np.floor(position).astype(np.int64) - _WIDTH // 2 + 1
    total = np.zeros(grid)
    for offset in range(_WIDTH):
        cell = first + offset
        weight = _kernel(position - cell)
        total += np.bincount(cell % grid, values * weight, minlength=grid)
    spectrum = np.fft.rfft(total)[:count]
    # The sum started at place[0], not at zero; magnitudes do not care, phases are turned back.
    k = np.arange(count)
    turned = np.exp(-2j * np.pi * spacing * place[0] * k)
    return np.asarray(spectrum * turned / _kernel_transform(k / grid), np.complex128)


def _kernel(distance: FloatArray) -> FloatArray:
    inside = np.maximum(1 - (2 * distance / _WIDTH) ** 2, 0.0)
    return np.asarray(special.i0(_BETA * np.sqrt(inside)))


def _kernel_transform(frequency: FloatArray) -> FloatArray:
    """Return the transform of the kernel over grid cells, at ``frequency`` [1/cell]."""
    inside = np.sqrt(_BETA**2 - (np.pi * _WIDTH * frequency) ** 2)
    return np.asarray(_WIDTH * np.sinh(inside) / inside)


def _even(count: int) -> int:
    """Return the next power of two, for a fast transform."""
    return 1 << (count - 1).bit_length()


# Frequencies looked at in a resolution (one over the range): half-way between two that are one
# apart a line would lose 60 % of its power.
OVERSAMPLING = 2
# A coordinate that departs from proportion by less than this part of a wave is the same.
_SAME_WAVES = 0.05
# Of a spectrum over a coordinate that is not even: 8 MB.
_MOST_FREQUENCIES = 2**19
# Fewer waves are form or drift, not a line.
LEAST_WAVES = 5
# Samples that decide whether a line in one coordinate may be one in another.
_MOST_COMPARED = 4096
# So far from the mean pace, in resolutions, where a path is curved; at a quarter of one a line has
# 95 % of its power.
_SEARCHED_BINS, _STEPS_IN_A_BIN = 12, 4
# Less is no motion of an axis.
_LEAST_MOVED_M = 1e-9


@dataclass(frozen=True, eq=False)
class Coordinate:
    """One of them, over a scan.

    values: (n,);  pace: its mean speed [1/s of its unit]
    like: the coordinate to which it is proportional, so that a line in one is one in the other;
        its own name if there is none before it
    highest: frequency that is looked at
    """

    name: str
    values: FloatArray
    pace: float
    like: str
    highest: float

    @property
    def resolution(self) -> float:
        """One over its range."""
        return 1.0 / float(np.ptp(self.values))

    @property
    def proportional_to_time(self) -> bool:
        """True where the pace is steady."""
        return self.like == TIME


def coordinates_of(signal: ScanSignal) -> dict[str, Coordinate]:
    """Return those in which the scan has moved on, by name."""
    found: dict[str, Coordinate] = {}
    for name in (TIME, PATH, TURN, RADIUS):
        values = signal.coordinate(name)
        reach = float(np.ptp(values))
        least = {
            PATH: _LEAST_MOVED_M,
            RADIUS: max(1e-3 * float(signal.radius.max()), _LEAST_MOVED_M),
            TURN: 0.01,
        }
        if reach > least.get(name, 0.0):
            found[name] = _coordinate(signal, name, values, found)
    return found


def _coordinate(
    signal: ScanSignal, name: str, values: FloatArray, before: dict[str, Coordinate]
) -> Coordinate:
    pace = abs(float(np.polyfit(signal.time, values, 1)[0]))
    if name == TIME:
        return Coordinate(name, values, 1.0, TIME, signal.rate / 2)
    typical = float(np.median(abs(np.diff(values)) / np.diff(signal.sample)))
    nyquist = 0.5 / max(typical, float(np.ptp(values)) / _MOST_FREQUENCIES)
    for other in before.values():
        if other.like == other.name and _proportional(values, other.values) * nyquist < _SAME_WAVES:
            return Coordinate(name, values, pace, other.name, nyquist)
    return Coordinate(name, values, pace, name, nyquist)


def _proportional(values: FloatArray, other: FloatArray) -> float:
    """Return how far ``values`` departs from proportion to ``other``, in its own unit."""
    slope, start = np.polyfit(other - other[0], values, 1)
    return float(np.max(abs(values - slope * (other - other[0]) - start)))


def power_over(
    signal: ScanSignal, values: FloatArray, coordinate: Coordinate
) -> tuple[FloatArray, float]:
    """Return squared amplitudes of ``values`` (n,) at steps of a frequency, and that step.

    Over time it is the Fourier sum on the trigger's own grid; missing samples count as zero.
    """
    count = len(values)
    if coordinate.name == TIME:
        length = OVERSAMPLING * int(signal.sample[-1] + 1)
        even = np.zeros(length)
        even[signal.sample] = values
        spectrum = np.fft.rfft(even)
        spacing = signal.rate / length
    else:
        spacing = coordinate.resolution / OVERSAMPLING
        size = min(int(coordinate.highest / spacing), OVERSAMPLING * _MOST_FREQUENCIES)
        spectrum = fourier_sum(coordinate.values, values, spacing, max(size, 16))
    power = abs(spectrum) ** 2 * (2 / count) ** 2
    return np.asarray(power, np.float64), spacing


def floor_of(power: FloatArray) -> FloatArray:
    """Return the mean squared amplitude of noise at each frequency of :func:`power_over`."""
    return noise_floor(power, OVERSAMPLING)


def same_line(one: Coordinate, frequency: float, other: Coordinate) -> tuple[float, float]:
    """Return how much of the power of a line of ``one`` a line of ``other`` takes, and where.

    The share [1], largest over its frequencies, and that frequency, in the unit of ``other``;
    ``frequency`` in that of ``one``.
    """
    every = max(len(one.values) // _MOST_COMPARED, 1)
    phase = frequency * one.values[::every]
    place = other.values[::every] - np.mean(other.values)
    guess = float(place @ (phase - np.mean(phase)) / (place @ place))
    reach = _SEARCHED_BINS * _STEPS_IN_A_BIN
    step = other.resolution / _STEPS_IN_A_BIN
    tried = guess + step * np.arange(-reach, reach + 1)
    # From one frequency to the next every sample turns by the same angle.
    turning = np.exp(2j * np.pi * (phase - tried[0] * place))
    turn = np.exp(-2j * np.pi * step * place)
    share = np.empty(len(tried))
    for k in range(len(tried)):
        share[k] = abs(np.mean(turning)) ** 2
        turning = turning * turn
    best = int(np.argmax(share))
    return float(share[best]), abs(float(tried[best]))
