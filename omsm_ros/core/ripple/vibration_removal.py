"""Remove from heights what an accelerometer measures at the same time, in its phase.

A line of acceleration is followed through the scan as a complex envelope, so that frequency and
amplitude may wander. Its motion ``a/ω²`` at the instants of the readings, aliased as they alias it,
is fitted to the heights by one complex gain: exposure, cross-talk and delay are in that gain. A
small difference of the two clocks is searched. A line that the heights do not follow beyond chance
is left alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from omsm_ros.core.lti.transfer_function import ComplexArray
from omsm_ros.core.ripple.density import aliased_frequency, significance
from omsm_ros.core.ripple.form_removal import HIGHEST_ORDER
from omsm_ros.core.ripple.scan_signal import TIME, TURN
from omsm_ros.core.ripple.source_hypotheses import StudiedScan
from omsm_ros.core.streams.blocks import AccelerationBlock, FloatArray, uninterrupted
from omsm_ros.errors import Notice

# Significance from which a line is removed; chance exceeds it in one of 30 000.
_LEAST_SIGMA = 4.0
# Power of acceleration over its floor that belongs to a line, and its widest half-band [Hz].
_OVER_FLOOR, _WIDEST_HZ = 9.0, 20.0
# Greatest difference of two quartz clocks.
_CLOCKS = 200e-6
# Waves of a scan below which a line is like form.
_LEAST_WAVES = 4
# Limits of the height over the motion a/ω² of the accelerometer.
_LEAST_GAIN, _GREATEST_GAIN = 0.05, 30.0
REMOVED, NOT_IN_HEIGHTS, FORM = "removed", "not_in_heights", "like_form"


@dataclass(frozen=True, eq=False, kw_only=True)
class RemovedVibration:
    """One line of acceleration and what was done with it.

    frequency: of the line;  apparent: in the heights [Hz];  outcome: REMOVED, or why it was not
    amplitude: of the removed part;  uncertainty: standard, of that amplitude [m]
    left: largest amplitude within four resolutions of the apparent frequency, noise included [m]
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
    for line in scan.acceleration_lines.lines:
        values = np.concatenate([getattr(block, line.axis) for block in run])
        seen = float(aliased_frequency(line.frequency, scan.signal.rate))
        if any(abs(line.frequency - at) <= half for at, half in bands):
            continue
        if outcome := _other_source(scan, line.frequency, seen):
            found.append(RemovedVibration(frequency=line.frequency, apparent=seen, outcome=outcome))
            continue
        envelope, half = _envelope(taken, values, line.frequency)
        bands.append((line.frequency, half))
        motion = np.interp(time, taken, envelope, 0.0, 0.0)
        motion = -motion * np.exp(2j * np.pi * line.frequency * time) / (
            2 * np.pi * line.frequency) ** 2  # fmt: skip
        one = _fitted(scan, time, heights, motion, line.frequency)
        if one.outcome == REMOVED:
            heights = heights - one.removed
        found.append(one)
    return found


def _other_source(scan: StudiedScan, frequency: float, seen: float) -> str:
    """Return FORM if heights at this frequency may be form of the part, else ""."""
    turn = scan.coordinates.get(TURN)
    near = _LEAST_WAVES * scan.resolution(TIME)
    for place in (frequency, seen):
        if turn is not None and place < (HIGHEST_ORDER + 0.5) * turn.pace:
            return FORM
        if place < near:
            return FORM
    return ""


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
    # The line ends where four neighbours, two at each side, are at the floor.
    quiet = np.flatnonzero(np.convolve(over[1:], np.ones(4), "valid") == 0)
    end = 1 + (int(quiet[0]) if len(quiet) else len(order) - 1)
    kept = np.zeros(len(even), np.complex128)
    kept[order[:end]] = spectrum[order[:end]]
    return np.asarray(np.fft.ifft(kept), np.complex128), float(np.abs(bins[order[end - 1]]))


def _fitted(
    scan: StudiedScan, time: FloatArray, heights: FloatArray, motion: ComplexArray, frequency: float
) -> RemovedVibration:
    """Return what of ``heights`` (n,) follows ``motion`` (n,) [m] at a clock nearly the same."""
    seen = float(aliased_frequency(frequency, scan.signal.rate))
    size = float(np.sqrt(np.mean(np.abs(motion) ** 2)))
    middle = time - time.mean()
    shift, tried = _clock_shift(heights * np.conj(motion), middle, frequency)
    turned = motion * np.exp(2j * np.pi * shift * middle)
    columns = np.column_stack([turned.real, -turned.imag])
    solution = np.linalg.lstsq(columns, heights, rcond=None)[0]
    removed = columns @ solution
    amplitude, sigma = float(np.hypot(*solution)) * size, scan.spectrum.sigma_at(seen)
    sure = float(significance(np.array(amplitude**2 / (2 * sigma**2)), tried))
    gain = amplitude / size
    is_there = sure >= _LEAST_SIGMA and _LEAST_GAIN <= gain <= _GREATEST_GAIN
    left = heights - removed if is_there else heights
    around = seen + np.arange(-4.0, 4.5, 0.5) * scan.resolution(TIME)
    remaining = [2 * abs(np.mean(left * np.exp(-2j * np.pi * f * time))) for f in around]
    return RemovedVibration(
        frequency=frequency, apparent=seen,
        outcome=REMOVED if is_there else NOT_IN_HEIGHTS,
        amplitude=amplitude if is_there else 0.0, uncertainty=sigma,
        left=float(max(remaining)),
        gain=gain, significance=sure,
        clock_ppm=1e6 * shift / frequency,
        removed=np.asarray(removed) if is_there else np.zeros(0),
    )  # fmt: skip


def _clock_shift(product: ComplexArray, middle: FloatArray, frequency: float) -> tuple[float, int]:
    """Return the shift of frequency [Hz] at which ``product`` (n,) is in phase; number tried."""
    step, best = 0.5 / float(np.ptp(middle)), 0.0
    half = int(_CLOCKS * frequency / step) + 2
    for width, spacing in ((half, step), (10, step / 10), (10, step / 100)):
        trials = best + spacing * np.arange(-width, width + 1)
        match = [abs(np.sum(product * np.exp(-2j * np.pi * t * middle))) for t in trials]
        best = float(trials[int(np.argmax(match))])
    return best, 2 * half + 1
