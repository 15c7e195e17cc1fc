"""Spectral lines and their joint fit of frequency, cosine and sine by Gauss-Newton."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from omsm_ros.core.ripple.coordinates import Coordinate, magnitudes, same_line
from omsm_ros.core.ripple.scan_signal import PATH, ScanSignal
from omsm_ros.core.streams.blocks import FloatArray

CLOSEST = 0.6
"""Least distance of two lines in resolutions; closer ones cannot be separated."""

# From a start a quarter of a resolution off, two lines one resolution apart converge to 1e-9 of a
# resolution in four steps, to 0.003 in three.
_FITTING_STEPS = 4
# Frequencies to either side that are tried for a known texture.
_MOST_TRIED = 200
# Samples at a time: forty lines of three columns are 31 MB.
_CHUNK = 32_768
# Share of power in another coordinate from which that coordinate is tried. Without the trial, 2 of
# 113 lines of six random mixtures are classified wrongly and 5 are none.
_LIKE = 0.25


@dataclass(frozen=True, slots=True, kw_only=True)
class SpectralLine:
    """Line ``cosine · cos(2π f u) + sine · sin(2π f u)`` over a coordinate u of the scan.

    coordinate: in which it is sharpest;  frequency, frequency_uncertainty (k = 1): there [1/unit]
    amplitude_uncertainty: of cosine and sine, from the noise floor at the line [m]
    significance: [σ], see :func:`omsm_ros.core.ripple.density.significance`
    possible: frequency in each coordinate in which it may be a line
    """

    coordinate: str
    frequency: float
    cosine: float
    sine: float
    frequency_uncertainty: float = 0.0
    amplitude_uncertainty: float = 0.0
    significance: float = 0.0
    possible: dict[str, float] = field(default_factory=dict)

    @property
    def amplitude(self) -> float:
        """Amplitude, half of peak to valley [m]."""
        return float(np.hypot(self.cosine, self.sine))


def texture(
    signal: ScanSignal, values: FloatArray, frequency: float, spread: float
) -> SpectralLine:
    """Return the strongest line along the path within ``spread`` of ``frequency`` [1/m]."""
    place = signal.path - float(np.mean(signal.path))
    step = 0.5 / float(np.ptp(place))
    reach = min(int(spread / step) + 1, _MOST_TRIED)
    tried = frequency + step * np.arange(-reach, reach + 1)
    best = float(tried[np.argmax(magnitudes(values, place, tried))])
    return SpectralLine(coordinate=PATH, frequency=best, cosine=0.0, sine=0.0)


def start(coordinate: Coordinate, frequency: float, values: FloatArray) -> SpectralLine:
    """Return a start for a fit from the Fourier sum of ``values`` (n,) at ``frequency``."""
    phase = np.exp(-2j * np.pi * frequency * coordinate.values)
    mean = 2 * complex(values @ phase) / len(values)
    return SpectralLine(
        coordinate=coordinate.name, frequency=frequency, cosine=mean.real, sine=-mean.imag
    )


def fitted(
    lines: list[SpectralLine], coordinates: dict[str, Coordinate], values: FloatArray
) -> list[SpectralLine]:
    """Fit all ``lines`` together to ``values`` (n,): amplitudes first, then frequencies as well."""
    if not lines:
        return []
    lines = _stepped(lines, coordinates, values, turning=False)
    for _ in range(_FITTING_STEPS):
        lines = _apart(_stepped(lines, coordinates, values, turning=True), coordinates)
    return _stepped(lines, coordinates, values, turning=False)


def in_their_coordinates(
    lines: list[SpectralLine],
    new: Sequence[SpectralLine],
    coordinates: dict[str, Coordinate],
    residual: FloatArray,
) -> list[SpectralLine]:
    """Return all lines, each ``new`` one in the coordinate that leaves the smallest residual.

    Where the pace hardly changes, the grid of a spectrum may favour the wrong coordinate.
    """

    def place(line: SpectralLine) -> tuple[str, int]:
        return line.coordinate, round(line.frequency / coordinates[line.coordinate].resolution / 4)

    places, chosen = {place(line) for line in new}, []
    for line in lines:
        if place(line) in places:
            whole = residual + sum_of([line], coordinates, len(residual))
            line = _best_version(line, coordinates, whole)
        chosen.append(line)
    return chosen


def _best_version(
    line: SpectralLine, coordinates: dict[str, Coordinate], values: FloatArray
) -> SpectralLine:
    own = coordinates[line.coordinate]
    versions = [line]
    for name, other in coordinates.items():
        if other.like != name or other.like == own.like:
            continue
        share, frequency = same_line(own, line.frequency, other)
        if share > _LIKE:
            versions += fitted([start(other, frequency, values)], coordinates, values)
    left = [values - sum_of([one], coordinates, len(values)) for one in versions]
    return versions[int(np.argmin([float(r @ r) for r in left]))]


def waves_of(
    lines: Sequence[SpectralLine], coordinates: dict[str, Coordinate]
) -> Callable[[np.ndarray], FloatArray]:
    """Return a function that gives cosine and sine of each line at samples (m,), (m, 2 · lines)."""

    def waves(chosen: np.ndarray) -> FloatArray:
        columns: list[FloatArray] = []
        for line in lines:
            place = coordinates[line.coordinate].values[chosen]
            columns += _columns(line, place, 0.0, turning=False)
        return np.column_stack(columns)

    return waves


def _apart(lines: list[SpectralLine], coordinates: dict[str, Coordinate]) -> list[SpectralLine]:
    kept: list[SpectralLine] = []
    for line in sorted(lines, key=lambda one: -one.amplitude):
        bin_ = coordinates[line.coordinate].resolution
        if all(
            k.coordinate != line.coordinate or abs(k.frequency - line.frequency) > CLOSEST * bin_
            for k in kept
        ):
            kept.append(line)
    return kept


def _columns(
    line: SpectralLine, place: FloatArray, middle: float, turning: bool
) -> list[FloatArray]:
    phase = 2 * np.pi * line.frequency * place
    cosine, sine = np.cos(phase), np.sin(phase)
    if not turning:
        return [cosine, sine]
    across = line.sine * cosine - line.cosine * sine
    return [cosine, sine, 2 * np.pi * (place - middle) * across]


def _stepped(
    lines: list[SpectralLine],
    coordinates: dict[str, Coordinate],
    values: FloatArray,
    *,
    turning: bool,
) -> list[SpectralLine]:
    """Return one Gauss-Newton step of cosines, sines and, if ``turning``, frequencies."""
    per = 3 if turning else 2
    gram, moment = np.zeros((per * len(lines),) * 2), np.zeros(per * len(lines))
    for first in range(0, len(values), _CHUNK):
        part = slice(first, first + _CHUNK)
        columns: list[FloatArray] = []
        model = np.zeros(len(values[part]))
        for line in lines:
            own = coordinates[line.coordinate].values
            made = _columns(line, own[part], float(own[0] + own[-1]) / 2, turning)
            model += line.cosine * made[0] + line.sine * made[1]
            columns += made
        matrix = np.array(columns)
        gram += matrix @ matrix.T
        moment += matrix @ (values[part] - model)
    scale = 1 / np.sqrt(np.maximum(np.diag(gram), np.finfo(float).tiny))
    step = scale * np.linalg.lstsq(gram * np.outer(scale, scale), scale * moment, rcond=1e-9)[0]
    return [
        _moved(line, step[per * k : per * (k + 1)], coordinates[line.coordinate])
        for k, line in enumerate(lines)
    ]


def _moved(line: SpectralLine, step: FloatArray, coordinate: Coordinate) -> SpectralLine:
    """Return ``line`` after a ``step``, limited to half a resolution of frequency.

    The step of frequency holds the phase at the middle of the scan.
    """
    cosine, sine = line.cosine + step[0], line.sine + step[1]
    if len(step) < 3:
        return replace(line, cosine=cosine, sine=sine)
    shift = float(np.clip(step[2], -0.5 * coordinate.resolution, 0.5 * coordinate.resolution))
    middle = float(coordinate.values[0] + coordinate.values[-1]) / 2
    turned = (cosine - 1j * sine) * np.exp(-2j * np.pi * shift * middle)
    frequency = abs(line.frequency + shift)
    return replace(line, frequency=frequency, cosine=turned.real, sine=-turned.imag)


def sum_of(
    lines: Sequence[SpectralLine], coordinates: dict[str, Coordinate], count: int
) -> FloatArray:
    """Return the heights of all ``lines`` together [m], (count,)."""
    total = np.zeros(count)
    for line in lines:
        phase = 2 * np.pi * line.frequency * coordinates[line.coordinate].values
        total += line.cosine * np.cos(phase) + line.sine * np.sin(phase)
    return total
