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

What is predicted is what will be measured: the motion off the path and the noise of the encoder, or
of the probe. The responses are known with uncertainty, so the motion is predicted for many of those
that they may be: the middle, and the limits of 95 %.

OUT.csv has the path without its ends, for ``behind.py --judge``.
"""

import sys
from configparser import ConfigParser
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from behind import commanded
from scipy.linalg import cholesky, solve_triangular
from scipy.signal import hilbert

from omsm_ros.core.adjustment import ScanDesign
from omsm_ros.core.kinematics.planner import plan_path, planned_at
from omsm_ros.core.lti.frequency_response import relative_response_jacobian
from omsm_ros.io import bags
from omsm_ros.io.calibration_file import load_calibration
from omsm_ros.io.descriptions import load_surface
from omsm_ros.io.gcode_file import path_gcode
from omsm_ros.io.topics import AXES_TOPIC, DISTANCE_TOPIC
from omsm_ros.pipelines.plan_scans import scan_path

CYCLE_S = 1e-3
# Cycles of the response of the encoder after a command; and before it, for the command between two
# cycles depends on the next ones.
TAPS, AHEAD = 100, 2
# Responses that are assumed before one is measured: ratio of each tap to the one before it, and
# variance of the first.
DECAYS, SIZES = (0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.95), (0.1, 3.0, 100.0)
# The inverse is whole up to the first and ends at the second frequency [Hz].
BAND_HZ = (60.0, 120.0)
# The path is continued by this time at both ends, where the filter settles [s].
SETTLE_S = 1.0
BOUND_M = 2e-8
# Z of the rehearsal: half of its largest travel [m], and its duration [s].
REACH_M, REHEARSED_S = 4e-5, 20.0
# Responses for which the motion is predicted; how far the gain of one may be from the calibrated.
DRAWS, MOST_RELATIVE = 100, 1.0
# Time at both ends that is not counted [s].
EDGE_S = 0.5


class Response(NamedTuple):
    """Impulse response from command to encoder (AHEAD + TAPS,), and what is not known of it.

    factor: F, the taps are ``taps + F n`` with standard normal n;  noise: of the encoder [m]
    """

    taps: np.ndarray
    factor: np.ndarray
    noise: float


class Prediction(NamedTuple):
    """rms off the path [m]: middle, least and most of 95 %.

    seen: as measured, (3,);  motion: without the noise, (3,);  noise: of what measures it
    """

    seen: np.ndarray
    motion: np.ndarray
    noise: float

    @classmethod
    def of(cls, noise, drawn, random):
        """Return the prediction by motions off the path, drawn (n,) each cycle."""
        rms = [(rms_of(d + noise * random.normal(size=len(d))), rms_of(d)) for d in drawn]
        return cls(*np.percentile(rms, [50, 2.5, 97.5], axis=0).T, noise)

    def __str__(self):
        words = ["{:.4g} nm ({:.4g} to {:.4g} nm)".format(*v * 1e9) for v in self[:2]]
        return f"{words[0]} as measured; motion {words[1]}, noise {self.noise * 1e9:.3g} nm"


def rms_of(off):
    """Return the rms of ``off`` (n,) each cycle, without the ends."""
    edge = round(EDGE_S / CYCLE_S)
    return float(np.std(off[edge:-edge]))


def servo(command, encoder):
    """Return the response from command to encoder (n,) each.

    The taps decay; how fast, and whether smoothly, is what makes the encoder most likely (Chen,
    Ohlsson and Ljung, Automatica 48 (2012) 1525): where the step test moves little, as at the
    frequency of the segments, least squares alone would take noise for a response.
    """
    command, encoder = command - command[0], encoder - encoder[:100].mean()
    count = AHEAD + TAPS
    padded = np.concatenate([np.zeros(TAPS - 1), command, np.full(AHEAD, command[-1])])
    lagged = np.lib.stride_tricks.sliding_window_view(padded, count)[:, ::-1]
    square, seen = lagged.T @ lagged, lagged.T @ encoder
    noise = float(np.std(encoder - lagged @ np.linalg.lstsq(square, seen, rcond=1e-12)[0]))
    place = np.arange(count)
    later = np.maximum.outer(place, place)

    def likely(smooth, decay, size):
        prior = decay**later
        if smooth:
            prior = decay ** (np.add.outer(place, place) + later) / 2 - decay ** (3 * later) / 6
        share, axes = np.linalg.eigh(size * prior)
        root = axes * np.sqrt(np.maximum(share, 0.0))  # smallest shares are rounding
        inner = root.T @ square @ root / noise**2 + np.eye(count)
        found = np.linalg.solve(inner, root.T @ seen / noise**2)
        evidence = seen @ root @ found / noise**2 - np.linalg.slogdet(inner)[1]
        return evidence, root, inner, found

    _, root, inner, found = max(
        (likely(*one) for one in product((False, True), DECAYS, SIZES)), key=lambda one: one[0]
    )
    factor = root @ solve_triangular(cholesky(inner, lower=True), np.eye(count), lower=True).T
    return Response(root @ found, factor, noise)


def response(taps, frequency, probe=None):
    """Return the response from command to encoder, or with that of the probe to the probe."""
    cycles = np.arange(len(taps)) - AHEAD
    found = np.exp(-2j * np.pi * CYCLE_S * np.outer(frequency, cycles)) @ taps
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


def limits():
    """Return the largest speed [m/s] and acceleration [m/s²] of Z in the configuration."""
    ini = ConfigParser(strict=False)
    ini.read(Path(__file__).with_name("cell.ini"))
    return tuple(float(ini["AXIS_Z"][f"MAX_{n}"]) * 1e-3 for n in ("VELOCITY", "ACCELERATION"))


def precompensated(path, duration, taps, probe=None):
    """Return the path with Z filtered, and the largest acceleration of Z [m/s²].

    Raises ValueError where Z would exceed half of its speed or acceleration.
    """
    time, z = filtered(path, duration, inverse(taps, probe))
    within = (time > -SETTLE_S / 3) & (time < duration + SETTLE_S / 3)
    needed = [float(np.max(np.abs(np.diff(z[within], k)))) / CYCLE_S**k for k in (1, 2)]
    for name, found, most in zip(("m/s", "m/s²"), needed, limits(), strict=True):
        if found > most / 2:
            raise ValueError(
                f"Z would need {found:.3g} {name}, allowed is half of {most:.3g}; give a slower "
                "spindle"
            )

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

    return moved, needed[1]


def through(z, taps, probe=None):
    """Return where the encoder, or the probe, is while ``z`` (n,) is commanded."""
    held = np.concatenate([z[:1].repeat(TAPS - 1), z, z[-1:].repeat(AHEAD)])
    moved = np.convolve(held, taps, "valid")
    if probe is None:
        return moved
    # The dynamics act on what is smooth; a line is taken out so that both ends meet.
    line = np.linspace(moved[0], moved[-1], len(z))
    spectrum = np.fft.rfft(moved - line) * probe(np.fft.rfftfreq(len(z), CYCLE_S))
    return np.fft.irfft(spectrum, len(z)) + line - (line[1] - line[0]) / CYCLE_S * lag_of(probe)


class Probes:
    """Responses from encoder to probe that may be true: by the covariances of a calibration.

    That of errors which the calibration does not detect is a bound, and they are often smaller.
    """

    def __init__(self, known):
        """known: a calibration, None for the encoder itself."""
        self.known = known
        if known:
            parts = known.noise_covariance, known.undetected_error_covariance
            found = [np.linalg.eigh(part) for part in parts]
            self.noise, self.undetected = (t * np.sqrt(np.maximum(s, 0.0)) for s, t in found)

    def drawn(self, random, seen=None):
        """Return a function of frequency.

        seen: frequency [Hz] and, taking the place of those of the draw there, the lag [s] and the
            share by which the gain is larger than calibrated [1]
        """
        if not self.known:
            return None
        dynamics, (noise, error) = self.known.dynamics, random.normal(size=(2, len(self.noise)))
        off = self.noise @ noise + random.uniform() * self.undetected @ error

        def relative(frequency):
            real, imag = relative_response_jacobian(dynamics, np.asarray(frequency)) @ off
            return real + 1j * imag

        late = larger = 0.0
        if seen is not None:
            slow = relative(np.array(seen[:1]))[0]
            late = seen[1] + slow.imag / (2 * np.pi * seen[0])
            larger = seen[2] - slow.real

        def of(frequency):
            found = relative(frequency) - 2j * np.pi * frequency * late + larger
            gain = np.clip(found.real, -MOST_RELATIVE, MOST_RELATIVE)
            return dynamics.response(frequency) * np.exp(gain + 1j * found.imag)

        return of


def predicted(plan, path, follows, probes, noise, seed=1):
    """Return the Prediction for a planned path: of the encoder, or of the probe."""
    time = np.arange(int(plan.time[-1] / CYCLE_S)) * CYCLE_S
    z, wanted, random = plan.motion(time)[1], path(time)[1], np.random.default_rng(seed)

    def off():
        taps = follows.taps + follows.factor @ random.normal(size=len(follows.taps))
        return through(z, taps, probes.drawn(random)) - wanted

    return Prediction.of(noise, (off() for _ in range(DRAWS)), random)


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


class Rehearsal(NamedTuple):
    """Lag, gain and noise that a rehearsal shows.

    frequency: of the waves of the path [Hz]
    found: (4,): lag that the filter left [s]; relative excess of the gain over its calibration [1];
        gains of the ripple of the segments, in phase and a quarter late [1]
    factor: as of Response;  noise: of the probe [m]
    """

    frequency: float
    found: np.ndarray
    factor: np.ndarray
    noise: float


def rehearsed(bag, plan, path, moved, static):
    """Return the Rehearsal of a recording.

    plan, path, moved: of the rehearsal;  bag: as recorded; time is that of its spindle
    static: static gain of the probe and its uncertainty [1]
    """
    with bags.BagReader(Path(bag)) as reader:
        c = np.concatenate([block.c for _, block in reader.records(AXES_TOPIC)])
        blocks = [block for _, block in reader.records(DISTANCE_TOPIC)]
    distance = np.concatenate([block.distance for block in blocks])
    time = (c - plan.c[0]) / (plan.c[-1] - plan.c[0]) * plan.time[-1]
    there = np.flatnonzero((time > EDGE_S) & (time < plan.time[-1] - EDGE_S))
    there = there[np.concatenate([block.ok for block in blocks])[there]]
    time, distance = time[there], distance[there]
    z = path(time)[1]
    parts = (z, np.gradient(z, time), *ripple(plan, moved, time), np.ones_like(z), time)
    columns = np.stack(parts, axis=1) / (sizes := np.max(np.abs(parts), axis=1))
    found = np.linalg.lstsq(columns, distance, rcond=None)[0]
    noise = float(np.std(distance - columns @ found))
    gain, late, *added = found[:4] / sizes[:4]
    waves = z - np.polynomial.Polynomial.fit(time, z, 1)(time)
    frequency = float(np.std(np.gradient(waves, time)) / np.std(waves) / (2 * np.pi))
    seen = np.array([-late / gain, abs(gain) / static[0] - 1, *np.divide(added, gain)])
    to = np.array([-1 / gain, np.sign(gain) / static[0], 1 / gain, 1 / gain])
    factor = np.linalg.inv(cholesky(columns.T @ columns, lower=True)).T[[1, 0, 2, 3]] * noise
    factor = factor * (to / sizes[[1, 0, 2, 3]])[:, np.newaxis]
    rest = np.array([0.0, static[1] / static[0], 0.0, 0.0])
    return Rehearsal(frequency, seen, np.column_stack([factor, rest]), noise / abs(gain))


def predicted_after(rehearsal, plan, path, moved, follows, probes, seed=1):
    """Return the Prediction for the probe, with the lag and the ripple of the rehearsal."""
    time = np.arange(int(plan.time[-1] / CYCLE_S)) * CYCLE_S
    smooth, wanted = moved(time)[1], path(time)[1]
    added, random = np.array(ripple(plan, moved, time)), np.random.default_rng(seed)

    def off():
        taps = follows.taps + follows.factor @ random.normal(size=len(follows.taps))
        seen = rehearsal.factor @ random.normal(size=rehearsal.factor.shape[1]) + rehearsal.found
        probe = probes.drawn(random, (rehearsal.frequency, *seen[:2]))
        return through(smooth, taps, probe) + seen[2:] @ added - wanted

    return Prediction.of(rehearsal.noise, (off() for _ in range(DRAWS)), random)


def main(command, steps, surface, rpm, radius, turns, out, calibration=None, rehearsal=None):
    """Write the program; print and return the Predictions without and with the filter."""
    axes, measures = commanded(Path(command))
    with bags.BagReader(Path(steps)) as reader:
        encoder = np.concatenate([block.z for _, block in reader.records(AXES_TOPIC)])
    there = np.flatnonzero(measures)
    follows = servo(axes.z[there[0] : there[-1] + 1], encoder)
    known = load_calibration(calibration) if calibration else None
    probes, probe = Probes(known), known.dynamics.response if known else None
    noise = follows.noise
    if known:
        noise = known.certificate.residual.noise_m / abs(known.static_gain)
    rpm, radius, turns = float(rpm), float(radius), float(turns)
    design = ScanDesign(rpm=rpm, start=radius, end=radius - turns * 2e-4, pitch=2e-4)
    path = partial(scan_path, design, load_surface(surface))
    plain = plan_path(path, design.duration, CYCLE_S, BOUND_M)
    before = predicted(plain, path, follows, probes, noise)
    moved, worst = precompensated(path, design.duration, follows.taps, probe)
    plan = plan_path(moved, design.duration, CYCLE_S, BOUND_M)
    after = predicted(plan, path, follows, probes, noise)
    if known:
        # As many turns as its duration takes, over the same radii.
        longer = replace(design, pitch=design.pitch * design.duration / REHEARSED_S)
        small = reduced(partial(scan_path, longer, load_surface(surface)), longer.duration)
        small_moved, _ = precompensated(small, longer.duration, follows.taps, probe)
        trial = planned_at(small_moved, longer.duration, plan.segment, CYCLE_S)
        name = Path(out).with_stem(f"{Path(out).stem}_rehearsal")
        name.write_text(path_gcode(trial, [f"rehearsal of {Path(out).name}: X at the axis"]))
    if rehearsal:
        static = abs(known.static_gain), known.static_gain_uncertainty
        seen = rehearsed(rehearsal, trial, small, small_moved, static)
        lag = seen.found[0]
        print(f"lag corrected by {lag * 1e6:.3g} us")

        def probe(frequency):
            return known.dynamics.response(frequency) * np.exp(-2j * np.pi * frequency * lag)

        moved, worst = precompensated(path, design.duration, follows.taps, probe)
        plan = planned_at(moved, design.duration, plan.segment, CYCLE_S)
        after = predicted_after(seen, plan, path, moved, follows, probes)
    Path(out).write_text(path_gcode(plan, [f"precompensated scan at {rpm:g} rpm"]))
    time = np.arange(EDGE_S, plan.time[-1] - EDGE_S, CYCLE_S)
    wanted = np.stack([time, *path(time)], axis=1)
    np.savetxt(Path(out).with_suffix(".csv"), wanted, delimiter=",", header="time_s,x_m,z_m,c_rad")
    print(f"off the path, rms, before: {before}\nafter: {after}")
    print(f"acceleration of Z at most {worst:.3g} m/s²")
    return plain, plan, before, after


if __name__ == "__main__":
    main(*sys.argv[1:])
