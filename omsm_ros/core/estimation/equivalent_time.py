"""Find a mode beyond half the sampling rate from sharp edges at different fractions of a sample.

Edges that start at other fractions of the sample period are sampled at other times since their
start: together they are one edge on a finer grid (equivalent-time sampling). The starts are fitted
to the encoder, through an axis of second order that follows an S-curve; a free curve through the
samples would absorb errors of the starts that repeat with the sample period.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
import scipy  # whose parts are loaded when they are used
from scipy import optimize, signal

from omsm_ros.core.estimation.noise import reading_step
from omsm_ros.core.estimation.steps import Edge, find_steps
from omsm_ros.core.kinematics.trajectories import s_curve
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.streams.motion_record import MotionRecord
from omsm_ros.errors import Notice
from omsm_ros.linear_algebra import least_squares

# Samples of an edge before and after the middle of its height, and those of the level before it.
_BEFORE, _AFTER, _LEVEL = 15, 45, slice(-30, -6)
# Values of the fine grid in a sample period: cubics between them are exact to 1e-6.
_FINE = 50
_LEAST_EDGES = 8
# Largest part of the sample period without an edge, and encoder residual over its noise.
_LARGEST_GAP, _MOST_MISFIT = 0.3, 3.0
# Start of the search: axis [Hz] and rise [s]; mode [Hz], damping, and a real pole [rad/s].
_AXES = ((50.0, 2e-4), (200.0, 2e-4), (100.0, 5e-3))
_MODES_HZ = (150.0, 250.0, 400.0, 600.0, 800.0, 1000.0, 1300.0, 1800.0)
_REAL = (600.0, 6000.0, 40_000.0)
# Latency of the probe [samples].
_LATENCIES = -1.0, 3.0
# Fall of χ² by the mode, and relative uncertainty of its frequency, from which it is there.
_LEAST_FALL, _MOST_UNCERTAIN = 25.0, 0.2
# Damping ratio from which two poles are no resonance.
_MOST_DAMPED = 0.9


@dataclass(frozen=True, slots=True, kw_only=True)
class FastMode:
    """Mode from edges in equivalent time; each uncertainty is k = 1, of noise alone.

    finding: what was found, or why nothing is known
    frequency: [Hz];  damping: ratio [1];  fall: of χ² by the mode
    reduced_chi_squared: of the probe, against its noise between the edges
    """

    finding: Notice
    frequency: float = float("nan")
    frequency_uncertainty: float = float("nan")
    damping: float = float("nan")
    damping_uncertainty: float = float("nan")
    fall: float = 0.0
    reduced_chi_squared: float = float("nan")


@dataclass(frozen=True, eq=False)
class _Edges:
    """Normalised edges (e, n): place [samples], encoder and probe [1]; their noise over height."""

    place: FloatArray
    encoder: FloatArray
    probe: FloatArray
    encoder_noise: float
    probe_noise: float
    half: FloatArray


def fast_mode(record: MotionRecord) -> FastMode:
    """Return the mode that sharp, dithered edges of a step test show.

    Raises StepTestError for a record without motion.
    """
    period, steps = record.sample_period, find_steps(record.z, record.sample_period)
    # With readings of the probe on the level before it, and of the edge itself.
    whole = [
        edge
        for edge in steps.edges
        if edge.start >= 40
        and edge.start + 80 < len(record)
        and np.mean(record.ok[edge.start + _LEVEL.start : edge.start + _LEVEL.stop]) > 0.5
        and record.ok[edge.start : edge.stop].any()
    ]
    if len(whole) < _LEAST_EDGES:
        few = Notice("estimation.few_edges", edges=len(whole), least=_LEAST_EDGES)
        return FastMode(finding=few)
    edges = _normalised(record, whole)
    grid = np.arange(-_BEFORE * _FINE, _AFTER * _FINE) / _FINE
    command, start, misfit = _axis(edges, grid, period)
    phase = np.sort(start % 1)
    gap = float(np.max(np.diff(np.r_[phase, phase[0] + 1])))
    if misfit > _MOST_MISFIT:
        return FastMode(finding=Notice("estimation.other_axis", misfit=misfit))
    if gap > _LARGEST_GAP:
        return FastMode(finding=Notice("estimation.not_dithered", gap=gap))
    return _mode(edges, grid, command, edges.place - start[:, np.newaxis], period)


def _normalised(record: MotionRecord, edges: list[Edge]) -> _Edges:
    place, encoder, probe, half, noise = [], [], [], [], []
    # The rounding of an encoder counts even where all its readings on a plateau are equal.
    rounding = reading_step(record.z) / np.sqrt(12)
    for edge in edges:
        level = slice(edge.start + _LEVEL.start, edge.start + _LEVEL.stop)
        u = (record.z - np.mean(record.z[level])) / edge.height
        y = -(record.distance - np.nanmean(record.distance[level])) / edge.height
        first = edge.start - 1 + int(np.argmax(u[edge.start - 1 : edge.stop + 1] >= 0.5))
        samples = np.arange(first - _BEFORE, first + _AFTER)
        half.append(first - 1 + (0.5 - u[first - 1]) / (u[first] - u[first - 1]))
        place.append(samples)
        encoder.append(u[samples])
        probe.append(np.where(record.ok[samples], y[samples], np.nan))
        noise.append((np.hypot(np.std(u[level]), rounding / edge.height), np.nanstd(y[level])))
    of_encoder, of_probe = np.sqrt(np.mean(np.square(noise), axis=0))
    return _Edges(
        np.array(place, np.float64), np.array(encoder), np.array(probe),
        float(of_encoder), float(of_probe), np.array(half),
    )  # fmt: skip


def _axis(edges: _Edges, grid: FloatArray, period: float) -> tuple[FloatArray, FloatArray, float]:
    """Return the edge on ``grid`` [samples], the starts (e,), and the residual over its noise."""
    step = period / _FINE
    start = edges.half - 1.5

    def edge(q: FloatArray) -> FloatArray:
        omega, damping, rise = np.exp(q)
        moved = s_curve(np.clip(grid * period / rise, 0.0, 1.0))
        system = ([omega**2], [1.0, 2 * damping * omega, omega**2])
        b, a, _ = signal.cont2discrete(system, step, "foh")
        return np.asarray(signal.lfilter(b.ravel(), a, moved))

    def residual(q: FloatArray) -> FloatArray:
        nonlocal start
        curve = scipy.interpolate.CubicSpline(grid, edge(q))
        slope = curve.derivative()
        for _ in range(6):
            at = np.clip(edges.place - start[:, np.newaxis], grid[0], grid[-1])
            left, along = edges.encoder - curve(at), slope(at)
            move = np.sum(left * along, axis=1) / np.maximum(np.sum(along**2, axis=1), 1e-12)
            start = np.clip(start - move, edges.half - 30, edges.half + 3)
        return np.asarray(left.ravel())

    found = []
    for frequency, rise in _AXES:
        start = edges.half - 1.5 - rise / period / 2
        first = np.log([2 * np.pi * frequency, 1.0, rise])
        bounds = np.log([30.0, 0.2, period / 20]), np.log([2e4, 5.0, 0.05])
        made = optimize.least_squares(residual, first, bounds=bounds, diff_step=1e-4)
        residual(made.x)
        found.append((made.cost, edge(made.x), start))
    cost, curve, start = min(found, key=lambda one: one[0])
    rms = np.sqrt(2 * cost / edges.encoder.size)
    return curve, start, float(rms / max(edges.encoder_noise, 1e-9))


@dataclass(frozen=True, eq=False)
class _ProbeFit:
    """Probe at places ``at`` (m,) [samples] of the edge ``command`` on ``grid``, over its noise."""

    at: FloatArray
    seen: FloatArray
    grid: FloatArray
    command: FloatArray
    step: float

    def _through(self, pole: complex, at: FloatArray) -> list[FloatArray]:
        """Return the edge, linear between values of the grid, through 1/(s - p) at ``at`` (m,)."""
        grown = np.exp(pole * self.step)
        end = (grown - 1 - pole * self.step) / (pole**2 * self.step)
        b = np.array([end, (grown - 1) / pole - end])
        moved = signal.lfilter(b, [1.0, -grown], self.command + 0j)
        before = np.minimum((at - self.grid[0]) * _FINE, len(self.grid) - 2).astype(np.int64)
        after = (at - self.grid[before]) * _FINE * self.step * pole
        change = np.diff(self.command)[before] / (self.step * pole)
        driven = self.command[before] * np.expm1(after) + change * (np.expm1(after) - after)
        moved = abs(pole) * (moved[before] * np.exp(after) + driven / pole)
        return [moved.real, moved.imag] if pole.imag else [moved.real]

    def residual(self, p: FloatArray) -> FloatArray:
        """Return the residual (m,) at p.

        p: latency [samples], log of a real pole [rad/s], and log of another one, or log frequency
            and damping of a mode
        """
        at = np.clip(self.at - p[0], self.grid[0], self.grid[-1])
        parts = [np.ones(len(at)), np.interp(at, self.grid, self.command)]
        unit = complex(-p[3], np.sqrt(1 - p[3] ** 2)) * 2 * np.pi if len(p) > 3 else complex(-1.0)
        for pole in (complex(-np.exp(p[1])), unit * np.exp(p[2])):
            parts += self._through(pole, at)
        columns = np.column_stack(parts)
        return np.asarray(self.seen - columns @ least_squares(columns, self.seen))


def _mode(
    edges: _Edges, grid: FloatArray, command: FloatArray, place: FloatArray, period: float
) -> FastMode:
    known = np.isfinite(edges.probe)
    seen = edges.probe[known] / edges.probe_noise
    residual = _ProbeFit(place[known], seen, grid, command, period / _FINE).residual
    tried = [np.array([0.0, np.log(a), np.log(f), 0.2]) for f in _MODES_HZ for a in _REAL]
    start = min(tried, key=lambda p: float(np.sum(residual(p) ** 2)))
    low, high = _LATENCIES
    least, most = np.log([10.0, 30.0]), np.log([1e6, 2.5 / period])
    bounds = [low, *least, 1e-3], [high, *most, 0.98]
    best = optimize.least_squares(residual, start, bounds=bounds)
    alone = [[0.0, *np.log(pair)] for pair in combinations(_REAL, 2)]
    without = min(2 * optimize.least_squares(residual, first).cost for first in alone)
    reduced = 2 * best.cost / (len(seen) - 9)
    sigma = np.sqrt(np.diag(np.linalg.pinv(best.jac.T @ best.jac)) * max(reduced, 1.0)).tolist()
    frequency, damping = float(np.exp(best.x[2])), float(best.x[3])
    values = {
        "frequency": frequency,
        "frequency_uncertainty": frequency * sigma[2],
        "damping": damping,
        "damping_uncertainty": sigma[3],
        "fall": float((without - 2 * best.cost) / max(reduced, 1.0)),
        "reduced_chi_squared": float(reduced),
    }
    code = "estimation.fast_mode" if reduced <= _MOST_MISFIT else "estimation.doubtful_fast_mode"
    if values["fall"] <= _LEAST_FALL or sigma[2] >= _MOST_UNCERTAIN or damping >= _MOST_DAMPED:
        code = "estimation.no_fast_mode"
    return FastMode(finding=Notice(code, **values), **values)
