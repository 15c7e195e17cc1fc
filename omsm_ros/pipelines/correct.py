"""From a recorded bag to a cloud, and to all that is said of it, in one pass.

``bag → blocks → core → cloud.ply`` and the figures of the summary
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.calibration.applicability import admit, objections
from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
from omsm_ros.core.correction.surface_points import SurfacePoints
from omsm_ros.core.correction.systematic import (
    ScanFields,
    ScanTrace,
    resolves_per_turn_waves,
    scan_fields,
    standard_fields,
)
from omsm_ros.core.correction.uncertainty import with_lateral_uncertainty
from omsm_ros.core.kinematics.kinematics import PitchCurve, Surface
from omsm_ros.core.kinematics.scan_path import ScanPath, ScanPathReader
from omsm_ros.core.streams.axes_at_probe import axes_at_probe
from omsm_ros.core.streams.blocks import (
    Account,
    AxisBlock,
    DistanceBlock,
    FloatArray,
    RejectionReason,
)
from omsm_ros.core.streams.statistics import EvenSelection
from omsm_ros.core.streams.stream_faults import StreamWatch, counter_skew, skew_fault
from omsm_ros.core.streams.trigger_slips import CommonTrigger, TriggerSlip
from omsm_ros.core.surface.deviation import FormStatistics, RunningStatistics, deviation
from omsm_ros.errors import BagError, ConfigurationError, Notice
from omsm_ros.io import bags
from omsm_ros.io.results import PlyWriter, with_added_variance
from omsm_ros.io.topics import AnyBag
from omsm_ros.pipelines.progress import Progress, no_progress
from omsm_ros.pipelines.recording import MOST_JUDGED
from omsm_ros.quantities import TIME_LAPSE
from omsm_ros.readable import quantity

# The one pass over a recorded scan: its blocks go through the corrector as they are read.

TOPICS = (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)
# A quarter of a gigabyte: one stream may be recorded that far ahead of the other.
MAX_PENDING_BLOCKS = 4_000_000


@dataclass(frozen=True)
class Admission:
    """May a calibration be used here?

    settings: of this scan, to be compared with the calibration's; None = not known
    override: use it all the same; what spoke against it is written into every result
    """

    settings: Mapping[str, object] | None = None
    override: bool = False


@dataclass(frozen=True)
class StampJoining:
    """Probe and axes joined by their stamps, not by a common trigger counter.

    delay: from the probe's stamp to the middle of its exposure, on the axes' clock [s]
    exposure: over which the probe averages [s]
    """

    delay: float = 0.0
    exposure: float = 0.0


class CorrectedScan:
    """A bag opened and its surface points as they are corrected; use it as a context manager.

    sample_period: of the scan [s];  time_lapse: how much faster it was played [1], if settings say
    admitted, reasons: the decision to use the calibration
    recorded_ns: when the recording began [ns, ROS time], None where nobody knows
    temperatures: that were recorded (n,) [°C], in their order; NaN: cannot be
    by_stamps: join the streams by their stamps, for which all samples are held in memory;
        None: by the trigger counter they share, in bounded memory

    Raises BagError for a bag without samples, CalibrationError for a calibration that does not
    belong to it, unless overridden.
    """

    def __init__(
        self,
        path: AnyBag,
        calibration: Calibration,
        options: CorrectionOptions,
        *,
        admission: Admission = Admission(),
        by_stamps: StampJoining | None = None,
        progress: Progress = no_progress,
    ) -> None:
        self.path = path
        self._calibration, self._options, self._admission = calibration, options, admission
        self._by_stamps, self._progress = by_stamps, progress
        self._stack = ExitStack()

    def __enter__(self) -> CorrectedScan:
        with ExitStack() as opening:
            bag = opening.enter_context(bags.BagReader(self.path))
            blocks = self._blocks(bag)
            first = next(blocks, None)
            if first is None:
                raise BagError(f"{str(self.path)!r} has no samples on {TOPICS}; record a scan")
            self.sample_period = float(first.sample_period)
            self.time_lapse = self._time_lapse()
            self._rest = chain([first], blocks)
            self.recorded_ns, self.temperatures = bag.recorded_ns, bag.temperatures()
            self.reasons = objections(
                self._calibration,
                sample_period=self.sample_period,
                settings=self._admission.settings,
                probe=bag.probe_settings(),
                polarity=self._options.polarity,
            )
            self.admitted = admit(self._calibration, self.reasons, self._admission.override)
            self._corrector = Corrector(self._calibration, self._options, MAX_PENDING_BLOCKS)
            self._stack = opening.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stack.close()

    def steps(self) -> Iterator[tuple[AxisBlock | DistanceBlock | None, SurfacePoints | None]]:
        """Yield each block in turn, and the points it completed; None at the end, and the rest.

        Raises BagError where samples had to be given up that have a partner later in the bag.
        """
        for block in self._rest:
            if isinstance(block, AxisBlock):
                self._corrector.push_axes(block)
            else:
                self._corrector.push_distance(block)
            yield block, self._corrector.take()
        yield None, self._corrector.finish()
        self._check_complete()

    @property
    def account(self) -> Account:
        """Where every sample read so far has gone."""
        return self._corrector.account

    @property
    def budget(self) -> dict[str, float]:
        """Standard uncertainty of the heights by its source [m], rms of all points so far."""
        return self._corrector.budget

    @property
    def trace(self) -> ScanTrace:
        """Points that stand for the scan so far."""
        return self._corrector.trace

    @property
    def stamp_skew(self) -> float | None:
        """Time of the axes minus time of the distance at the newest common trigger [s]."""
        return self._corrector.stamp_skew

    @property
    def slip(self) -> TriggerSlip | None:
        """The last slip of the two counters so far, None without one."""
        return self._corrector.slips.found

    @property
    def options(self) -> CorrectionOptions:
        """How it is corrected."""
        return self._options

    @property
    def trigger(self) -> CommonTrigger:
        """What is stated of the two counters."""
        return self._options.trigger

    def _time_lapse(self) -> float:
        stated = {**self._calibration.settings, **(self._admission.settings or {})}
        lapse = stated.get("time_lapse", 1.0)
        return TIME_LAPSE.checked(lapse, ConfigurationError, "setting 'time_lapse'")

    def _blocks(self, bag: bags.BagReader) -> Iterator[Any]:
        total = bag.count(TOPICS)
        if self._by_stamps is not None:
            yield from _joined_by_stamps(bag, self._by_stamps)
            self._progress(total, total)
            return
        for done, _, block in bag.blocks(*TOPICS):
            yield block
            self._progress(done, total)

    def _check_complete(self) -> None:
        name = RejectionReason.OVERDUE.name.lower()
        account = self.account
        lost = min(s.counted.get(name, 0) for s in (account.axes, account.distance))
        if lost:
            raise BagError(
                f"{str(self.path)!r}: {lost} samples waited for their partners in vain, for one "
                f"stream was recorded more than {MAX_PENDING_BLOCKS} samples ahead of the other; "
                "record both at the same time"
            )
        received = (account.axes.received, account.distance.received)
        for topic, samples in zip(TOPICS, received, strict=True):
            if not samples:
                raise BagError(f"{str(self.path)!r} has no samples on {topic!r}; record a scan")


def _joined_by_stamps(
    bag: bags.BagReader, how: StampJoining
) -> Iterator[AxisBlock | DistanceBlock]:
    """Yield the axes at the probe's samples, and the probe's blocks, as if one trigger had both.

    A message that repeats samples or comes late has no axes; it is counted as what it is.
    """
    axes, distance = [], []
    for _, _, block in bag.blocks(*TOPICS):
        (axes if isinstance(block, AxisBlock) else distance).append(block)
    moved = axes_at_probe(axes, distance, delay=how.delay, exposure=how.exposure)
    at_probe = next(moved, None)
    for block in distance:
        if at_probe is not None and at_probe.newest == block.newest:
            yield at_probe
            at_probe = next(moved, None)
        yield block


# What errors that shift points laterally do to a cloud whose nominal surface nobody gave.
#
# They cost height by the slope of the surface. While the points pass it is not known; once they
# have
# passed, it is that of a polynomial through them, and the cloud is gone through once more.

LATERAL_SOURCES = (
    "{names}: not in the uncertainty of the points, because the surface's slopes are not known; "
    "give --nominal SURFACE.yaml"
)


@dataclass(frozen=True, eq=False)
class LateralErrors:
    """heights: rms of what each such source does [m];  largest: uncertainty of a point now [m]

    points: evenly chosen, as they are in the cloud now;  warnings: what could not be had
    """

    heights: dict[str, float]
    largest: float
    points: NDArray[np.void]
    warnings: tuple[str, ...] = ()


def add_lateral_errors(
    cloud: Path, options: CorrectionOptions, trace: ScanTrace, most: int
) -> LateralErrors | None:
    """Add to the uncertainty of each point of ``cloud`` what shifts it laterally.

    most: points to return. Return None where there is no such source, or its slope was known while
    the points passed.
    """
    sources = [source for source in options.systematic if source.needs_slope]
    if not sources or options.surface is not None or not trace.seen:
        return None
    points = trace.points()
    if not resolves_per_turn_waves(points):
        names = ", ".join(dict.fromkeys(source.name for source in sources))
        return LateralErrors({}, 0.0, np.empty(0), (LATERAL_SOURCES.format(names=names),))
    by_source = standard_fields(sources, points.with_slopes(None))
    fields = scan_fields(by_source, trace.every)
    kept, largest = EvenSelection(most), 0.0
    for rows in with_added_variance(cloud, lambda first, count: _variance(fields, first, count)):
        kept.add(rows)
        largest = max(largest, float(rows["uncertainty"].max()))
    heights = {name: float(np.sqrt(np.mean(np.sum(f**2, axis=0)))) for name, f in by_source.items()}
    return LateralErrors(heights, largest, kept.rows())


def _variance(fields: ScanFields, first: int, count: int) -> FloatArray:
    return np.asarray(np.sum(fields.at(first, count) ** 2, axis=0), np.float64)


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
    reasons: tuple[Notice, ...]
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
    by_stamps: StampJoining | None = None,
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
        overridden = "; ".join(["OVERRIDDEN", *map(str, scan.reasons)]) if scan.reasons else ""
        comment = f"omsm_ros, metres, calibration {calibration.id} {overridden}"
        with PlyWriter(cloud, comment) as ply:
            found = _Findings(nominal, lateral, by_counter=by_stamps is None)
            for block, points in scan.steps():
                found.see(block)
                if points is not None:
                    if nominal is not None and lateral:
                        points = with_lateral_uncertainty(points, nominal, lateral)
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
        self.path = ScanPathReader(MOST_JUDGED)

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
        found: list[Notice | str] = [*self._distance.faults("distance")]
        if self._by_counter:
            skew = counter_skew(self._axes, self._distance)
            found = [*self._axes.faults("axes"), *found]
            lapse = scan.time_lapse
            found += [*self._axes.period_fault("axes", lapse)]
            found += [*self._distance.period_fault("distance", lapse)]
            stated = scan.options.sources
            resolution = stated.encoder_resolution if stated else 0.0
            found += self._axes.step_faults(resolution, self._lateral)
            samples = scan.account.distance.counted.get("slipped", 0)
            if samples:
                found.append(f"{samples} samples were not corrected: {scan.slip}")
            else:
                found += skew_fault(skew, scan.sample_period, scan.trigger)
        return (*map(str, found), *self._beyond(scan.options.pitch))

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
