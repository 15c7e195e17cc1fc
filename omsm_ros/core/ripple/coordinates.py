"""Coordinates of a scan in which a line may be periodic: time, path, radius and turns.

In a scan at constant pace the coordinates are proportional and cannot be distinguished. Where the
pace changes, a line is sharp in its own coordinate only.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from omsm_ros.core.ripple.scan_signal import LEAST_TURN, PATH, RADIUS, TIME, TURN, ScanSignal
from omsm_ros.core.streams.blocks import FloatArray

# Width of the kernel and density of the grid, for an error of 1e-7 of the largest line.
_WIDTH = 8
_OVERSAMPLING = 2
_BETA = np.pi * np.sqrt((_WIDTH / _OVERSAMPLING * (_OVERSAMPLING - 0.5)) ** 2 - 0.8)

# Frequencies per resolution (one over the range); with one, a line in the middle between two would
# lose 60 % of its power.
OVERSAMPLING = 2
# Coordinates that differ by less than this part of a wave are proportional.
_SAME_WAVES = 0.01
# Frequencies over an uneven coordinate: 8 MB.
_MOST_FREQUENCIES = 2**19
# Fewer waves are form or drift.
LEAST_WAVES = 5
# Samples for the comparison of a line in two coordinates.
_MOST_COMPARED = 4096
# Range and step of the search on a curved path, in resolutions and steps of one; a quarter of a
# resolution off, a line has 95 % of its power.
_SEARCHED_BINS, _STEPS_IN_A_BIN = 12, 4
# A smaller range is no motion of an axis.
_LEAST_MOVED_M = 1e-9


def fourier_sum(
    place: FloatArray, values: FloatArray, spacing: float, count: int
) -> NDArray[np.complex128]:
    """Return ``F(k Δν) = Σ_j y_j exp(-2πi k Δν u_j)`` (count,) of values y at places u, each (n,).

    spacing: Δν [1/unit of place], at most one over the range of ``place``

    Each sample is spread over a fine grid with a Kaiser-Bessel kernel; the FFT is divided by the
    transform of the kernel (Greengard and Lee, SIAM Review 46, 2004; kernel of Fessler and Sutton,
    IEEE Trans. Signal Process. 51, 2003).
    """
    grid = 1 << (_OVERSAMPLING * 2 * count - 1).bit_length()  # a power of two is fast
    position = (place - place[0]) * spacing * grid
    first = np.floor(position).astype(np.int64) - _WIDTH // 2 + 1
    total = np.zeros(grid)
    for offset in range(_WIDTH):
        cell = first + offset
        inside = np.maximum(1 - (2 * (position - cell) / _WIDTH) ** 2, 0.0)
        weight = special.i0(_BETA * np.sqrt(inside))
        total += np.bincount(cell % grid, values * weight, minlength=grid)
    spectrum = np.fft.rfft(total)[:count]
    # The grid starts at place[0], so the phases are shifted back to zero.
    k = np.arange(count)
    turned = np.exp(-2j * np.pi * spacing * place[0] * k)
    # The transform of the kernel over grid cells.
    inside = np.sqrt(_BETA**2 - (np.pi * _WIDTH * k / grid) ** 2)
    return np.asarray(spectrum * turned / (_WIDTH * np.sinh(inside) / inside), np.complex128)


@dataclass(frozen=True, eq=False)
class Coordinate:
    """One coordinate over a scan.

    values: (n,);  pace: mean speed [unit/s];  highest: frequency that is searched [1/unit]
    like: the earlier coordinate to which it is proportional, or its own name
    """

    name: str
    values: FloatArray
    pace: float
    like: str
    highest: float

    @property
    def resolution(self) -> float:
        """One over the range of its values."""
        return 1.0 / float(np.ptp(self.values))

    @property
    def proportional_to_time(self) -> bool:
        """True where the pace is constant."""
        return self.like == TIME


def coordinates_of(signal: ScanSignal) -> dict[str, Coordinate]:
    """Return the coordinates in which the scan moves, by name."""
    found: dict[str, Coordinate] = {}
    around = max(1e-3 * float(signal.radius.max()), _LEAST_MOVED_M)
    for name, least in ((TIME, 0.0), (PATH, _LEAST_MOVED_M), (TURN, LEAST_TURN), (RADIUS, around)):
        values = np.asarray(getattr(signal, name), np.float64)
        if np.ptp(values) > least:
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
        away = other.values - other.values[0]
        line = np.polyval(np.polyfit(away, values, 1), away)
        if other.like == other.name and np.max(abs(values - line)) * nyquist < _SAME_WAVES:
            return Coordinate(name, values, pace, other.name, nyquist)
    return Coordinate(name, values, pace, name, nyquist)


def power_over(
    signal: ScanSignal, values: FloatArray, coordinate: Coordinate
) -> tuple[FloatArray, float]:
    """Return squared amplitudes of ``values`` (n,) at equally spaced frequencies, and their step.

    Over time this is the FFT on the grid of the trigger; missing samples count as zero.
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
        size = max(int(coordinate.highest / spacing), 16)
        spectrum = fourier_sum(coordinate.values, values, spacing, size)
    power = abs(spectrum) ** 2 * (2 / count) ** 2
    return np.asarray(power, np.float64), spacing


def magnitudes(values: np.ndarray, place: FloatArray, frequencies: np.ndarray) -> FloatArray:
    """Return ``|Σ_j y_j exp(-2πi f u_j)|`` (k,) of values y at places u, at even ``frequencies``.

    From one frequency to the next each value turns by a constant angle.
    """
    turning = values * np.exp(-2j * np.pi * frequencies[0] * place)
    turn = np.exp(-2j * np.pi * (frequencies[1] - frequencies[0]) * place)
    found = np.empty(len(frequencies))
    for k in range(len(frequencies)):
        found[k] = abs(np.sum(turning))
        turning = turning * turn
    return found


def same_line(one: Coordinate, frequency: float, other: Coordinate) -> tuple[float, float]:
    """Return the share of the power of a line in ``one`` that a line in ``other`` has, and where.

    The share [1] is the largest over the frequencies [1/unit of other]; ``frequency``: of the line
    in ``one``.
    """
    every = max(len(one.values) // _MOST_COMPARED, 1)
    phase = frequency * one.values[::every]
    place = other.values[::every] - np.mean(other.values)
    guess = float(place @ (phase - np.mean(phase)) / (place @ place))
    reach = _SEARCHED_BINS * _STEPS_IN_A_BIN
    step = other.resolution / _STEPS_IN_A_BIN
    tried = guess + step * np.arange(-reach, reach + 1)
    share = (magnitudes(np.exp(2j * np.pi * phase), place, tried) / len(place)) ** 2
    best = int(np.argmax(share))
    return float(share[best]), abs(float(tried[best]))
