"""Filter the commands of a scan so that the encoder, or the probe, is where the path has it.

    python precompensate.py COMMAND.mcap STEPS.mcap SURFACE.yaml RPM RADIUS TURNS OUT.nc [CAL.json]

The response from command to encoder is fitted to the step test (COMMAND.mcap: as commanded,
STEPS.mcap: as measured); with CAL.json the probe is to follow, by the calibrated response from
encoder to probe. The commands are the path through the inverse response, which is limited to the
band below; the path is known beforehand, so the inverse need not be causal.
"""

import sys
from functools import partial
from pathlib import Path

import numpy as np
from behind import commanded

from omsm_ros.core.adjustment import ScanDesign
from omsm_ros.core.kinematics.planner import plan_path
from omsm_ros.core.lti.frequency_response import low_frequency_delay_uncertainty
from omsm_ros.io import bags
from omsm_ros.io.calibration_file import load_calibration
from omsm_ros.io.descriptions import load_surface
from omsm_ros.io.gcode_file import path_gcode
from omsm_ros.io.topics import AXES_TOPIC
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


def response(taps, frequency, calibration=None):
    """Return the response from command to encoder, or with a calibration to the probe."""
    turning = np.exp(-2j * np.pi * CYCLE_S * np.outer(frequency, np.arange(TAPS)))
    found = turning @ taps
    return found * calibration.dynamics.response(frequency) if calibration else found


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
    lag = -np.angle(of(np.array([0.01]))[0]) / (2 * np.pi * 0.01)
    static = of(np.array([0.0]))[0].real
    return time, moved + static * np.polynomial.polynomial.polyval(time - lag, slow)


def inverse(taps, calibration=None):
    """Return the inverse response as a function of frequency, limited to BAND_HZ."""

    def of(frequency):
        low, high = BAND_HZ
        kept = 0.5 + 0.5 * np.cos(np.pi * np.clip((frequency - low) / (high - low), 0, 1))
        return kept / response(taps, np.minimum(frequency, high), calibration)

    return of


def precompensated(path, duration, taps, calibration=None):
    """Return the path with Z filtered, and the largest acceleration of Z [m/s²].

    Raises ValueError where Z would exceed LARGEST_ACCELERATION.
    """
    time, z = filtered(path, duration, inverse(taps, calibration))
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


def predicted(plan, path, taps, calibration=None):
    """Return the rms [m] by which the encoder, or the probe, will be off the path."""
    time = np.arange(int(plan.time[-1] / CYCLE_S)) * CYCLE_S
    z = plan.motion(time)[1]
    moved = np.convolve(z - z[0], taps)[: len(z)] + taps.sum() * z[0]
    if calibration:
        frequency = np.fft.rfftfreq(len(z), CYCLE_S)
        # The dynamics act on what is smooth; a line is taken out so that both ends meet.
        line = np.linspace(moved[0], moved[-1], len(z))
        dynamics = calibration.dynamics
        moved = np.fft.irfft(np.fft.rfft(moved - line) * dynamics.response(frequency), len(z))
        moved = moved + line - (line[1] - line[0]) / CYCLE_S * dynamics.low_frequency_delay
    off = (moved - path(time)[1])[500:-500]
    return float(np.std(off))


def main(command, steps, surface, rpm, radius, turns, out, calibration=None):
    """Write the program, print and return what is predicted without and with the filter.

    With a calibration the latter is least, median and most: all but 5 % of the lag's errors.
    """
    axes, measures = commanded(Path(command))
    with bags.BagReader(Path(steps)) as reader:
        encoder = np.concatenate([block.z for _, block in reader.records(AXES_TOPIC)])
    there = np.flatnonzero(measures)
    taps = servo(axes.z[there[0] : there[-1] + 1], encoder)
    known = load_calibration(calibration) if calibration else None
    rpm, radius, turns = float(rpm), float(radius), float(turns)
    design = ScanDesign(rpm=rpm, start=radius, end=radius - turns * 2e-4, pitch=2e-4)
    path = partial(scan_path, design, load_surface(surface))
    plain = plan_path(path, design.duration, CYCLE_S, BOUND_M)
    moved, worst = precompensated(path, design.duration, taps, known)
    plan = plan_path(moved, design.duration, CYCLE_S, BOUND_M)
    Path(out).write_text(path_gcode(plan, [f"precompensated scan at {rpm:g} rpm"]))
    before, after = (predicted(p, path, taps, known) for p in (plain, plan))
    print(f"off the path: {before * 1e9:.4g} nm rms before, {after * 1e9:.4g} nm after, predicted")
    if known:
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
