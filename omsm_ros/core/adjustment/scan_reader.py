"""Read a scan for self-calibration and reversal: heights, places on the part, motion of Z.

Velocities follow from the axes by a local polynomial (Savitzky-Golay). A missing reading costs one
point, a missing axis sample its neighbours too.
"""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage, signal

from omsm_ros.core.correction.surface_points import SurfacePoints, join_points
from omsm_ros.core.kinematics.kinematics import workpiece_xy
from omsm_ros.core.streams.blocks import (
    AxisBlock,
    BoolArray,
    FloatArray,
    known_parts,
    uninterrupted,
)
from omsm_ros.core.streams.statistics import EvenSelection
from omsm_ros.errors import DataError

# A turn of one second at 1 kHz; fewer points do not determine a surface.
_LEAST_POINTS = 1000
# Points of a scan that are kept, 72 bytes each.
_MOST_POINTS = 500_000
# Window of the fourth-order polynomial: the velocity is 1 % low at 12 Hz, where amplitudes are
# nanometres, and exact to 2e-6 at 2 Hz.
_HALF_WINDOW_S = 12e-3
_POLYNOMIAL = 4
# Points that are processed at a time.
_PORTION_SAMPLES = 20_000
_COLUMNS = ("time", "radius", "angle", "radial_rate", "angular_rate", "height", "motion_rate",
            "motion_acceleration", "motion")  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class ScanColumns:
    """Points of a scan in the order of time, each array (n,).

    time: since the first sample [s];  radius, angle: on the part [m], [rad]
    radial_rate, angular_rate: of the slides over the part [m/s], [rad/s]
    height: H(z) plus distance [m];  motion: H(z) [m]
    motion_rate, motion_acceleration: of the Z encoder [m/s], [m/s²]
    """

    time: FloatArray
    radius: FloatArray
    angle: FloatArray
    radial_rate: FloatArray
    angular_rate: FloatArray
    height: FloatArray
    motion_rate: FloatArray
    motion_acceleration: FloatArray
    motion: FloatArray

    def __len__(self) -> int:
        return len(self.time)


class ScanReader:
    """Collects a scan that comes in portions, in bounded memory.

    points: number received;  used: number kept for the fit, evenly chosen
    """

    def __init__(self, sample_period: float) -> None:
        self._period = sample_period
        half = max(round(_HALF_WINDOW_S / sample_period), _POLYNOMIAL)
        self._half = half
        self._kernels = [
            signal.savgol_coeffs(2 * half + 1, _POLYNOMIAL, deriv=d, delta=sample_period)
            for d in (1, 2)
        ]
        self._axes: list[AxisBlock] = []
        self._points: list[SurfacePoints] = []
        self._kept = EvenSelection(_MOST_POINTS)
        self._first: int | None = None
        self.points = 0

    @property
    def used(self) -> int:
        """Number of points kept."""
        return len(self._kept)

    def add_axes(self, block: AxisBlock) -> None:
        """Add an axis block, before the points that are computed from it."""
        if self._first is None:
            self._first = block.first_sample
        known = np.all(np.isfinite([getattr(block, name) for name in "xyzbc"]), axis=0)
        self._axes += known_parts(block, known)

    def add(self, points: SurfacePoints) -> None:
        """Add points that were corrected without geometry and without latency."""
        self.points += len(points)
        self._points.append(points)
        if sum(map(len, self._points)) > _PORTION_SAMPLES:
            self._keep_complete(last=False)

    def columns(self) -> ScanColumns:
        """Return the kept points at the end of the scan; raise DataError for a short scan."""
        self._keep_complete(last=True)
        if self.used < _LEAST_POINTS:
            raise DataError(
                "adjustment.short_scan", points=self.points, used=self.used, least=_LEAST_POINTS
            )
        return ScanColumns(**dict(zip(_COLUMNS, self._kept.rows().T, strict=True)))

    def _keep_complete(self, *, last: bool) -> None:
        """Keep the points with known neighbours, which the ends of a run do not have."""
        points = join_points(self._points)
        if not self._axes or not len(points):
            return
        for run in uninterrupted(self._axes):
            begin, end = run[0].first_sample, run[-1].end
            known = (points.sample >= begin + self._half) & (points.sample < end - self._half)
            if known.any():
                self._keep(run, points, known)
        # Points at the end of the newest run wait for the following axis samples.
        waits = (points.sample >= end - self._half) & (not last)
        self._points = [points.part(slice(int(np.argmax(waits)), None))] if waits.any() else []
        needed = points.sample[-1] - 2 * self._half
        self._axes = [b for b in self._axes if b.end > needed]

    def _keep(self, run: list[AxisBlock], points: SurfacePoints, known: BoolArray) -> None:
        x, y, z, c = (np.concatenate([getattr(b, n) for b in run]) for n in "xyzc")
        sample, height = points.sample[known], points.height[known]
        place = sample - run[0].first_sample
        across, along = workpiece_xy(x, y, c)
        radius, angle = np.hypot(across, along), np.unwrap(np.arctan2(along, across))
        columns = [
            (sample - (self._first or 0)) * self._period,
            radius[place],
            angle[place],
            self._derivative(radius, 0)[place],
            self._derivative(angle, 0)[place],
            height,
            self._derivative(z, 0)[place],
            self._derivative(z, 1)[place],
            z[place] - points.dynamic_error[known],
        ]
        self._kept.add(np.stack(columns, axis=1))

    def _derivative(self, values: FloatArray, kernel: int) -> FloatArray:
        return np.asarray(
            ndimage.convolve1d(values, self._kernels[kernel], mode="nearest"), np.float64
        )


def read_scan(axes: AxisBlock, points: SurfacePoints) -> ScanColumns:
    """Return the scan behind ``points`` that were computed from one block."""
    reader = ScanReader(axes.sample_period)
    reader.add_axes(axes)
    reader.add(points)
    return reader.columns()
