"""The lines of a scan: found one after the other, fitted together.

The strongest line in any coordinate is taken, all lines so far are fitted at once (frequency,
cosine, sine: Gauss-Newton), and the search goes on in what they leave: lines closer than a
window's main lobe come apart, and a strong one hides no weak one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.core.spectra.coordinates import (
    LEAST_WAVES,
    OVERSAMPLING,
    Coordinate,
    coordinates_of,
    floor_of,
    power_over,
    same_line,
)
from omsm_ros.core.spectra.noise_floor import ratio_at, significance
from omsm_ros.core.spectra.scan_signal import TIME, ScanSignal

LEAST_SIGMA = 3.0
MOST_LINES = 40
# Of the strongest that is left: weaker ones may be its side lobes.
_TAKEN_TOGETHER = 0.3
_APART_BINS = 8
# Closer than this to another, in resolutions, a line is its own side lobe; two true ones cannot
# be fitted.
_CLOSEST = 0.6
_FITTING_STEPS = 4
_CHUNK = 32_768
# A line may be one in another coordinate unless that takes this much off its likelihood (5 σ),
# and more of its power than jitter and encoders do.
_LOST_RATIO, _LOST_SHARE = 12.5, 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class Line:
    """``cosine · cos(2π f u) + sine · sin(2π f u)``, u one coordinate of the scan.

    coordinate: in which it is sharpest;  frequency: there [1/unit], its standard uncertainty
    amplitude_uncertainty: of cosine and sine alike, from the noise floor beside the line [m]
    significance: σ, see :func:`noise_floor.significance`
    possible: every coordinate in which it may be a line, and the frequency there
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
        """Half of peak to valley [m]."""
        return float(np.hypot(self.cosine, self.sine))


@dataclass(frozen=True, eq=False)
class LineSpectrum:
    """The lines of a signal, strongest first, and the noise about them.

    residual: without the lines (n,);  noise: its rms
    amplitude_floor: σ of an amplitude over time at ``floor_frequency`` (m,) [Hz]
    """

    lines: tuple[Line, ...]
    coordinates: dict[str, Coordinate]
    residual: FloatArray
    noise: float
    floor_frequency: FloatArray
    amplitude_floor: FloatArray

    def sigma_at(self, frequency: float) -> float:
        """Standard deviation of an amplitude over time at ``frequency`` [Hz]."""
        return float(np.interp(frequency, self.floor_frequency, self.amplitude_floor))


def find_lines(signal: ScanSignal, values: FloatArray) -> LineSpectrum:
    """Find all lines of ``values`` (n,), the heights without form, beyond 3 σ."""
    coordinates = coordinates_of(signal)
    searched = [c for c in coordinates.values() if c.name == TIME or not c.proportional_to_time]
    lines: list[Line] = []
    residual = values
    while len(lines) < MOST_LINES:
        new = _strongest(signal, residual, searched, lines)
        if not new:
            break
        before = float(residual @ residual)
        lines = _fitted(lines + new, coordinates, values)
        residual = values - _sum_of(lines, coordinates, len(values))
        if float(residual @ residual) > before * (1 - 1e-6):
            break
    return _judged(signal, lines, coordinates, residual)


def _strongest(
    signal: ScanSignal,
    residual: FloatArray,
    searched: Sequence[Coordinate],
    known: Sequence[Line],
) -> list[Line]:
    """The strongest lines left, all of one coordinate."""
    best: tuple[float, list[Line]] = (0.0, [])
    for coordinate in searched:
        power, spacing = power_over(signal, residual, coordinate)
        tried = len(power) / OVERSAMPLING
        ratio = power / floor_of(power)
        least = np.arange(len(power)) * spacing < LEAST_WAVES * coordinate.resolution
        ratio[least] = 0.0
        for line in known:
            if line.coordinate == coordinate.name:
                ratio[abs(np.arange(len(power)) - line.frequency / spacing) < OVERSAMPLING * _CLOSEST] = 0.0
        peaks = _peaks(ratio, ratio_at(LEAST_SIGMA, tried))
        if len(peaks) and power[peaks[0]] > best[0]:
            # An amplitude only to start with; the fit gives phase and frequency.
            taken = peaks[power[peaks] > _TAKEN_TOGETHER * power[peaks[0]]]
            lines = [_start(coordinate, k * spacing, residual) for k in _spaced(taken)]
            best = float(power[peaks[0]]), lines[: MOST_LINES - len(known)]
    return best[1]


def _peaks(ratio: FloatArray, least: float) -> np.ndarray:
    """Places of local maxima above ``least``, largest first."""
    inner = ratio[1:-1]
    top = (inner >= ratio[:-2]) & (inner > ratio[2:]) & (inner > least)
    places = np.flatnonzero(top) + 1
    if ratio[-1] > max(least, ratio[-2]):
        places = np.r_[places, len(ratio) - 1]
    return places[np.argsort(-ratio[places], kind="stable")]


def _spaced(places: np.ndarray) -> list[int]:
    kept: list[int] = []
    for place in places:
        if all(abs(int(place) - k) >= _APART_BINS * OVERSAMPLING for k in kept):
            kept.append(int(place))
    return kept


def _start(coordinate: Coordinate, frequency: float, values: FloatArray) -> Line:
    phase = np.exp(-2j * np.pi * frequency * coordinate.values)
    mean = 2 * complex(values @ phase) / len(values)
    return Line(coordinate=coordinate.name, frequency=frequency, cosine=mean.real, sine=-mean.imag)


def _fitted(
    lines: list[Line], coordinates: dict[str, Coordinate], values: FloatArray
) -> list[Line]:
    """All lines at once: amplitudes first, then frequencies as well."""
    lines = _stepped(lines, coordinates, values, turning=False)
    for _ in range(_FITTING_STEPS):
        lines = _apart(_stepped(lines, coordinates, values, turning=True), coordinates)
    return _stepped(lines, coordinates, values, turning=False)


def _apart(lines: list[Line], coordinates: dict[str, Coordinate]) -> list[Line]:
    """Without the weaker of two that are one."""
    kept: list[Line] = []
    for line in sorted(lines, key=lambda one: -one.amplitude):
        bin_ = coordinates[line.coordinate].resolution
        if all(
            k.coordinate != line.coordinate or abs(k.frequency - line.frequency) > _CLOSEST * bin_
            for k in kept
        ):
            kept.append(line)
    return kept


def _columns(line: Line, place: FloatArray, middle: float, turning: bool) -> list[FloatArray]:
    phase = 2 * np.pi * line.frequency * place
    cosine, sine = np.cos(phase), np.sin(phase)
    if not turning:
        return [cosine, sine]
    across = line.sine * cosine - line.cosine * sine
    return [cosine, sine, 2 * np.pi * (place - middle) * across]


def _stepped(
    lines: list[Line], coordinates: dict[str, Coordinate], values: FloatArray, *, turning: bool
) -> list[Line]:
    """One Gauss-Newton step of cosines, sines and, if ``turning``, frequencies."""
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


def _moved(line: Line, step: FloatArray, coordinate: Coordinate) -> Line:
    """A frequency moves by half a resolution at most, for further away it is another line.

    The derivative is taken about the middle of the scan, the phase told at its zero.
    """
    cosine, sine = line.cosine + step[0], line.sine + step[1]
    if len(step) < 3:
        return replace(line, cosine=cosine, sine=sine)
    shift = float(np.clip(step[2], -0.5 * coordinate.resolution, 0.5 * coordinate.resolution))
    middle = float(coordinate.values[0] + coordinate.values[-1]) / 2
    turned = (cosine - 1j * sine) * np.exp(-2j * np.pi * shift * middle)
    frequency = abs(line.frequency + shift)
    return replace(line, frequency=frequency, cosine=turned.real, sine=-turned.imag)


def _sum_of(lines: Sequence[Line], coordinates: dict[str, Coordinate], count: int) -> FloatArray:
    total = np.zeros(count)
    for line in lines:
        phase = 2 * np.pi * line.frequency * coordinates[line.coordinate].values
        total += line.cosine * np.cos(phase) + line.sine * np.sin(phase)
    return total


def _judged(
    signal: ScanSignal,
    lines: list[Line],
    coordinates: dict[str, Coordinate],
    residual: FloatArray,
) -> LineSpectrum:
    """The lines with their uncertainties, those that stand out of what all of them leave."""
    floors = {}
    for name in {TIME, *(line.coordinate for line in lines)}:
        power, spacing = power_over(signal, residual, coordinates[name])
        floors[name] = np.arange(len(power)) * spacing, floor_of(power)
    found = []
    for line in lines:
        frequency, floor = floors[line.coordinate]
        variance = float(np.interp(line.frequency, frequency, floor)) / 2
        ratio = line.amplitude**2 / (2 * variance)
        sigma = float(significance(np.array(ratio), len(frequency) / OVERSAMPLING))
        if sigma >= LEAST_SIGMA:
            coordinate = coordinates[line.coordinate]
            found.append(
                replace(
                    line,
                    amplitude_uncertainty=variance**0.5,
                    # Cramér-Rao for a line in white noise over an even range.
                    frequency_uncertainty=np.sqrt(3 / ratio) / np.pi * coordinate.resolution,
                    significance=sigma,
                    possible=_possible(line, ratio, coordinates),
                )
            )
    found.sort(key=lambda one: -one.amplitude)
    frequency, floor = floors[TIME]
    return LineSpectrum(
        lines=tuple(found),
        coordinates=coordinates,
        residual=residual,
        noise=float(np.std(residual)),
        floor_frequency=frequency,
        amplitude_floor=np.sqrt(floor / 2),
    )


def _possible(line: Line, ratio: float, coordinates: dict[str, Coordinate]) -> dict[str, float]:
    """In which coordinates the data allow it to be a line, with the frequency there."""
    own = coordinates[line.coordinate]
    found = {line.coordinate: line.frequency}
    for name, other in coordinates.items():
        if name == line.coordinate:
            continue
        if own.proportional_to_time and other.proportional_to_time:
            found[name] = line.frequency * own.pace / other.pace
            continue
        share, frequency = same_line(own, line.frequency, other)
        if (1 - share) * ratio < _LOST_RATIO or 1 - share < _LOST_SHARE:
            found[name] = frequency
    return found
