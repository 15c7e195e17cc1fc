"""Scans as the adjustment takes them: heights over the part, and how the machine moved.

``part frame``: the chuck's x and y turned back by the clocking of the part, so that one place of
the part has one x and y in all scans. Rates are local polynomials over the samples
(Savitzky-Golay), taken from the axes alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import scipy  # whose parts are loaded when they are used

from omsm_ros.core.kinematics.kinematics import (
    PolynomialSurface,
    Surface,
    slopes_by_differences,
    workpiece_xy,
)
from omsm_ros.core.streams.blocks import FloatArray, IntArray
from omsm_ros.core.surface.aperture import Aperture
from omsm_ros.errors import DataError

# A turn at 30 rpm holds 2000 points at 1 kHz; two hundred determine neither form nor drift.
LEAST_POINTS = 200
# Extent of points that are no scan: the spot of a probe, and the jitter of axes that do not move.
SPOT_M = 10e-6
# Turns without which a scan determines neither form nor drift.
_LEAST_TURNS = 3.0
# At the 12th harmonic of a turn a second the rate is 1 % short.
_HALF_WINDOW_S, _POLYNOMIAL = 12e-3, 4
# Creep of guides and mounts that a step test with plateaus of half a second does not show.
_CREEP_S = (2.0, 15.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class ScanData:
    """One scan, arrays (n,) in the order of time; only points with a valid reading.

    time: [s], of one clock for all scans
    x, y: of the point in the frame of the chuck [m]
    height: corrected height, H(z) plus distance [m]
    distance: that the probe measured, growing with the height [m]
    motion: z of the encoder [m]
    removed: what the correction took from the height, z − H(z) [m]
    c: spindle angle, unwrapped [rad]
    clocking: angle by which the part is turned on the chuck, from x towards y [rad]
    clamping: number of the clamping; scans of one number were made without touching the part
    weight: readings that one point stands for; above 1 for designs only

    Raises DataError for arrays of unlike length, for values that are not finite, and for times
    that do not grow.
    """

    time: FloatArray
    x: FloatArray
    y: FloatArray
    height: FloatArray
    distance: FloatArray
    motion: FloatArray
    removed: FloatArray
    c: FloatArray
    clocking: float = 0.0
    clamping: int = 0
    weight: float = 1.0

    def __post_init__(self) -> None:
        for name in ARRAYS:
            values = getattr(self, name)
            if np.shape(values) != np.shape(self.time):
                raise DataError(
                    f"{name} has shape {np.shape(values)!r}, expected {np.shape(self.time)!r} as "
                    "time has"
                )
            if not np.isfinite(values).all():
                raise DataError(f"{name} holds values that are not finite; leave such points out")
        if len(self.time) < LEAST_POINTS:
            raise DataError(f"scan of {len(self.time)} points, expected {LEAST_POINTS} or more")
        if not (np.diff(self.time) > 0).all():
            raise DataError("time does not grow from point to point; give the scan sorted by time")

    def __len__(self) -> int:
        return len(self.time)

    @property
    def duration(self) -> float:
        """From the first to the last point [s]."""
        return float(self.time[-1] - self.time[0])

    @property
    def turns(self) -> float:
        """Turns of the spindle, without sign."""
        return float(abs(self.c[-1] - self.c[0]) / (2 * np.pi))

    @property
    def is_spiral(self) -> bool:
        """True if it has turns enough, over a range of radii, to determine form and drift."""
        radius = np.hypot(self.x, self.y)
        return self.turns >= _LEAST_TURNS and float(np.ptp(radius)) > SPOT_M

    @property
    def speed(self) -> float:
        """Mean speed of the spindle, with its sign [rad/s]."""
        return float((self.c[-1] - self.c[0]) / self.duration)

    @property
    def outward(self) -> bool:
        """True if the scan ends further from the axis than it began."""
        return bool(np.hypot(self.x[-1], self.y[-1]) > np.hypot(self.x[0], self.y[0]))


ARRAYS = ("time", "x", "y", "height", "distance", "motion", "removed", "c")


def within(scan: ScanData, aperture: Aperture) -> ScanData:
    """Return the points of ``scan`` over the aperture of the part; DataError if they are few."""
    kept = aperture.holds(*workpiece_xy(scan.x, scan.y, np.full(len(scan), scan.clocking)))
    return replace(scan, **{name: getattr(scan, name)[kept] for name in ARRAYS})


@dataclass(frozen=True, eq=False, kw_only=True)
class ScanView:
    """Points of one scan with all that a term of the model looks at, arrays (n,).

    time: since the first scan began [s];  since: since this scan began [s]
    x, y: in the part frame [m];  slide_x, slide_y: from the spindle axis, machine frame [m]
    x_rate, y_rate: of the path over the part [m/s];  slope_x, slope_y: of the surface, part frame
    machine_slope_x, machine_slope_y: of the surface, machine frame
    motion, motion_rate, motion_acceleration: of Z [m], [m/s], [m/s²]
    motion_play: 1 upwards, −1 downwards, or by an assumed backlash: see :func:`play`
    motion_fading: mean of the motion over the last seconds less the motion: creep [m], (n, 2)
    distance: that the probe would measure of a part without form error [m]
    deviation: height less nominal height [m]
    speed: of the spindle [rad/s];  index: of the scan
    """

    time: FloatArray
    since: FloatArray
    x: FloatArray
    y: FloatArray
    slide_x: FloatArray
    slide_y: FloatArray
    c: FloatArray
    x_rate: FloatArray
    y_rate: FloatArray
    slope_x: FloatArray
    slope_y: FloatArray
    machine_slope_x: FloatArray
    machine_slope_y: FloatArray
    motion: FloatArray
    motion_rate: FloatArray
    motion_acceleration: FloatArray
    motion_play: FloatArray
    motion_fading: FloatArray
    distance: FloatArray
    removed: FloatArray
    deviation: FloatArray
    speed: float
    index: int

    def __len__(self) -> int:
        return len(self.time)

    def part(self, points: slice | IntArray) -> ScanView:
        """Return the view of some of the points."""
        arrays: dict[str, Any] = {
            name: values[points]
            for name, values in vars(self).items()
            if isinstance(values, np.ndarray)
        }
        return replace(self, **arrays)

    def lateral_error(self, x: FloatArray | float, y: FloatArray | float) -> FloatArray:
        """Return the height error of points reported off by ``x``, ``y`` [m] of the part frame."""
        return np.asarray(-self.slope_x * x - self.slope_y * y, np.float64)

    def across(self, x: FloatArray | float, y: FloatArray | float) -> FloatArray:
        """Return the height error of points reported off by ``x``, ``y`` [m] of the machine."""
        return np.asarray(-self.machine_slope_x * x - self.machine_slope_y * y, np.float64)


class Zero(NamedTuple):
    """From where all scans count time [s], height, distance and motion [m]: where the first is.

    Zeros of machine and probe lie anywhere: a scale times their distance would pass for the level
    of the part, which no scan knows.
    """

    time: float
    height: float
    distance: float
    motion: float


def zero_of(scans: Sequence[ScanData], nominal: Surface) -> Zero:
    """Return from where ``scans`` count."""
    first = scans[0]
    x, y = workpiece_xy(first.x, first.y, np.full(len(first), first.clocking))
    means = (first.height - nominal.height(x, y), first.distance, first.motion)
    return Zero(float(min(s.time[0] for s in scans)), *(float(np.mean(v)) for v in means))


def view_of(scan: ScanData, index: int, zero: Zero, nominal: Surface) -> ScanView:
    """Return ``scan``, number ``index``, with rates, slopes and deviation from ``nominal``."""
    x, y = workpiece_xy(scan.x, scan.y, np.full(len(scan), scan.clocking))
    slide_x, slide_y = workpiece_xy(scan.x, scan.y, -scan.c)
    x_rate, y_rate = (_rate(scan.time, v) for v in (x, y))
    slopes = slopes_by_differences(nominal, x, y)
    in_machine = workpiece_xy(*slopes, -(scan.c + scan.clocking))
    deviation = scan.height - zero.height - nominal.height(x, y)
    # Creep: the mean of the motion over the last seconds, fading, less the motion.
    motion_rate = _rate(scan.time, scan.motion)
    steps, first = float(np.median(np.diff(scan.time))) / np.array(_CREEP_S), scan.motion[0]
    followed = [scipy.signal.lfilter([step], [1, step - 1], scan.motion, zi=[first * (1 - step)])[0]
                for step in steps]  # fmt: skip
    return ScanView(
        time=scan.time - zero.time,
        since=scan.time - scan.time[0],
        x=x,
        y=y,
        slide_x=slide_x,
        slide_y=slide_y,
        c=scan.c,
        x_rate=x_rate,
        y_rate=y_rate,
        slope_x=slopes[0],
        slope_y=slopes[1],
        machine_slope_x=in_machine[0],
        machine_slope_y=in_machine[1],
        motion=scan.motion - zero.motion,
        motion_rate=motion_rate,
        motion_play=np.sign(motion_rate),
        motion_acceleration=_of_neighbours(scan, _rate(scan.time, scan.motion, 2)),
        motion_fading=(followed - scan.motion).T,
        # The measured distance holds the form itself, as a regressor it would take it away.
        distance=scan.distance - zero.distance - deviation,
        removed=scan.removed,
        deviation=deviation,
        speed=scan.speed,
        index=index,
    )


def play(motion: FloatArray, half: float) -> FloatArray:
    """Return ``motion`` (n,) less what follows it with a backlash of 2 ``half`` [m], over ``half``.

    It is 1 upwards and −1 downwards once the backlash is passed, and begins in its middle.
    """
    follower, made = float(motion[0]), []
    for place in motion.tolist():
        follower = min(max(follower, place - half), place + half)
        made.append(follower)
    return np.asarray((motion - made) / half)


def delayed(scan: ScanData, latency: float) -> ScanData:
    """Return ``scan`` with each reading where probe and part were ``latency`` [s] before."""
    slide = (scan.x + 1j * scan.y) * np.exp(1j * scan.c)
    rates = (_rate(scan.time, v) for v in (slide.real, slide.imag, scan.c))
    x, y, c = (
        v - latency * r for v, r in zip((slide.real, slide.imag, scan.c), rates, strict=True)
    )
    place = (x + 1j * y) * np.exp(-1j * c)
    return replace(scan, x=place.real, y=place.imag)


def _rate(time: FloatArray, values: FloatArray, order: int = 1) -> FloatArray:
    """Return the derivative of ``order`` by time, by run between gaps (Savitzky, Golay 1964)."""
    period = float(np.median(np.diff(time)))
    first = np.append(0, np.flatnonzero(np.diff(time) > 1.5 * period) + 1)
    length = np.diff(first, append=len(time))
    last = first + length - 1
    halves = np.minimum(max(round(_HALF_WINDOW_S / period), 3), (length - 1) // 2)
    # The rounded weights add up to nearly zero: a large constant would leave a derivative.
    values = values - np.repeat(values[first], length)
    slope = values[last] / np.maximum(time[last] - time[first], 1e-12)
    made = np.repeat(slope if order == 1 else np.zeros(len(slope)), length)
    derive = np.linalg.matrix_power(np.diag(np.arange(1.0, _POLYNOMIAL + 1), 1), order)
    for half in np.unique(halves[2 * halves + 1 > _POLYNOMIAL]):
        mine, place = halves == half, np.arange(2 * half + 1)
        powers = np.vander(place / half - 1, _POLYNOMIAL + 1, increasing=True)
        fit, rates = np.linalg.pinv(powers), powers @ derive / (half * period) ** order
        inside = np.repeat(mine, length)
        made[inside] = np.correlate(values, rates[half] @ fit, "same")[inside]
        # Up to the middle of the first window, and from that of the last one on.
        for begin, ends in ((first, place[:half]), (last - 2 * half, place[half + 1 :])):
            at = begin[mine, np.newaxis]
            made[at + ends] = values[at + place] @ fit.T @ rates[ends].T
    return made


def _of_neighbours(scan: ScanData, values: FloatArray) -> FloatArray:
    """Return ``values`` (n,) as the turns before and after have them at the same angle.

    The noise of the encoder stands in the corrected height too, as G passes it on: a second
    derivative of the same turn would find it there. Without a neighbour the value stays.
    """
    c = np.maximum.accumulate(scan.c * np.sign(scan.c[-1] - scan.c[0]))
    known = values.copy()
    # Nothing is interpolated over a gap.
    known[np.append(np.diff(scan.time) > 1.5 * np.median(np.diff(scan.time)), False)] = np.nan
    before, last, following, after = (
        np.interp(c + 2 * np.pi * turn, c, known, np.nan, np.nan) for turn in (-2, -1, 1, 2)
    )
    # At both ends, and next to a gap, the two turns on one side continue.
    for found in (2 * last - before, 2 * following - after, (last + following) / 2):
        values = np.where(np.isfinite(found), found, values)
    return values


# Degree of the slopes' polynomial: on the paper's mirror the eighth is 4 pm.
_DEGREE, _POINTS = 8, 20_000


def fitted_surface(scan: ScanData) -> PolynomialSurface:
    """Return a polynomial of degree 8 through ``scan``, in the part frame."""
    every = max(len(scan) // _POINTS, 1)
    x, y = workpiece_xy(scan.x[::every], scan.y[::every], np.full(len(scan.x[::every]),
                                                                   scan.clocking))  # fmt: skip
    return PolynomialSurface.through(x, y, scan.height[::every], _DEGREE)
