"""Prepare a record for a fit, or raise the reason why it cannot be fitted.

Before any model exists, it is decided which samples are compared, which readings are spikes, and
whether the probe followed the motion.

A position rounded to steps q has an error of q / √12 rms, evenly spread (Widrow and Kollár 2008,
ch. 4). The probe measures the true motion, so through G the error remains in the residual where the
axis moves, with the mean of |G|² over all frequencies. A search for other errors in that residual
would be in vain.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy import fft, ndimage, signal

from omsm_ros.core.estimation.model_order import StartingPoints, fit
from omsm_ros.core.estimation.model_structure import ScaledStructure
from omsm_ros.core.estimation.noise import plateau_variance, plateaus, reading_step
from omsm_ros.core.estimation.output_error import ENOUGH_SAMPLES, Problem
from omsm_ros.core.estimation.parallel_sections import STATIONARY_S
from omsm_ros.core.estimation.steps import (
    LEAST_SAMPLES,
    NOISE_FACTOR,
    TRAVEL_PART,
    Steps,
    check_usable,
    extended,
    find_steps,
    moves,
    sample_noise,
)
from omsm_ros.core.lti.transfer_function import Structure
from omsm_ros.core.streams.blocks import SAME_PERIOD, BoolArray, FloatArray
from omsm_ros.core.streams.motion_record import MotionRecord
from omsm_ros.errors import ConfigurationError, DataError, IdentificationError, StepTestError
from omsm_ros.linear_algebra import least_squares

# Time after which earlier motion has no effect.
SETTLING_S = 50e-3
# Samples at the end that interpolation needs as neighbours.
_EDGE_GUARD = 8
# Fade of a moving end and its Kaiser shape, which keeps the content within 4 / time, to 1e-6.
_FADE_S = 0.5
_FADE_SHAPE = 12.0
# Limit of a spike: Gaussian noise exceeds it in one of five hundred million samples.
_SPIKE_SIGMAS = 6.0
# Readings at the extreme value per reading one step below: a smooth peak has 1/(√2 - 1) = 2.4, a
# clipped one has all readings that would lie beyond.
_PILED = 4.0
# A probe is linear to a few per cent; outside of this range a unit or a target is wrong.
_PLAUSIBLE_GAIN = (0.5, 2.0)


@dataclass(frozen=True, eq=False)
class Prepared:
    """A problem, and the steps in its motion.

    spikes: number of single readings of the probe that were removed
    axis_spikes: number of positions of the axis that were interpolated
    """

    problem: Problem
    steps: Steps
    spikes: int
    axis_spikes: int = 0


def prepare(record: MotionRecord, source: str) -> Prepared:
    """Return the problem of the motion in ``source`` ("encoder" or "reference") and the distance.

    Raises StepTestError without a usable motion, IdentificationError when the probe did not
    follow it, ConfigurationError for another source.
    """
    check_usable(record)
    for axis, position in record.further.items():
        if not moves(position):
            # Noise of an encoder is no motion that the probe could follow.
            raise StepTestError("estimation.axis_at_rest", axis=axis)
    motion, axis_spikes = _bridged(_motion(record, source))
    steps, lost = find_steps(motion, record.sample_period), record.z_lost
    if lost is not None:
        whole = tuple(e for e in steps.edges if not np.any(lost[e.start : e.stop]))
        steps = replace(steps, edges=whole)
    problem = _problem(record, motion, steps)
    if steps.edges:
        # Without plateaus a lag of half a period inverts the gain; the fit shows it.
        check_gain(_static_gain(problem))
    _check_not_clipped(problem)
    problem, spikes = _without_spikes(problem)
    plateau, output = plateaus(steps, problem.used), problem.output[problem.used]
    step = reading_step(problem.input)
    problem = replace(
        problem,
        plateau=plateau,
        shared=plateau_variance(output, plateau[problem.used], reading_step(output)),
        input_error=step**2 / 12,
        input_shared=plateau_variance(problem.input, plateau, step),
    )
    prepared = Prepared(problem, steps, spikes, axis_spikes)
    _check_axis_steps(prepared)
    return prepared


def _motion(record: MotionRecord, source: str) -> FloatArray:
    if source == "encoder":
        return record.z
    if source != "reference":
        raise ConfigurationError("estimation.unknown_input", input=source)
    known = np.isfinite(record.reference) if record.reference is not None else np.zeros(0, bool)
    if record.reference is None or not np.any(known):
        raise IdentificationError("estimation.no_reference")
    index = np.arange(len(known))
    return np.asarray(np.interp(index, index[known], record.reference[known]))


def _bridged(motion: FloatArray) -> tuple[FloatArray, int]:
    """Return ``motion`` (n,) with single outliers interpolated, and their number.

    They are replaced by the cubic through two neighbours on each side. An axis cannot jump for one
    sample: a bit or a line of the encoder was read wrongly.
    """
    calm = ndimage.median_filter(motion, 3, mode="nearest")
    least = max(NOISE_FACTOR * sample_noise(calm), TRAVEL_PART * float(np.ptp(calm)))
    if float(np.ptp(calm)) <= max(least, 1e-12):
        return motion, 0  # without spikes there is no motion
    step = np.diff(motion)
    outer, inner = motion[:-4] + motion[4:], motion[1:-3] + motion[3:-1]
    across = 0.5 * (motion[3:-1] - motion[1:-3])
    expected = (9 * inner - outer) / 16
    # A change of speed nearby raises the limit: a sharp edge is no spike.
    around = np.maximum(np.abs(across - step[:-3]), np.abs(across - step[3:]))
    spikes = np.flatnonzero(np.abs(motion[2:-2] - expected) > least + 2 * around)
    bridged = motion.copy()
    bridged[spikes + 2] = expected[spikes]
    return bridged, len(spikes)


def _problem(record: MotionRecord, motion: FloatArray, steps: Steps) -> Problem:
    samples, settling = len(record), round(SETTLING_S / record.sample_period)
    used = record.ok.copy()
    if record.z_lost is not None:  # the response depends on lost positions
        ahead = np.pad(record.z_lost, (0, _EDGE_GUARD))
        used &= ~extended(ahead, settling + _EDGE_GUARD)[_EDGE_GUARD:]
    used[: min(settling, samples // 10)] = False
    used[samples - min(_EDGE_GUARD, samples // 10) :] = False
    carried = faded_to_stationary(motion, steps.moving, record.sample_period)
    used &= carried == motion
    if np.sum(used) < LEAST_SAMPLES:
        raise StepTestError(
            "estimation.few_compared",
            compared=int(np.sum(used)),
            samples=samples,
            least=LEAST_SAMPLES,
        )
    output = np.where(record.ok, record.distance, 0.0)
    # Each recording has its own offset and drift.
    background = [np.ones(samples), np.linspace(-1.0, 1.0, samples)]
    for start, end in pairwise([*record.starts[1:], samples]):
        for shape in (np.ones(end - start), np.linspace(-1.0, 1.0, end - start)):
            background.append(np.pad(shape, (start, samples - end)))
    return Problem(
        input=carried - np.mean(motion),
        output=output - np.mean(output[used]),
        used=used,
        period=record.sample_period,
        background=np.column_stack(background),
        rate=2 * np.pi * input_bandwidth(motion, record.sample_period),
        noise=steps.noise,
        further=np.array([m - np.mean(m) for m in record.further.values()]),
        starts=record.starts,
    )


def joined_recordings(records: Sequence[MotionRecord]) -> MotionRecord:
    """Return one record of several recordings of one machine, with rests between them.

    Each later one starts where the one before it ended, in Z and at the probe: it has an offset of
    its own, and the rest is motion that nothing is compared at. Counts are added. A recording is
    parted where the probe has no reading for longer than it has readings at all.

    Raises DataError for recordings of different sample periods, axes or sensors.
    """
    first = records[0]
    for number, record in enumerate(records[1:], start=2):
        if (
            abs(record.sample_period / first.sample_period - 1) > SAME_PERIOD
            or record.further.keys() != first.further.keys()
            or (record.reference is None) != (first.reference is None)
        ):
            raise DataError("estimation.unlike_recordings", number=number)
    records = [part for record in records for part in _parted(record)]
    if len(records) == 1:
        return records[0]
    motions = [
        faded_to_stationary(r.z, find_steps(r.z, r.sample_period).moving, r.sample_period)
        for r in records
    ]
    rest = round(STATIONARY_S / first.sample_period)
    starts = [sum(len(r) + rest for r in records[:i]) for i in range(len(records))]
    gap = np.concatenate([np.arange(len(r) + rest) >= len(r) for r in records])[:-rest]
    lost = [np.zeros(len(r), np.bool_) if r.z_lost is None else r.z_lost for r in records]
    compared = [r.ok & (m == r.z) for r, m in zip(records, motions, strict=True)]
    second = [r.reference for r in records if r.reference is not None]
    return replace(
        first,
        z=_chained(motions, rest),
        distance=np.where(gap, np.nan, _chained([r.distance for r in records], rest)),
        ok=~gap & np.concatenate([np.pad(c, (0, rest)) for c in compared])[:-rest],
        reference=np.where(gap, np.nan, _chained(second, rest)) if second else None,
        z_lost=gap | np.concatenate([np.pad(each, (0, rest)) for each in lost])[:-rest],
        further={
            name: _chained([r.further[name] for r in records], rest) for name in first.further
        },
        starts=tuple(starts),
        counts={name: sum(r.counts.get(name, 0) for r in records) for name in first.counts},
    )


def _parted(record: MotionRecord) -> list[MotionRecord]:
    """Return the parts of ``record`` between long stretches without a reading of the probe.

    It would take most of the time of a fit. Before a part, modes decay. The first has all counts.
    """
    known = np.flatnonzero(record.ok)
    least = max(len(known), ENOUGH_SAMPLES)
    breaks = np.flatnonzero(np.diff(known, prepend=-1, append=len(record)) > least)
    if len(record.starts) > 1 or len(breaks) == 0:
        return [record]
    rest, runs = round(STATIONARY_S / record.sample_period), np.split(known, breaks)
    parts = [
        record.part(max(int(run[0]) - rest, 0), int(run[-1]) + 1 + _EDGE_GUARD)
        for run in runs
        if len(run) >= LEAST_SAMPLES
    ]
    parts = [part for part in parts if moves(part.z)]
    return [replace(p, counts={} if i else record.counts) for i, p in enumerate(parts)] or [record]


def _chained(parts: Sequence[FloatArray], rest: int) -> FloatArray:
    """Return ``parts`` in a row, each from where the one before ended and held for ``rest``."""
    level, found = 0.0, list[FloatArray]()
    for part in parts:
        known = part[np.isfinite(part)]
        shift = level - known[0] if found else 0.0
        level = float(known[-1] + shift)
        found += [part + shift, np.full(rest, level)]
    return np.concatenate(found[:-1])


def faded_to_stationary(motion: FloatArray, moving: BoolArray, period: float) -> FloatArray:
    """Return ``motion`` (n,) faded to its mean where it starts or ends while moving.

    A motion that breaks off would have content at all frequencies.
    """
    length = min(round(_FADE_S / period), len(motion) // 5)
    if length == 0:  # the fade is shorter than a sample
        return motion
    rising = np.cumsum(signal.windows.kaiser(length, _FADE_SHAPE))
    rising = rising / rising[-1]
    carried = motion.copy()
    for fades, end, weight in (
        (moving[0], slice(0, length), rising),
        (moving[-1], slice(len(motion) - length, None), rising[::-1]),
    ):
        if fades:
            level = np.mean(motion[end])
            carried[end] = level + weight * (motion[end] - level)
    return carried


def input_bandwidth(motion: FloatArray, sample_period: float) -> float:
    """Return the frequency [Hz] below which 99 % of the energy of the velocity lies, with noise."""
    length = fft.next_fast_len(len(motion), real=True)
    power = np.abs(fft.rfft(np.diff(motion), length)) ** 2
    # Without a division: the power may be 0, also by underflow.
    place = int(np.searchsorted(np.cumsum(power), 0.99 * np.sum(power))) + 1
    return float(place / (length * sample_period))


def _static_gain(problem: Problem) -> float:
    columns = np.column_stack([problem.input, *problem.further, problem.background])[problem.used]
    return float(least_squares(columns, problem.output[problem.used])[0])


def check_gain(gain: float, *, slack: float = 1.0) -> None:
    """Raise IdentificationError unless the probe follows the motion with a gain of about one.

    slack: factor by which the limits are relaxed
    """
    low, high = _PLAUSIBLE_GAIN
    if not low / slack <= abs(gain) <= high * slack:
        raise IdentificationError("estimation.implausible_gain", gain=gain)


def _check_not_clipped(problem: Problem) -> None:
    motion, output = problem.input[problem.used], problem.output[problem.used]
    levels = np.unique(output)
    if len(levels) < 2:
        raise IdentificationError("estimation.constant_distance")
    quantum = float(np.min(np.diff(levels)))
    allowed = max(20 * sample_noise(output), 3 * quantum, 2e-3 * float(np.ptp(motion)))
    for name, extreme in (("greatest", levels[-1]), ("least", levels[0])):
        there = motion[output == extreme]
        near = int(np.sum(np.abs(output - extreme) < 1.5 * quantum)) - len(there)
        piled = len(there) >= 5 and len(there) > _PILED * near
        if piled and np.ptp(there) > allowed:
            travel = float(np.ptp(there))
            raise IdentificationError(
                "estimation.clipped", end=name, times=len(there), travel=travel
            )


def _without_spikes(problem: Problem) -> tuple[Problem, int]:
    """Remove single readings that differ from both neighbours, and count them."""
    apart = np.where(problem.used, problem.output - _static_gain(problem) * problem.input, np.nan)
    before, after = np.roll(apart, 1), np.roll(apart, -1)
    jump = np.abs(apart - 0.5 * (before + after))
    # A change nearby raises the limit: an edge is no spike.
    around = np.fmax(np.abs(before - np.roll(apart, 2)), np.abs(after - np.roll(apart, -2)))
    around = np.fmax(around, np.abs(after - before))
    limit = _SPIKE_SIGMAS * sample_noise(apart[np.isfinite(apart)]) + 2 * around
    spikes = np.isfinite(jump) & np.isfinite(around) & (jump > limit)
    return replace(problem, used=problem.used & ~spikes), int(np.sum(spikes))


# A lag and its roll-off are enough to show a residual of the size of a step.
_PLAIN = Structure(2, 1, True)
# Poles at which its fit starts, in units of the bandwidth of the motion; damping ratio 0.42.
_RESONANCE = 3 * np.exp(np.array([2j, -2j]))
# Limits of the residual over that of evenly spread errors. Plateaus at whole steps gave a fifth,
# plateaus on one side of whole steps 2.8.
_AS_ROUNDING = (0.1, 5.0)
# Least excess over the variance of the noise. Steps with more rms error than the noise gave 0.4 or
# more in two seeds of eight step tests.
_SEEN = 0.25
# Share of moving samples at which the speed changes. A ramp of a planned motion advances evenly but
# for its ends, less than 0.2; rounded motions gave 0.4 to 1.
_UNEVEN = 0.3


def _check_axis_steps(prepared: Prepared) -> None:
    """Raise IdentificationError where steps of the axis' positions hide the response.

    That is where their rounding error exceeds the noise of the probe, and where the residual of a
    simple response is about as large as that error; a residual of another size has another cause.
    """
    problem = prepared.problem
    positions = problem.input[problem.used]
    step, noise = reading_step(positions), sample_noise(problem.output[problem.used])
    advance = np.diff(positions)
    moves = (np.abs(advance[:-1]) > step / 2) | (np.abs(advance[1:]) > step / 2)
    uneven = moves & (np.abs(np.diff(advance)) > step / 2)
    if step**2 / 12 <= noise**2 or np.sum(uneven) <= _UNEVEN * np.sum(moves):
        return
    lag = fit(problem, Structure(0, 0, True), [np.array([0.1])])
    starts = StartingPoints(problem, lag).of(_PLAIN, [lag])
    # Readings this coarse may show a resonance to neither of them.
    resonance = ScaledStructure(_PLAIN, problem.rate).nonlinear_of(_RESONANCE, starts[0][-1])
    plain = fit(problem, _PLAIN, [resonance, *starts])
    moving = prepared.steps.moving[problem.used]
    left = float(np.mean(plain.residual[moving] ** 2)) - noise**2 if np.any(moving) else 0.0
    passed = plain.mean_power(problem.period) * step**2 / 12
    low, high = (part * passed for part in _AS_ROUNDING)
    if left > _SEEN * noise**2 and low < left < high:
        residual = float(np.sqrt(left))
        raise IdentificationError(
            "estimation.coarse_positions", step=step, residual=residual, noise=noise
        )
