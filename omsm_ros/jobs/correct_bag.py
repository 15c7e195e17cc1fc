"""From a recorded bag to a cloud, and to all that is said of it, in one pass.

``bag → blocks → core → cloud.ply`` and the figures of the summary
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.correction.correct import CorrectionOptions
from omsm_ros.core.correction.scan_trace import ScanTrace
from omsm_ros.core.correction.surface_points import SurfacePoints
from omsm_ros.core.correction.uncertainty import with_lateral
from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.machine.pitch_curve import PitchCurve
from omsm_ros.core.machine.scan_path import PathStart, ScanPath
from omsm_ros.core.machine.surface_height import Surface
from omsm_ros.core.samples.blocks import AxisBlock, DistanceBlock, FloatArray
from omsm_ros.core.samples.even_selection import EvenSelection
from omsm_ros.core.samples.stream_faults import StreamWatch, counter_skew, skew_fault
from omsm_ros.core.surface.deviation import FormStatistics, RunningStatistics, deviation
from omsm_ros.jobs.corrected_scan import Admission, ByStamps, CorrectedScan
from omsm_ros.jobs.lateral_errors import LateralErrors, add_lateral_errors
from omsm_ros.jobs.progress import Progress, no_progress
from omsm_ros.jobs.read_bag import MOST_JUDGED
from omsm_ros.readable import quantity
from omsm_ros.storage.cloud_file import PlyWriter
from omsm_ros.storage.recording.topics import AnyBag

# No picture has so many pixels; the numbers of a summary come from all points.
MOST_DRAWN = 2**19


@dataclass(frozen=True, eq=False)
class Correction:
    """What became of a bag.

    account: of every sample, by stream;  budget: rms of each source of uncertainty [m]
    stamp_skew: of the two streams' stamps for the same trigger [s], None if none was paired
    admission, reasons: how the calibration was admitted, and what spoke against it
    statistics: of the dynamic "error", and with a nominal surface of the "raw" and "corrected"
        deviation, over all points; empty without points
    largest_uncertainty: [m];  points: evenly chosen, as in the cloud
    trace: points that stand for the scan where its systematic errors are judged
    path: its start, None without axes
    recorded_ns: when the recording began [ns, ROS time], None where nobody knows
    temperatures: that were recorded (n,) [°C], in their order; NaN: cannot be
    sample_period: [s];  faults: what counters and stamps of the recording say against it
    """

    account: dict[str, Any]
    budget: dict[str, float]
    stamp_skew: float | None
    admission: dict[str, object]
    reasons: tuple[str, ...]
    statistics: dict[str, FormStatistics]
    largest_uncertainty: float
    points: NDArray[np.void]
    trace: ScanTrace
    path: ScanPath | None
    sample_period: float
    recorded_ns: int | None
    temperatures: FloatArray
    faults: tuple[str, ...] = ()


def correct_bag(
    path: AnyBag,
    calibration: Calibration,
    cloud: Path,
    *,
    options: CorrectionOptions | None = None,
    admission: Admission | None = None,
    nominal: Surface | None = None,
    lateral: float = 0.0,
    by_stamps: ByStamps | None = None,
    progress: Progress = no_progress,
) -> Correction:
    """Correct a bag into ``cloud`` (PLY).

    nominal, lateral: surface, and standard lateral uncertainty of a point [m], which costs
        height where the surface slopes
    by_stamps: join the streams by their stamps; None: by the trigger counter they share

    Memory does not grow with the bag, but for ``by_stamps``. When it fails, no cloud remains.
    Raises CalibrationError for a calibration that does not belong to the bag, unless overridden.
    """
    scan = CorrectedScan(
        path,
        calibration,
        options or CorrectionOptions(),
        admission=admission or Admission(),
        by_stamps=by_stamps,
        progress=progress,
    )
    with scan:
        overridden = "; ".join(["OVERRIDDEN", *scan.reasons]) if scan.reasons else ""
        comment = f"omsm_ros, metres, calibration {calibration.id} {overridden}"
        with PlyWriter(cloud, comment) as ply:
            found = _Findings(nominal, lateral, by_counter=by_stamps is None)
            for block, points in scan.steps():
                found.see(block)
                if points is not None:
                    if nominal is not None and lateral:
                        points = with_lateral(points, nominal, lateral)
                    found.add(points, ply.write(points))
        shifted = add_lateral_errors(cloud, scan.options, scan.trace, MOST_DRAWN)
        done = _correction(scan, found)
        return done if shifted is None else _with_lateral_errors(done, shifted)


class _Findings:
    """What is learnt of the points while they pass."""

    def __init__(self, nominal: Surface | None, lateral: float, by_counter: bool) -> None:
        self._nominal, self._lateral, self._by_counter = nominal, lateral, by_counter
        self._axes, self._distance = StreamWatch(), StreamWatch()
        self._z = (np.inf, -np.inf)
        names = ("error",) if nominal is None else ("error", "raw", "corrected")
        self._running = {name: RunningStatistics() for name in names}
        self.largest = 0.0
        self.drawn = EvenSelection(MOST_DRAWN)
        self.path = PathStart(MOST_JUDGED)

    def see(self, block: AxisBlock | DistanceBlock | None) -> None:
        if block is None:
            return
        self.path.add(block)
        if isinstance(block, AxisBlock) and np.any(here := np.isfinite(block.z)):
            low, high = self._z
            self._z = (min(low, block.z[here].min()), max(high, block.z[here].max()))
        (self._axes if isinstance(block, AxisBlock) else self._distance).add(block)

    def faults(self, scan: CorrectedScan) -> tuple[str, ...]:
        """Return what counters and stamps say against the scan; not of axes joined by stamps."""
        found = [*self._distance.faults("distance")]
        if self._by_counter:
            skew = counter_skew(self._axes, self._distance)
            found = [*self._axes.faults("axes"), *found]
            lapse = scan.time_lapse
            found += [*self._axes.period_fault("axes", lapse)]
            found += [*self._distance.period_fault("distance", lapse)]
            stated = scan.options.sources
            resolution = stated.encoder_resolution if stated else 0.0
            found += self._axes.step_faults(resolution, self._lateral)
            found += skew_fault(skew, scan.sample_period, scan.trigger)
            samples = scan.account.distance.counted.get("slipped", 0)
            found += [f"{samples} samples were not corrected: {scan.slip}"] * bool(samples)
        return (*found, *self._beyond(scan.options.pitch))

    def _beyond(self, pitch: PitchCurve | None) -> Iterator[str]:
        """Yield where Z went beyond what was measured of its pitch."""
        if pitch is None:
            return
        (low, high), first, last = self._z, pitch.position[0], pitch.position[-1]
        if low < first or last < high:
            yield (
                f"Z goes from {quantity(low, 'm')} to {quantity(high, 'm')}, its pitch was "
                f"measured from {quantity(first, 'm')} to {quantity(last, 'm')} and taken as level "
                "beyond; measure it where Z goes"
            )

    def add(self, points: SurfacePoints, packed: NDArray[np.void]) -> None:
        self.drawn.add(packed)
        if not len(points):
            return
        self.largest = max(self.largest, float(points.uncertainty.max()))
        x, y, error = points.x, points.y, points.dynamic_error
        self._running["error"].add(x, y, error)
        if self._nominal is not None:
            corrected = deviation(x, y, points.height, self._nominal)
            self._running["corrected"].add(x, y, corrected)
            self._running["raw"].add(x, y, corrected + error)

    def statistics(self) -> dict[str, FormStatistics]:
        if not len(self.drawn):
            return {}
        return {name: running.statistics() for name, running in self._running.items()}


def _with_lateral_errors(done: Correction, shifted: LateralErrors) -> Correction:
    if not shifted.heights:
        return replace(done, faults=(*done.faults, *shifted.warnings))
    return replace(
        done,
        budget=done.budget | shifted.heights,
        largest_uncertainty=shifted.largest,
        points=shifted.points,
    )


def _correction(scan: CorrectedScan, found: _Findings) -> Correction:
    return Correction(
        account=scan.account.as_dict(),
        budget=scan.budget,
        stamp_skew=scan.stamp_skew,
        admission=scan.admitted,
        reasons=scan.reasons,
        statistics=found.statistics(),
        largest_uncertainty=found.largest,
        points=found.drawn.rows(),
        trace=scan.trace,
        path=found.path.path(),
        sample_period=scan.sample_period,
        recorded_ns=scan.recorded_ns,
        temperatures=scan.temperatures,
        faults=found.faults(scan),
    )
