"""Classify the lines of random mixtures and of a measured vibration, and compare with the truth."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.mixtures import MadeScan, Mixture, TrueLine, mixture
from benchmarks.row import Row, at_least, at_most, not_compared, shown
from omsm_ros.core.ripple.accelerometer import acceleration_lines
from omsm_ros.core.ripple.density import aliased_frequency
from omsm_ros.core.ripple.ripple_guard import NamedLine, analyse_scans, name_lines
from omsm_ros.core.ripple.scan_signal import scan_signal
from omsm_ros.core.ripple.source_hypotheses import (
    ALIASED,
    ARTEFACT,
    PART,
    SYNCHRONOUS,
    UNDECIDED,
    VIBRATION,
    StudiedScan,
)

_FIRST_SEED = 4000
_RECORDS = Path(__file__).parents[2] / "shared/data/vibration/pyxis_linear_stage"
_COORDINATE = {"t": "time", "s": "path", "r": "radius", "c": "turn"}
# Amplitude over the standard deviation of that of a sine or cosine.
_CERTAIN = 8.0


def rows(full: bool) -> Iterator[Row]:
    """Yield shares of correctly classified lines, and errors of predicted aliases."""
    runs = 100 if full else 12
    yield from _mixtures(runs)
    yield from _measured()


# Mixtures.


def _mixtures(runs: int) -> Iterator[Row]:
    counted: Counter[str] = Counter()
    for seed in range(_FIRST_SEED, _FIRST_SEED + runs):
        counted += judged(mixture(seed))
    peaks = counted["right"] + counted["wrong"] + counted["undecided"]
    yield at_least(
        "lines above 3 σ classified correctly", 100 * counted["right"] / peaks, "%", 95, runs=runs
    )
    yield at_most(
        "aliased vibrations classified as part", counted["aliased as part"], "", 0, runs=runs
    )
    yield shown("lines above 3 σ", peaks, "", runs=runs)
    yield shown("of them undecided", 100 * counted["undecided"] / peaks, "%", runs=runs)
    yield shown("of them classified wrongly", 100 * counted["wrong"] / peaks, "%", runs=runs)
    yield shown("of them no line at all", 100 * counted["none"] / peaks, "%", runs=runs)
    seen = counted["found"] + counted["missed"]
    yield at_least(
        f"true lines beyond {_CERTAIN:g} σ that are found", 100 * counted["found"] / seen, "%", 95,
        runs=runs,
    )  # fmt: skip


def judged(made: Mixture) -> Counter[str]:
    """Count the guard's classifications of a mixture against the true ones."""
    studied = analyse_scans([_as_signal(scan) for scan in made.scans])
    counted: Counter[str] = Counter()
    for scan, own, named in zip(made.scans, studied, name_lines(studied), strict=True):
        for row in named:
            true = _true_line(made.lines, scan, own, row)
            expected = _expected(true, scan) if true else set()
            right = row.kind in expected
            counted["right" if right else "undecided" if row.kind == UNDECIDED else "wrong"] += 1
            counted["none"] += true is None
            counted["aliased as part"] += row.kind == PART and ALIASED in expected
        for line in made.lines:
            if (
                _expected(line, scan)
                and line.amplitude > _CERTAIN * own.spectrum.noise * (2 / len(scan.sample)) ** 0.5
            ):
                found = any(_is(line, scan, own, row) for row in named)
                counted["found" if found else "missed"] += 1
    return counted


def _as_signal(scan: MadeScan):  # type: ignore[no-untyped-def]
    every = np.arange(len(scan.radius))
    signal = scan_signal(
        scan.name,
        1 / scan.rate,
        (scan.sample, scan.height),
        (every, scan.radius, np.zeros(len(every)), scan.angle),
    )
    if scan.acceleration is None:
        return signal, None
    return signal, acceleration_lines(1 / scan.acceleration_rate, {"z": scan.acceleration})


def _expected(line: TrueLine, scan: MadeScan) -> set[str]:
    """Return the correct classes of a line; none if it is not observable."""
    place = scan.place[line.over]
    span = float(np.ptp(place))
    if line.frequency * span < 6:
        return set()
    if line.what == "spindle":
        return {SYNCHRONOUS}
    in_time = line.frequency * span / (len(place) / scan.rate)
    if line.what == "vibration":
        image = float(aliased_frequency(in_time, scan.rate))
        if image * len(place) / scan.rate < 6:
            return set()
        return {ALIASED} if in_time > scan.rate / 2 else {VIBRATION}
    if in_time > scan.rate / 2:
        # Uneven steps along the path have no alias; the wave appears at its own length.
        steady = np.ptp(np.diff(place)) < 1e-9 * np.ptp(place)
        return {ARTEFACT} if steady else {PART}
    return {PART}


def _is(line: TrueLine, scan: MadeScan, own: StudiedScan, row: NamedLine) -> bool:
    """Return True if a row is at a true line, within two resolutions."""
    name = _COORDINATE[line.over]
    coordinate = own.coordinates.get(name)
    if coordinate is None:
        return False
    if name in row.line.possible:
        off = abs(row.line.possible[name] - line.frequency) / coordinate.resolution
        if off < 2:
            return True
    if not coordinate.proportional_to_time or "time" not in row.line.possible:
        return False
    image = float(aliased_frequency(line.frequency * coordinate.pace, scan.rate))
    return abs(row.line.possible["time"] - image) * own.signal.duration < 2


def _true_line(
    lines: list[TrueLine], scan: MadeScan, own: StudiedScan, row: NamedLine
) -> TrueLine | None:
    """Return the true line at a row; of several the one of similar amplitude."""
    near = [line for line in lines if _is(line, scan, own, row)]
    return min(near, key=lambda line: abs(line.amplitude - row.line.amplitude), default=None)


# A measured record.


def _measured() -> Iterator[Row]:
    name = (
        "peaks of a linear stage at 4 kHz that, decimated to 1 kHz, are within a bin of their image"
    )
    if not _RECORDS.is_dir():
        yield not_compared(name, "%", ">= 100", f"no {_RECORDS.name} here")
        return
    right = total = 0
    worst = 0.0
    for path in sorted(_RECORDS.glob("*250us*.txt")):
        for axis, off in image_errors(np.loadtxt(path) * 9.81 / 16384, 4000.0, 4):
            del axis
            total += 1
            right += off <= 1.0
            worst = max(worst, off)
    yield at_least(name, 100 * right / max(total, 1), "%", 100, runs=total)
    yield shown("farthest of them", worst, "bins", runs=total)


def image_errors(counts: np.ndarray, rate: float, every: int) -> Iterator[tuple[int, float]]:
    """Yield the axis of each aliased peak, and its distance from the predicted place in bins."""
    slow = rate / every
    for axis in range(counts.shape[1]):
        values = counts[:, axis]
        whole = acceleration_lines(1 / rate, {"z": values})
        aliased = acceleration_lines(every / rate, {"z": values[::every]})
        resolution = rate / len(values)
        for line in whole.lines:
            # Weak lines may be hidden by others that are aliased onto them.
            floor = _noise_of(values[::every], aliased)
            if line.acceleration < 4 * floor:
                continue
            place = float(aliased_frequency(line.frequency, slow))
            if not 5 * resolution < place < slow / 2 - resolution:
                continue
            if _crowded(whole, line.frequency, slow, place, resolution):
                continue
            seen = [f.frequency for f in aliased.lines]
            seen.append(_seen_near(values[::every], every / rate, place))
            yield axis, min(abs(f - place) for f in seen) / resolution


def _seen_near(values: np.ndarray, period: float, place: float) -> float:
    """Return the frequency of the largest value within three bins of ``place`` [Hz]."""
    padded = 16 * len(values)
    frequency = np.fft.rfftfreq(padded, period)
    power = abs(np.fft.rfft(values - values.mean(), padded))
    near = abs(frequency - place) < 3 / (len(values) * period)
    return float(frequency[near][np.argmax(power[near])])


def _noise_of(values: np.ndarray, found) -> float:  # type: ignore[no-untyped-def]
    power = np.var(values) - sum(line.acceleration**2 / 2 for line in found.lines)
    return float(np.sqrt(2 * max(power, 0.0) * 2 / len(values)))


def _crowded(whole, frequency: float, slow: float, place: float, resolution: float) -> bool:  # type: ignore[no-untyped-def]
    """Return True if another line is aliased to within two bins, so that both merge."""
    others = [f.frequency for f in whole.lines if f.frequency != frequency]
    return any(abs(float(aliased_frequency(f, slow)) - place) < 2 * resolution for f in others)
