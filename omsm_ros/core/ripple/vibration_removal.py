"""Remove from heights what an accelerometer measures at the same time, in its phase.

A line of acceleration is followed through the scan as a complex envelope, so that frequency and
amplitude may wander. Its motion ``a/ω²`` at the instants of the readings, aliased as they alias it,
is fitted to the heights by one complex gain: exposure, cross-talk and delay are in that gain. A
small difference of the two clocks is searched once. Other lines of the heights, such as marks near
the apparent frequency, are left out of the fit. A line that the heights do not follow beyond chance
is left alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from omsm_ros.core.lti.transfer_function import ComplexArray
from omsm_ros.core.ripple.accelerometer import LARGEST_GAIN
from omsm_ros.core.ripple.coordinates import LEAST_WAVES, magnitudes
from omsm_ros.core.ripple.density import aliased_frequency, significance
from omsm_ros.core.ripple.form_removal import HIGHEST_ORDER
from omsm_ros.core.ripple.scan_signal import TIME, TURN
from omsm_ros.core.ripple.source_hypotheses import StudiedScan
from omsm_ros.core.ripple.spectral_line import sum_of
from omsm_ros.core.streams.blocks import AccelerationBlock, FloatArray, uninterrupted
from omsm_ros.errors import Notice

# Significance from which a line is removed; chance exceeds it in one of 30 000.
_LEAST_SIGMA = 4.0
# Power of acceleration over its floor that belongs to a line, distance from there at which a
# modulation, as by the spindle, still belongs to it, and its widest half-band [Hz].
_OVER_FLOOR, _MODULATION_HZ, _WIDEST_HZ = 9.0, 1.0, 20.0
# Greatest difference of two quartz clocks.
_CLOCKS = 200e-6
# Resolutions about a line that are near it; least height over the motion a/ω².
_NEAR, _LEAST_GAIN = 4.0, 0.05
REMOVED, NOT_IN_HEIGHTS, FORM = "removed", "not_in_heights", "like_form"


@dataclass(frozen=True, eq=False, kw_only=True)
class RemovedVibration:
    """One line of acceleration and what was done with it.

    frequency: of the line;  apparent: in the heights [Hz];  outcome: REMOVED, or why it was not
    amplitude: of the removed part;  uncertainty: standard, of that amplitude [m]
    left: upper limit, k = 2, of amplitudes within four resolutions of the apparent frequency [m]
    gain: height over ``a/ω²`` [1];  significance: [σ]
    clock_ppm: by which the clock of the accelerometer is fast
    """

    frequency: float
    apparent: float
    outcome: str
    amplitude: float = 0.0
    uncertainty: float = 0.0
    left: float = 0.0
    gain: float = 0.0
    significance: float = 0.0
    clock_ppm: float = 0.0
    removed: FloatArray = field(default_factory=lambda: np.zeros(0), repr=False)

    def finding(self) -> Notice:
        """Return what was done with the line."""
        values = {name: getattr(self, name) for name in (
            "frequency", "apparent", "amplitude", "uncertainty", "left")}  # fmt: skip
        return Notice(f"ripple.vibration_{self.outcome}", **values)


def remove_vibrations(
    scan: StudiedScan, time: FloatArray, blocks: Sequence[AccelerationBlock]
) -> list[RemovedVibration]:
    """Return the lines of acceleration with the part of the heights that each explains (n,) [m].

    time: of each height since trigger 0 (n,) [s]; counts of the accelerometer begin there, too
    """
    if scan.acceleration_lines is None:
        return []
    run = max(uninterrupted(blocks), key=lambda run: sum(map(len, run)))
    period = run[0].sample_period
    taken = (run[0].first_sample + np.arange(sum(map(len, run)), dtype=np.float64)) * period
    heights = scan.formless.residual
    found: list[RemovedVibration] = []
    bands: list[tuple[float, float]] = []
    others, clock = _other_lines(scan), None
    # Below it heights may be form of the part.
    lowest = LEAST_WAVES * scan.resolution(TIME)
    if (turn := scan.coordinates.get(TURN)) is not None:
        lowest = max(lowest, (HIGHEST_ORDER + 0.5) * turn.pace)
    left = {axis: np.concatenate([getattr(block, axis) for block in run]) for axis in "xyz"}
    for line in scan.acceleration_lines.lines:
        seen = float(aliased_frequency(line.frequency, scan.signal.rate))
        if any(abs(line.frequency - at) <= half for at, half in bands):
            continue
        if min(line.frequency, seen) < lowest:
            found.append(RemovedVibration(frequency=line.frequency, apparent=seen, outcome=FORM))
            continue
        envelope, half = _envelope(taken, left[line.axis], line.frequency)
        bands.append((line.frequency, half))
        # A weaker line near this one has an envelope of its own.
        turning = np.exp(2j * np.pi * line.frequency * taken)
        left[line.axis] = left[line.axis] - (envelope * turning).real
        motion = np.interp(time, taken, envelope, 0.0, 0.0)
        motion = -motion * np.exp(2j * np.pi * line.frequency * time) / (
            2 * np.pi * line.frequency) ** 2  # fmt: skip
        one = _fitted(scan, time, heights, others, motion, line.frequency, clock)
        if one.outcome == REMOVED:
            heights, clock = heights - one.removed, one.clock_ppm
        found.append(one)
    return found


def _other_lines(scan: StudiedScan) -> FloatArray:
    """Return the lines of the heights (n,) [m] that are no image of a line of acceleration."""
    shaken = scan.acceleration_lines.lines if scan.acceleration_lines else ()
    images = [
        (aliased_frequency(line.frequency, scan.signal.rate),
         _CLOCKS * line.frequency + _NEAR * scan.resolution(TIME))
        for line in shaken
    ]  # fmt: skip
    others = [
        line for line in scan.spectrum.lines
        if all(abs(line.possible.get(TIME, np.inf) - at) > reach for at, reach in images)
    ]  # fmt: skip
    return sum_of(others, scan.coordinates, len(scan.signal))


def _envelope(time: FloatArray, values: FloatArray, frequency: float) -> tuple[ComplexArray, float]:
    """Return the envelope e of the line at ``time`` (m,), and its half-band [Hz].

    The line is Re(e · exp(i2πft)). Shifted to zero, a pure line is one value of the spectrum, so
    that a record which is no whole number of its waves has no leakage.
    """
    known = np.isfinite(values)
    even = np.interp(time, time[known], values[known] - np.mean(values[known]))
    spectrum = np.fft.fft(2 * even * np.exp(-2j * np.pi * frequency * time))
    bins = np.fft.fftfreq(len(even), float(time[1] - time[0]))
    near = np.flatnonzero(np.abs(bins) <= _WIDEST_HZ)
    order = near[np.argsort(np.abs(bins[near]))]
    power = np.abs(spectrum[order]) ** 2
    over = power > _OVER_FLOOR * np.median(power) / np.log(2)
    gap = max(4, round(2 * _MODULATION_HZ / abs(bins[1])))
    quiet = np.flatnonzero(np.convolve(over[1:], np.ones(gap), "valid") == 0)
    end = 1 + (int(quiet[0]) if len(quiet) else len(order) - 1)
    kept = np.zeros(len(even), np.complex128)
    kept[order[:end]] = spectrum[order[:end]]
    return np.asarray(np.fft.ifft(kept), np.complex128), float(np.abs(bins[order[end - 1]]))


def _fitted(
    scan: StudiedScan, time: FloatArray, heights: FloatArray, others: FloatArray,
    motion: ComplexArray, frequency: float, clock: float | None,
) -> RemovedVibration:  # fmt: skip
    """Return what of ``heights`` (n,) follows ``motion`` (n,) [m] at a clock nearly the same.

    others: other lines of the heights (n,) [m];  clock: known from another line [ppm], or None
    """
    seen = float(aliased_frequency(frequency, scan.signal.rate))
    size = float(np.sqrt(np.mean(np.abs(motion) ** 2)))
    middle = time - time.mean()
    fitted = heights - others
    shift, tried = _clock_shift(fitted * np.conj(motion), middle, frequency, clock)
    turned = motion * np.exp(2j * np.pi * shift * middle)
    columns = np.column_stack([turned.real, -turned.imag])
    solution = np.linalg.lstsq(columns, fitted, rcond=None)[0]
    removed = columns @ solution
    amplitude, sigma = float(np.hypot(*solution)) * size, scan.spectrum.sigma_at(seen)
    sure = float(significance(np.array(amplitude**2 / (2 * sigma**2)), tried))
    gain = amplitude / size
    is_there = sure >= _LEAST_SIGMA and _LEAST_GAIN <= gain <= LARGEST_GAIN
    # A match that is best beyond the search is the side lobe of another line.
    is_there &= clock is not None or abs(shift) <= _CLOCKS * frequency + scan.resolution(TIME) / 2
    left = heights - removed if is_there else heights
    around = seen + np.arange(-_NEAR, _NEAR + 0.5, 0.5) * scan.resolution(TIME)
    remaining = [2 * abs(np.mean(left * np.exp(-2j * np.pi * f * time))) for f in around]
    return RemovedVibration(
        frequency=frequency, apparent=seen,
        outcome=REMOVED if is_there else NOT_IN_HEIGHTS,
        amplitude=amplitude if is_there else 0.0, uncertainty=sigma,
        left=float(max(remaining)) + 2 * sigma,
        gain=gain, significance=sure,
        clock_ppm=1e6 * shift / frequency,
        removed=np.asarray(removed) if is_there else np.zeros(0),
    )  # fmt: skip


def _clock_shift(
    product: ComplexArray, middle: FloatArray, frequency: float, clock: float | None
) -> tuple[float, int]:
    """Return the shift of frequency [Hz] at which ``product`` (n,) is in phase; number tried."""
    step, best = 0.5 / float(np.ptp(middle)), 1e-6 * (clock or 0.0) * frequency
    half = 2 if clock is not None else int(_CLOCKS * frequency / step) + 2
    for width, spacing in ((half, step), (10, step / 10), (10, step / 100)):
        trials = best + spacing * np.arange(-width, width + 1)
        best = float(trials[np.argmax(magnitudes(product, middle, trials))])
    return best, 2 * half + 1
