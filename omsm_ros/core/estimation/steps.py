"""Detect the steps in a motion, and split it between them.

No number, size, direction or rate of steps is assumed. A motion without plateaus (a chirp, a scan)
has no edges; it can be used for identification too.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import special

from omsm_ros.core.streams.blocks import BoolArray, FloatArray
from omsm_ros.core.streams.motion_record import MotionRecord
from omsm_ros.errors import StepTestError

# A fit of one parameter with offset, drift and gain needs a multiple of its four unknowns.
LEAST_SAMPLES = 50
# A step test of ten seconds at 70 kHz; each takes 1.3 kB in a fit and its covariance.
_MOST_SAMPLES = 800_000
# Far beyond the range of any probe.
_GREATEST_TRAVEL_M = 20e-3
# Motion exceeds the noise of the encoder by this factor, and this part of the travel.
NOISE_FACTOR = 20.0
TRAVEL_PART = 2e-3
# Orders of differences from which noise is estimated: the motion vanishes in the higher ones.
_DIFFERENCES = (2, 4, 6, 8)
# Share of second differences that are zero above which a signal mostly repeats its value, and
# samples of a window: at 0.2 steps of noise it has two changes.
_REPEATING, _WINDOW = 0.1, 200
# The axis is stationary if it stays in place for this time; then an edge ends.
_STATIONARY_S = 20e-3


@dataclass(frozen=True, slots=True)
class Edge:
    """A move from rest to rest: samples ``start`` to ``stop`` (exclusive), ``height`` [m]."""

    start: int
    stop: int
    height: float


@dataclass(frozen=True, eq=False)
class Steps:
    """The edges of a motion (n,) and its noise.

    moving: True from an edge's start to its stop, shape (n,)
    noise: standard deviation of one encoder sample [m]
    travel: [m]
    """

    edges: tuple[Edge, ...]
    moving: BoolArray
    noise: float
    travel: float


def sample_noise(values: FloatArray) -> float:
    """Return the standard deviation of white noise on a smooth signal, from its differences.

    Motion adds to the differences of each order, so the smallest estimate is taken. Each is a
    median, which the few samples at edges do not change. Where a signal mostly repeats its value,
    because its steps exceed its noise, the median is of windows without travel.
    """
    second = np.diff(values, 2)
    size, rounding = np.abs(second), 1e-9 * float(np.max(np.abs(values), initial=0.0))
    if len(second) >= _WINDOW and np.mean(size <= rounding) > _REPEATING:
        windows = second[: len(second) // _WINDOW * _WINDOW].reshape(-1, _WINDOW)
        moved = np.abs(np.diff(values[: len(second) + 1 : _WINDOW]))[: len(windows)]
        step = np.min(size[size > rounding], initial=np.inf)
        rests = windows[: len(moved)][moved <= 1.5 * step]
        return float(np.sqrt(np.median(np.mean(rests**2, axis=1)) / 6)) if len(rests) else 0.0
    orders = [order for order in _DIFFERENCES if order < len(values)]
    # MAD of a normal distribution is 0.6745 σ; k-th differences have variance C(2k, k) σ².
    middles = [float(np.median(np.abs(np.diff(values, order)))) for order in orders]
    units = [0.6745 * float(np.sqrt(special.comb(2 * order, order))) for order in orders]
    return min((m / u for m, u in zip(middles, units, strict=True)), default=0.0)


def moves(z: FloatArray) -> bool:
    """Return whether ``z`` (n,) [m] travels farther than its noise."""
    return float(np.ptp(z)) > max(NOISE_FACTOR * sample_noise(z), 1e-12)


def find_steps(z: FloatArray, sample_period: float) -> Steps:
    """Return the edges of ``z`` (n,) [m] sampled every ``sample_period`` [s].

    Raises StepTestError when the axis does not move, or moves farther than any probe sees.
    """
    _check_length(len(z))
    noise, travel = sample_noise(z), float(np.ptp(z))
    if travel > _GREATEST_TRAVEL_M:
        raise StepTestError("estimation.long_travel", travel=travel, most=_GREATEST_TRAVEL_M)
    if travel <= max(NOISE_FACTOR * noise, 1e-12):
        raise StepTestError("estimation.no_motion", travel=travel, noise=noise)
    width = min(max(round(_STATIONARY_S / sample_period), 2), len(z) - 1)
    changes = np.abs(z[width:] - z[:-width]) > max(NOISE_FACTOR * noise, TRAVEL_PART * travel)
    # A change between k and k + width may lie anywhere between, so the whole window counts.
    moving = extended(np.concatenate([changes, np.zeros(width, np.bool_)]), width)
    return Steps(_edges(z, moving), moving, noise, travel)


def extended(flags: BoolArray, samples: int) -> BoolArray:
    """Return True where ``flags`` (n,) is, and for ``samples`` after it, (n,)."""
    count = np.concatenate([[0], np.cumsum(flags)])
    before = np.maximum(np.arange(len(flags)) - samples, 0)
    return np.asarray(count[1:] > count[before])


def _edges(z: FloatArray, moving: BoolArray) -> tuple[Edge, ...]:
    flags = np.diff(np.concatenate([[0], moving.astype(np.int8), [0]]))
    starts, stops = np.flatnonzero(flags == 1), np.flatnonzero(flags == -1)
    if len(starts) == 0:
        return ()
    bounds = np.concatenate([[0], np.ravel(np.column_stack([starts, stops])), [len(z)]])
    levels = [
        float(np.mean(z[a:b])) if b > a else float(z[min(a, len(z) - 1)])
        for a, b in zip(bounds[::2], bounds[1::2], strict=True)
    ]
    return tuple(
        Edge(int(start), int(stop), levels[i + 1] - levels[i])
        for i, (start, stop) in enumerate(zip(starts, stops, strict=True))
        if start > 0 and stop < len(z)
    )


def segments(steps: Steps, samples: int, least: int = 4) -> list[tuple[int, int]]:
    """Return the record cut midway between edges, one edge a piece.

    With fewer than ``least`` edges it is cut into twice as many equal parts instead.
    """
    if len(steps.edges) >= least:
        middles = [(before.stop + after.start) // 2 for before, after in pairwise(steps.edges)]
        cuts = [0, *middles, samples]
    else:
        cuts = [round(samples * i / (2 * least)) for i in range(2 * least + 1)]
    return list(pairwise(cuts))


def check_usable(record: MotionRecord) -> None:
    """Raise StepTestError for too few usable samples, or too many samples."""
    _check_length(len(record))
    if len(record) > _MOST_SAMPLES:
        raise StepTestError("estimation.many_samples", samples=len(record), most=_MOST_SAMPLES)
    usable = int(np.sum(record.ok))
    if usable < LEAST_SAMPLES:
        raise StepTestError(
            "estimation.few_usable", usable=usable, samples=len(record), counts=dict(record.counts)
        )


def _check_length(samples: int) -> None:
    if samples < LEAST_SAMPLES:
        raise StepTestError("estimation.few_samples", samples=samples, least=LEAST_SAMPLES)
