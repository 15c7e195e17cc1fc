"""Find the spectral lines of a scan one after the other and fit them together.

The strongest line in any coordinate is added, all lines are fitted (frequency, cosine and sine by
Gauss-Newton), and the search continues in the residual. This separates lines closer than the main
lobe of a window, and weak lines from the side lobes of strong ones.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
import scipy

from omsm_ros.core.ripple.coordinates import (
    LEAST_WAVES,
    OVERSAMPLING,
    Coordinate,
    coordinates_of,
    power_over,
    same_line,
)
from omsm_ros.core.ripple.density import noise_floor, ratio_at, significance
from omsm_ros.core.ripple.scan_signal import PATH, TIME, TURN, ScanSignal
from omsm_ros.core.ripple.spectral_line import (
    CLOSEST,
    SpectralLine,
    fitted,
    in_their_coordinates,
    start,
    sum_of,
)
from omsm_ros.core.streams.blocks import FloatArray

# Noise alone exceeds it in one spectrum of 740.
LEAST_SIGMA = 3.0
# A machine shows ten to twenty lines: this number is fitted together, further ones in groups.
MOST_TOGETHER, MOST_LINES = 40, 400
# Peaks below this share of the strongest may be its side lobes.
_TAKEN_TOGETHER = 0.3
# Distance in resolutions within which a weaker peak may be a side lobe.
_APART_BINS = 8
# The same for a line that was fitted without its weaker neighbours.
_SEPARATE = 2.0
# Samples between the places at which the rings are evaluated.
_STRIDE = 50
# Share of power and distance in resolutions of the image of a line in another coordinate. With
# images, 5 of 104 lines found in six random mixtures are none.
_IMAGE_SHARE, _IMAGE_BINS = 0.3, 30
# Loss of log-likelihood (5 σ) and of power (more than jitter and encoders cause) from which a line
# is excluded in another coordinate.
_LOST_RATIO, _LOST_SHARE = 12.5, 0.05


@dataclass(frozen=True, eq=False)
class LineSpectrum:
    """Lines of a signal, strongest first, and its noise.

    residual: without the lines (n,);  noise: rms of the residual
    amplitude_floor: σ of an amplitude over time at ``floor_frequency`` (m,) [Hz]
    """

    lines: tuple[SpectralLine, ...]
    coordinates: dict[str, Coordinate]
    residual: FloatArray
    noise: float
    floor_frequency: FloatArray
    amplitude_floor: FloatArray

    def sigma_at(self, frequency: float) -> float:
        """Return the standard deviation of an amplitude over time at ``frequency`` [Hz]."""
        return float(np.interp(frequency, self.floor_frequency, self.amplitude_floor))


def find_lines(
    signal: ScanSignal,
    values: FloatArray,
    known: Sequence[SpectralLine] = (),
    reserved_orders: Sequence[tuple[float, float]] = (),
    removed: Sequence[SpectralLine] = (),
) -> LineSpectrum:
    """Find the strongest lines of ``values`` (n,), the heights without form, beyond 3 σ.

    known: lines to start with;  removed: lines that ``values`` are without, found before
    reserved_orders: waves a turn of form and orders, which are no lines, and their width in
        resolutions
    """
    coordinates = coordinates_of(signal)
    searched = [c for c in coordinates.values() if c.like == c.name]
    reserved = _reserved(coordinates, reserved_orders)
    lines = _outside_reserved(fitted(list(known), coordinates, values), coordinates, reserved)
    residual = values - sum_of(lines, coordinates, len(values))
    taken = {name: list(places) for name, places in reserved.items()}
    for line in removed:
        taken.setdefault(line.coordinate, []).append((line.frequency, _SEPARATE))
    for _ in range(MOST_TOGETHER):
        new = _strongest(signal, residual, searched, lines, taken)
        if not new:
            break
        for line in new:  # a line that moves in the fit must not be found again
            taken.setdefault(line.coordinate, []).append((line.frequency, CLOSEST))
        new = [line for line in new if not _is_image(line, [*removed, *lines], coordinates)]
        if not new:
            continue
        lines = fitted(lines + new, coordinates, values)
        residual = values - sum_of(lines, coordinates, len(values))
        lines = in_their_coordinates(lines, new, coordinates, residual)
        lines = _outside_reserved(lines, coordinates, reserved)
        residual = values - sum_of(lines, coordinates, len(values))
    return _judged(signal, lines, coordinates, residual)


def further_lines(
    signal: ScanSignal, spectrum: LineSpectrum, reserved_orders: Sequence[tuple[float, float]] = ()
) -> LineSpectrum:
    """Return ``spectrum`` with all weaker lines, which are fitted to its residual in groups.

    After each group all groups are fitted again, each to what the others leave.
    """
    groups = [list(spectrum.lines)]
    coordinates, residual = spectrum.coordinates, spectrum.residual
    while len(groups[-1]) > MOST_TOGETHER // 2 and len(spectrum.lines) < MOST_LINES:
        new = find_lines(signal, residual, (), reserved_orders, [*chain(*groups)])
        groups.append(list(new.lines))
        residual = new.residual
        for k, group in enumerate(groups):
            values = residual + sum_of(group, coordinates, len(residual))
            groups[k] = fitted(group, coordinates, values)
            residual = values - sum_of(groups[k], coordinates, len(residual))
        spectrum = _judged(signal, [*chain(*groups)], coordinates, residual)
    return spectrum


def _strongest(
    signal: ScanSignal,
    residual: FloatArray,
    searched: Sequence[Coordinate],
    known: Sequence[SpectralLine],
    taken: Mapping[str, Sequence[tuple[float, float]]],
) -> list[SpectralLine]:
    best: tuple[float, list[SpectralLine]] = (0.0, [])
    for coordinate in searched:
        power, spacing = power_over(signal, residual, coordinate)
        tried = len(power) / OVERSAMPLING
        ratio = power / noise_floor(power, OVERSAMPLING)
        least = np.arange(len(power)) * spacing < LEAST_WAVES * coordinate.resolution
        ratio[least] = 0.0
        lines = [(k.frequency, CLOSEST) for k in known if k.coordinate == coordinate.name]
        for frequency, bins in (*lines, *taken.get(coordinate.name, ())):
            place, half = frequency / spacing, bins * OVERSAMPLING
            ratio[max(int(np.ceil(place - half)), 0) : max(int(place + half) + 1, 0)] = 0.0
        # The last frequency may be a peak, too.
        peaks, found = scipy.signal.find_peaks(
            np.append(ratio, 0.0),
            height=ratio_at(LEAST_SIGMA, tried),
            distance=_APART_BINS * OVERSAMPLING,
        )
        peaks = peaks[np.argsort(-found["peak_heights"], kind="stable")]
        if len(peaks) and power[peaks[0]] > best[0]:
            strong = peaks[power[peaks] > _TAKEN_TOGETHER * power[peaks[0]]]
            places = strong[: MOST_TOGETHER - len(known)]
            new = [start(coordinate, float(k * spacing), residual) for k in places]
            best = float(power[peaks[0]]), new
    return best[1]


def _reserved(
    coordinates: dict[str, Coordinate], reserved_orders: Sequence[tuple[float, float]]
) -> dict[str, list[tuple[float, float]]]:
    """Return the frequencies of ``reserved_orders`` waves a turn over turns, time and path."""
    turn, path = coordinates.get(TURN), coordinates.get(PATH)
    if turn is None:
        return {}
    found = {
        TURN: list(reserved_orders),
        TIME: [(order * turn.pace, bins) for order, bins in reserved_orders],
    }
    if path is not None:
        # Turns per metre of the innermost and the outermost ring.
        along = abs(np.diff(path.values[::_STRIDE]))
        ring = abs(np.diff(turn.values[::_STRIDE]))[along > 0] / along[along > 0]
        most, least = float(np.max(ring)), float(np.min(ring))
        found[PATH] = [
            (order * (most + least) / 2, bins + order * (most - least) / 2 / path.resolution)
            for order, bins in reserved_orders
        ]
    return found


def _is_image(
    new: SpectralLine, known: Sequence[SpectralLine], coordinates: dict[str, Coordinate]
) -> bool:
    """Return True for the image of a known line in another coordinate.

    A fit of both would be nearly singular.
    """
    own = coordinates[new.coordinate]
    for line in known:
        other = coordinates[line.coordinate]
        apart = abs(line.frequency * other.pace - new.frequency * own.pace)
        if other.name == own.name or apart > _IMAGE_BINS * own.resolution * own.pace:
            continue
        share, frequency = same_line(other, line.frequency, own)
        if share > _IMAGE_SHARE and abs(frequency - new.frequency) < 2 * own.resolution:
            return True
    return False


def _outside_reserved(
    lines: list[SpectralLine],
    coordinates: dict[str, Coordinate],
    reserved: Mapping[str, Sequence[tuple[float, float]]],
) -> list[SpectralLine]:
    return [
        line
        for line in lines
        if all(
            abs(line.frequency - frequency) > bins * coordinates[line.coordinate].resolution
            for frequency, bins in reserved.get(line.coordinate, ())
        )
    ]


def _judged(
    signal: ScanSignal,
    lines: list[SpectralLine],
    coordinates: dict[str, Coordinate],
    residual: FloatArray,
) -> LineSpectrum:
    floors = {}
    for name in {TIME, *(line.coordinate for line in lines)}:
        power, spacing = power_over(signal, residual, coordinates[name])
        grid = np.asarray(np.arange(len(power)) * spacing, np.float64)
        floors[name] = grid, noise_floor(power, OVERSAMPLING)
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
                    frequency_uncertainty=np.sqrt(1.5 / ratio) / np.pi * coordinate.resolution,
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


def _possible(
    line: SpectralLine, ratio: float, coordinates: dict[str, Coordinate]
) -> dict[str, float]:
    own = coordinates[line.coordinate]
    found = {line.coordinate: line.frequency}
    for name, other in coordinates.items():
        if name == line.coordinate:
            continue
        if own.like == other.like:
            found[name] = line.frequency * own.pace / other.pace
            continue
        share, frequency = same_line(own, line.frequency, other)
        if (1 - share) * ratio < _LOST_RATIO or 1 - share < _LOST_SHARE:
            found[name] = frequency
    return found
