"""Heights of a scan over time, path, radius and turns of the spindle."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from omsm_ros.core.kinematics.kinematics import workpiece_xy
from omsm_ros.core.streams.blocks import FloatArray, IntArray
from omsm_ros.errors import DataError

TIME, PATH, RADIUS, TURN = "time", "path", "radius", "turn"

LEAST_POINTS = 256
"""Fewest readings for an estimate of the noise floor."""

# A smaller rotation is noise of the spindle encoder [turns].
LEAST_TURN = 0.01
# Parts of a scan over which feed and speed are constant, to average encoder noise.
_STRETCHES = 200


@dataclass(frozen=True, eq=False, kw_only=True)
class ScanSignal:
    """Readings of a scan in the order of time, each array (n,), without lost samples.

    period: from reading to reading [s];  sample: count from the first
    height: of the surface [m];  path: travel of the probe over the part [m]
    radius: from the spindle axis [m];  turn: of the spindle [turns]
    """

    name: str
    period: float
    sample: IntArray
    height: FloatArray
    path: FloatArray
    radius: FloatArray
    turn: FloatArray

    def __len__(self) -> int:
        return len(self.sample)

    @property
    def rate(self) -> float:
        """Sampling rate [Hz]."""
        return 1.0 / self.period

    @property
    def time(self) -> FloatArray:
        """Time since the first sample [s], (n,)."""
        return np.asarray(self.sample * self.period, np.float64)

    @property
    def duration(self) -> float:
        """Time from the first sample to the end of the last [s]."""
        return float((self.sample[-1] - self.sample[0] + 1) * self.period)

    @property
    def turns(self) -> float:
        """Range of the rotation of the spindle [turns]."""
        return float(np.ptp(self.turn))


def scan_signal(
    name: str,
    period: float,
    readings: tuple[IntArray, FloatArray],
    axes: tuple[IntArray, FloatArray, FloatArray, FloatArray],
) -> ScanSignal:
    """Return the signal of a scan.

    readings: trigger counts (n,) and heights (n,) [m]
    axes: trigger counts (m,), slides x, y [m] and spindle c [rad], each (m,)

    Where the trigger restarts the longest run is used. Gaps of the axes are interpolated. Raises
    DataError for fewer than 256 points.
    """
    sample, height = _longest_run(*readings)
    count, x, y, c = _longest_run(*axes)
    known = np.isfinite(x) & np.isfinite(y) & np.isfinite(c)
    if len(sample) < LEAST_POINTS or np.count_nonzero(known) < LEAST_POINTS:
        raise DataError(
            "ripple.short_scan",
            name=name,
            readings=len(sample),
            positions=int(np.count_nonzero(known)),
            least=LEAST_POINTS,
        )
    count, x, y, c = (values[known] for values in (count, x, y, c))
    turn = unwrapped_angle(count, c) / (2 * np.pi)
    inside = (sample >= count[0]) & (sample <= count[-1])
    sample, height = sample[inside], height[inside]
    if len(sample) < LEAST_POINTS:
        raise DataError(
            "ripple.disjoint_counts", name=name, readings=len(sample), least=LEAST_POINTS
        )
    # The period is that of the readings, or a line would have an alias below half the rate.
    every = int(np.gcd.reduce(np.diff(sample)))
    columns = (track(x, y, turn), np.hypot(x, y), turn)
    path, radius, turn = (np.interp(sample, count, values) for values in columns)
    return ScanSignal(
        name=name,
        period=every * period,
        sample=(sample - sample[0]) // every,
        height=height,
        path=path,
        radius=radius,
        turn=turn,
    )


def unwrapped_angle(count: IntArray, angle: FloatArray) -> FloatArray:
    """Return the angle (n,) [rad] of an encoder, unwrapped over its turns.

    An encoder that restarts each turn is recognised by its range. Over a gap of the trigger
    ``count`` (n,) the median speed of the spindle is assumed.
    """
    step, gap = np.diff(angle), np.diff(count)
    if np.ptp(angle) > 2 * np.pi * 1.001 or not np.any(abs(step) > np.pi):
        return angle
    next_ones = gap == np.min(gap)
    pace = np.median(np.remainder(step[next_ones] + np.pi, 2 * np.pi) - np.pi) / np.min(gap)
    expected = pace * gap
    whole = np.rint((step - expected) / (2 * np.pi)) * 2 * np.pi
    return np.asarray(np.r_[angle[0], angle[0] + np.cumsum(step - whole)])


def track(x: FloatArray, y: FloatArray, turn: FloatArray) -> FloatArray:
    """Return the travel of the probe over the part [m], (n,).

    x, y: of the slides [m];  turn: of the spindle [turns]

    Encoder noise must not accumulate: on a turning part ``ds = √(r² + (dr/dc)²) dc`` with a smooth
    dr/dc; otherwise each step is projected on the smooth direction of the motion.
    """
    if np.ptp(turn) > LEAST_TURN:
        angle = 2 * np.pi * turn
        radius = np.hypot(x, y)
        knots, slopes = _slopes(angle, radius)
        lever = np.hypot(radius, np.interp(np.arange(len(x)), knots, slopes))
        steps = 0.5 * (lever[1:] + lever[:-1]) * np.diff(angle)
        return np.asarray(np.r_[0.0, np.cumsum(steps)] * np.sign(angle[-1] - angle[0]))
    across, along = workpiece_xy(x, y, 2 * np.pi * turn)
    place = np.arange(len(x), dtype=np.float64)
    pace = [np.interp(place, *_slopes(place, p)) for p in (across, along)]
    speed = np.hypot(*pace)
    moving = speed > 0
    unit = [np.divide(p, speed, out=np.zeros_like(p), where=moving) for p in pace]
    steps = sum(
        np.diff(p) * 0.5 * (u[1:] + u[:-1]) for p, u in zip((across, along), unit, strict=True)
    )
    return np.asarray(np.r_[0.0, np.cumsum(steps)])


def _slopes(over: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the middles of parts of the scan, and the slope of ``values`` over ``over`` there."""
    parts = min(_STRETCHES, len(over) // 8)
    cuts = np.linspace(0, len(over), parts + 1).astype(np.int64)
    length = np.diff(cuts)
    mean = [np.add.reduceat(v, cuts[:-1]) / length for v in (over, values)]
    run = np.gradient(mean[0])
    slopes = np.gradient(mean[1]) / np.where(run == 0, np.inf, run)
    return (cuts[:-1] + cuts[1:] - 1) / 2, slopes


def _longest_run(count: IntArray, *columns: FloatArray) -> tuple[IntArray, ...]:
    cuts = np.r_[0, np.flatnonzero(np.diff(count) <= 0) + 1, len(count)]
    longest = int(np.argmax(np.diff(cuts)))
    part = slice(cuts[longest], cuts[longest + 1])
    return tuple(np.asarray(values[part]) for values in (count, *columns))


def sampling_over(signal: ScanSignal, places: int = 5) -> list[dict[str, float]]:
    """Return the sampling at ``places`` radii, outermost first; at one radius on a circle.

    radius: [m];  distance: between samples along the path [m] (Table 1 of the paper)
    shortest_wavelength: without aliasing, twice the distance [m]
    """
    samples = np.diff(signal.sample)
    distance = abs(np.diff(signal.path)) / samples
    middle = 0.5 * (signal.radius[1:] + signal.radius[:-1])
    low, high = float(middle.min()), float(middle.max())
    count = 1 if high - low < 0.01 * max(high, 1e-12) else places
    rings = [
        (middle <= outer) & (middle >= inner)
        for outer, inner in pairwise(np.linspace(high, low, count + 1))
    ]
    usual = [np.median([middle[r], distance[r]], axis=1).tolist() for r in rings if r.any()]
    return [{"radius": at, "distance": d, "shortest_wavelength": 2 * d} for at, d in usual]
