"""Filter the commands of a scan so that the encoder, or the probe, is where the path has it.

    python precompensate.py COMMAND.mcap STEPS.mcap SURFACE.yaml RPM RADIUS TURNS OUT.nc
                            [CAL.json [REHEARSAL.mcap]]

The response from command to encoder is fitted to the step test (COMMAND.mcap: as commanded,
STEPS.mcap: as measured); with CAL.json the probe is to follow, by the calibrated response from
encoder to probe. The commands are the path through the inverse response, which is limited to the
band below; the path is known beforehand, so the inverse need not be causal.

With CAL.json a rehearsal is written, too: the same motion with X at the axis, where the surface is
still, and Z within the range of the probe. Its recording REHEARSAL.mcap shows the lag at the speed
of the scan, which is then corrected, and how the probe follows the segments, whose frequency is
beyond the band of the calibration.
"""

import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from behind import commanded
from scipy.signal import hilbert

from omsm_ros.core.adjustment import ScanDesign
from omsm_ros.core.kinematics.planner import plan_path, planned_at
from omsm_ros.core.lti.frequency_response import low_frequency_delay_uncertainty
from omsm_ros.io import bags
from omsm_ros.io.calibration_file import load_calibration
from omsm_ros.io.descriptions import load_surface
from omsm_ros.io.gcode_file import path_gcode
from omsm_ros.io.topics import AXES_TOPIC, DISTANCE_TOPIC
from omsm_ros.pipelines.plan_scans import scan_path

CYCLE_S = 1e-3
TAPS = 100
# The inverse is whole up to the first and ends at the second frequency [Hz].
BAND_HZ = (60.0, 120.0)
# The path is continued by this time at both ends, where the filter settles [s].
SETTLE_S = 1.0
BOUND_M = 2e-8
# Largest acceleration of Z in the configuration, with a margin [m/s²].
LARGEST_ACCELERATION = 10.0
# Z of the rehearsal: half of its largest travel [m], and its duration [s].
REACH_M, REHEARSED_S = 4e-5, 20.0

# Half of all normal errors are below the first, 95 % below the second [σ].
MEDIAN, COVERED = 0.674, 1.96


def servo(command, encoder):
    """Return the impulse response (TAPS,) from command to encoder by least squares."""
    command, encoder = command - command[0], encoder - encoder[:100].mean()
    padded = np.concatenate([np.zeros(TAPS - 1), command])
    lagged = np.lib.stride_tricks.sliding_window_view(padded, TAPS)[:, ::-1]
    square = lagged.T @ lagged
    square += 1e-12 * np.trace(square) / TAPS * np.eye(TAPS)
    return np.linalg.solve(square, lagged.T @ encoder)


def response(taps, frequency, probe=None):
    """Return the response from command to encoder, or with that of the probe to the probe."""
    turning = np.exp(-2j * np.pi * CYCLE_S * np.outer(frequency, np.arange(TAPS)))
    found = turning @ taps
    return found * probe(frequency) if probe else found


def lag_of(of):
    """Return the lag [s] of slow motion through the response ``of`` (a function of frequency)."""
    return -np.angle(of(np.array([0.01]))[0]) / (2 * np.pi * 0.01)


def filtered(path, duration, of):
    """Return times and Z of ``path`` through the response ``of`` (a function of frequency)."""
    time = np.arange(-SETTLE_S, duration + SETTLE_S, CYCLE_S)
    z = path(time)[1]
    slow = np.polynomial.polynomial.polyfit(time, z, 1)
    line = np.polynomial.polynomial.polyval(time, slow)
    edge = np.minimum(np.arange(len(time)), np.arange(len(time))[::-1]) * CYCLE_S / SETTLE_S * 2
    window = 0.5 - 0.5 * np.cos(np.pi * np.clip(edge, 0, 1))
    frequency = np.fft.rfftfreq(len(time), CYCLE_S)
    gain = of(frequency)
    moved = np.fft.irfft(np.fft.rfft((z - line) * window) * gain, len(time))
    # A line through a filter is the line, scaled and late by the slope of the phase.
    static = of(np.array([0.0]))[0].real
    return time, moved + static * np.polynomial.polynomial.polyval(time - lag_of(of), slow)


def inverse(taps, probe=None):
    """Return the inverse response as a function of frequency, limited to BAND_HZ."""

    def of(frequency):
        low, high = BAND_HZ
        kept = 0.5 + 0.5 * np.cos(np.pi * np.clip((frequency - low) / (high - low), 0, 1))
        return kept / response(taps, np.minimum(frequency, high), probe)

    return of


def precompensated(path, duration, taps, probe=None):
    """Return the path with Z filtered, and the largest acceleration of Z [m/s²].

    Raises ValueError where Z would exceed LARGEST_ACCELERATION.
    """
    time, z = filtered(path, duration, inverse(taps, probe))
    within = (time > -SETTLE_S / 3) & (time < duration + SETTLE_S / 3)
    worst = float(np.max(np.abs(np.diff(z[within], 2)))) / CYCLE_S**2
    if worst > LARGEST_ACCELERATION:
        raise ValueError(f"Z would be accelerated by {worst:.3g} m/s²; give a slower spindle")

    def moved(at):
        x, _, c = path(at)
        place = (at - time[0]) / CYCLE_S
        k = np.clip(place.astype(int), 1, len(time) - 3)
        u = place - k
        return (
            x,
            -u * (u - 1) * (u - 2) / 6 * z[k - 1]
            + (u + 1) * (u - 1) * (u - 2) / 2 * z[k]
            - (u + 1) * u * (u - 2) / 2 * z[k + 1]
            + (u + 1) * u * (u - 1) / 6 * z[k + 2],
            c,
        )

    return moved, worst


def predicted(plan, path, taps, probe=None):
    """Return the rms [m] by which the encoder, or the probe, will be off the path."""
    time = np.arange(int(plan.time[-1] / CYCLE_S)) * CYCLE_S
    z = plan.motion(time)[1]
    moved = np.convolve(z - z[0], taps)[: len(z)] + taps.sum() * z[0]
    if probe:
        frequency = np.fft.rfftfreq(len(z), CYCLE_S)
        # The dynamics act on what is smooth; a line is taken out so that both ends meet.
        line = np.linspace(moved[0], moved[-1], len(z))
        moved = np.fft.irfft(np.fft.rfft(moved - line) * probe(frequency), len(z))
        moved = moved + line - (line[1] - line[0]) / CYCLE_S * lag_of(probe)
    off = (moved - path(time)[1])[500:-500]
    return float(np.std(off))


def reduced(path, duration):
    """Return ``path`` with X at the axis, and Z about zero and within REACH_M."""
    z = path(np.arange(0.0, duration, CYCLE_S))[1]
    middle, half = (z.max() + z.min()) / 2, np.ptp(z) / 2
    scale = min(1.0, REACH_M / half)

    def at(time):
        x, height, c = path(time)
        return np.zeros_like(x), scale * (height - middle), c

    return at


def ripple(plan, moved, time):
    """Return what the planner adds to ``moved`` at ``time`` (n,), and the same a quarter late."""
    off = plan.motion(time)[1] - moved(time)[1]
    return off, np.imag(hilbert(off))


def rehearsed(bag, plan, path, moved):
    """Return the lag [s] that the filter left, and the gains (2,) of the ripple of the segments.

    plan, path, moved: of the rehearsal;  bag: as recorded; time is that of its spindle
    """
    with bags.BagReader(Path(bag)) as reader:
        c = np.concatenate([block.c for _, block in reader.records(AXES_TOPIC)])
        blocks = [block for _, block in reader.records(DISTANCE_TOPIC)]
    distance = np.concatenate([block.distance for block in blocks])
    time = (c - plan.c[0]) / (plan.c[-1] - plan.c[0]) * plan.time[-1]
    there = np.flatnonzero((time > 0.5) & (time < plan.time[-1] - 0.5))
    read = np.concatenate([block.ok for block in blocks])[there]
    time, distance = time[there], distance[there]
    z = path(time)[1]
    parts = (z, np.gradient(z, time), *ripple(plan, moved, time), np.ones_like(z), time)
    columns = np.stack(parts, axis=1) / (sizes := np.max(np.abs(parts), axis=1))
    found = np.linalg.lstsq(columns[read], distance[read], rcond=None)[0] / sizes
    return -found[1] / found[0], found[2:4] / found[0]


def main(command, steps, surface, rpm, radius, turns, out, calibration=None, rehearsal=None):
    """Write the program, print and return what is predicted without and with the filter.

    With a calibration but no rehearsal the latter is least, median and most: all but 5 % of the
    lag's errors.
    """
    axes, measures = commanded(Path(command))
    with bags.BagReader(Path(steps)) as reader:
        encoder = np.concatenate([block.z for _, block in reader.records(AXES_TOPIC)])
    there = np.flatnonzero(measures)
    taps = servo(axes.z[there[0] : there[-1] + 1], encoder)
    known = load_calibration(calibration) if calibration else None
    probe = known.dynamics.response if known else None
    rpm, radius, turns = float(rpm), float(radius), float(turns)
    design = ScanDesign(rpm=rpm, start=radius, end=radius - turns * 2e-4, pitch=2e-4)
    path = partial(scan_path, design, load_surface(surface))
    plain = plan_path(path, design.duration, CYCLE_S, BOUND_M)
    before = predicted(plain, path, taps, probe)
    moved, worst = precompensated(path, design.duration, taps, probe)
    plan = plan_path(moved, design.duration, CYCLE_S, BOUND_M)
    after = predicted(plan, path, taps, probe)
    if known:
        # As many turns as its duration takes, over the same radii.
        longer = replace(design, pitch=design.pitch * design.duration / REHEARSED_S)
        small = reduced(partial(scan_path, longer, load_surface(surface)), longer.duration)
        small_moved, _ = precompensated(small, longer.duration, taps, probe)
        trial = planned_at(small_moved, longer.duration, plan.segment, CYCLE_S)
        name = Path(out).with_stem(f"{Path(out).stem}_rehearsal")
        name.write_text(path_gcode(trial, [f"rehearsal of {Path(out).name}: X at the axis"]))
    if rehearsal:
        lag, gains = rehearsed(rehearsal, trial, small, small_moved)
        print(f"lag corrected by {lag * 1e6:.3g} us")

        def probe(frequency):
            return known.dynamics.response(frequency) * np.exp(-2j * np.pi * frequency * lag)

        moved, worst = precompensated(path, design.duration, taps, probe)
        plan = planned_at(moved, design.duration, plan.segment, CYCLE_S)
        time = np.arange(0.5, plan.time[-1] - 0.5, CYCLE_S)
        after = float(np.std(gains @ ripple(plan, moved, time)))
    Path(out).write_text(path_gcode(plan, [f"precompensated scan at {rpm:g} rpm"]))
    print(f"off the path: {before * 1e9:.4g} nm rms before, {after * 1e9:.4g} nm after, predicted")
    if known and not rehearsal:
        speed = float(np.std(np.diff(plan.height) / plan.segment))
        off = speed * low_frequency_delay_uncertainty(known.dynamics, known.covariance)
        # The error of the lag, normal with this standard deviation, adds its square.
        middle, most = (float(np.hypot(after, k * off)) for k in (MEDIAN, COVERED))
        print(f"with the error of the lag {middle * 1e9:.3g} nm, "
              f"{after * 1e9:.3g} to {most * 1e9:.3g} nm (95 %)")  # fmt: skip
        after = (after, middle, most)
    print(f"acceleration of Z at most {worst:.3g} m/s²")
    return plain, plan, before, after


if __name__ == "__main__":
    main(*sys.argv[1:])
