"""Correct a recorded bag in one pass: blocks → core → cloud.ply and the figures of its summary."""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.adjustment.scan_data import SPOT_M
from omsm_ros.core.calibration.applicability import admit, objections
from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
from omsm_ros.core.correction.source_kinds import standard_fields
from omsm_ros.core.correction.surface_points import SurfacePoints
from omsm_ros.core.correction.systematic import MOST_TRACED, resolves_per_turn_waves, scan_fields
from omsm_ros.core.correction.uncertainty import with_lateral_uncertainty
from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.kinematics.scan_path import ScanPathReader
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
from omsm_ros.core.surface.deviation import RunningStatistics, deviation
from omsm_ros.errors import BagError, ConfigurationError, DataError, Notice
from omsm_ros.io.results import MOST_DRAWN, PlyWriter, with_added_variance
from omsm_ros.io.topics import AnyBag
from omsm_ros.pipelines.recording import MAX_PATH_SAMPLES, SCAN_TOPICS, Recording, scan_data
from omsm_ros.quantities import TIME_LAPSE
from omsm_ros.readable import counts_text, quantity

# Samples by which one stream may be recorded ahead of the other: a quarter of a gigabyte.
MAX_PENDING_SAMPLES = 4_000_000


@dataclass(frozen=True)
class Admission:
    """How a calibration is admitted for a scan.

    settings: of this scan, to be compared with the calibration's; None = unknown
    override: use the calibration despite a mismatch, which is stated in every result
    """

    settings: Mapping[str, object] | None = None
    override: bool = False


STRICT = Admission()
"""Nothing is known of the settings of the scan, and a mismatch is refused."""


@dataclass(frozen=True)
class StampJoining:
    """Parameters to join probe and axes by their stamps instead of a common trigger counter.

    delay: from the probe's stamp to the middle of its exposure, on the axes' clock [s]
    exposure: time over which the probe averages [s]
    """

    delay: float = 0.0
    exposure: float = 0.0


class CorrectedScan:
    """The surface points of an open recording, corrected block by block.

    sample_period: of the scan [s];  corrector: budget, trace and skew of what was read so far
    time_lapse: how much faster it was played [1], by the settings; 1 if they do not say
    reasons, admitted: mismatches of calibration and scan, and how the calibration was admitted
    recorded_ns: when the recording began [ns, ROS time], None if unknown
    temperatures: as recorded (n,) [°C], in their order; NaN: implausible
    by_stamps: join the streams by their stamps, for which all samples are held in memory;
        None: by the trigger counter they share, in bounded memory
    most_traced: largest number of points in ``corrector.trace``

    Raises BagError for a bag without samples, CalibrationError for a calibration that does not
    match the scan, unless overridden.
    """

    def __init__(
        self,
        recording: Recording,
        calibration: Calibration,
        options: CorrectionOptions,
        *,
        admission: Admission = STRICT,
        by_stamps: StampJoining | None = None,
        most_traced: int = MOST_TRACED,
    ) -> None:
        self.bag, self.options = recording.path, options
        blocks: Iterator[Any] = (block for _, block in recording.stream(*SCAN_TOPICS))
        if by_stamps is not None:
            blocks = _joined_by_stamps(blocks, by_stamps)
        first = next(blocks, None)
        if first is None:
            raise BagError(f"{str(self.bag)!r} has no samples on {SCAN_TOPICS}; record a scan")
        self.sample_period = float(first.sample_period)
        self.time_lapse = TIME_LAPSE.checked(
            {**calibration.settings, **(admission.settings or {})}.get("time_lapse", 1.0),
            ConfigurationError,
            "setting 'time_lapse'",
        )
        self._rest = chain([first], blocks)
        self.recorded_ns = recording.recorded_ns
        self.temperatures = recording.temperatures()
        self.reasons = objections(
            calibration,
            sample_period=self.sample_period,
            settings=admission.settings,
            probe=recording.probe_settings(),
            polarity=options.polarity,
        )
        self.admitted = admit(calibration, self.reasons, admission.override)
        self.corrector = Corrector(calibration, options, MAX_PENDING_SAMPLES, most_traced)

    def steps(self) -> Iterator[tuple[AxisBlock | DistanceBlock | None, SurfacePoints | None]]:
        """Yield each block with the points that it completed; at the end None with the rest.

        Raises BagError if samples were dropped although their partners come later in the bag.
        """
        for block in self._rest:
            if isinstance(block, AxisBlock):
                self.corrector.push_axes(block)
            else:
                self.corrector.push_distance(block)
            yield block, self.corrector.take()
        yield None, self.corrector.finish()
        account = self.account
        name = RejectionReason.OVERDUE.name.lower()
        lost = min(s.counted.get(name, 0) for s in (account.axes, account.distance))
        if lost:
            raise BagError(
                f"{str(self.bag)!r}: {lost} samples were dropped before their partners came: one "
                f"stream was recorded more than {MAX_PENDING_SAMPLES} samples ahead of the other; "
                "record both at the same time"
            )
        received = (account.axes.received, account.distance.received)
        for topic, samples in zip(SCAN_TOPICS, received, strict=True):
            if not samples:
                raise BagError(f"{str(self.bag)!r} has no samples on {topic!r}; record a scan")

    def read(self) -> tuple[list[AxisBlock], list[SurfacePoints]]:
        """Return all blocks of the axes and all points; BagError as :meth:`steps`."""
        blocks, parts = zip(*self.steps(), strict=True)
        axes = [block for block in blocks if isinstance(block, AxisBlock)]
        return axes, [points for points in parts if points is not None]

    @property
    def account(self) -> Account:
        """Account of every sample read so far."""
        return self.corrector.account

    def check_points(self) -> None:
        """Raise BagError if the scan gave no surface point."""
        axes, distance = self.account.axes, self.account.distance
        if not axes.corrected:
            raise BagError(
                f"{str(self.bag)!r} gives no surface point: of {distance.received} readings "
                f"{counts_text(distance.counted)}, of {axes.received} axis samples "
                f"{counts_text(axes.counted)}; check the bag with 'omsm inspect'"
            )


def _joined_by_stamps(blocks: Iterator[Any], how: StampJoining) -> Iterator[Any]:
    """Yield the probe's blocks, and the axes interpolated to its samples.

    A message that repeats samples or comes late has no axes; the corrector counts its samples.
    """
    axes, distance = [], []
    for block in blocks:
        (axes if isinstance(block, AxisBlock) else distance).append(block)
    moved = axes_at_probe(axes, distance, delay=how.delay, exposure=how.exposure)
    at_probe = next(moved, None)
    for block in distance:
        if at_probe is not None and at_probe.newest == block.newest:
            yield at_probe
            at_probe = next(moved, None)
        yield block


# A quarter of an hour at 1 kHz, whose adjustment needs 1 GB; longer scans are not adjusted.
_MOST_ADJUSTED = 1_000_000


class Correction(CorrectedScan):
    """A bag that is corrected in one pass, and what its samples and points show.

    nominal: surface for the deviations, or None;  lateral: standard uncertainty of x and y [m]

    After :meth:`write`:

    budget: rms of each source of uncertainty [m]
    statistics: of the dynamic "error", and with a nominal surface of the "raw" and "corrected"
        deviation, over all points; empty without points
    largest_uncertainty: of a point [m];  points: evenly chosen rows of the cloud
    path: start of the scan path, None without axes
    faults: findings from counters and stamps of the recording
    scan: for its adjustment; None if it is too long, too short, or its counter began anew
    """

    def __init__(
        self, recording: Recording, calibration: Calibration, options: CorrectionOptions,
        admission: Admission, by_stamps: StampJoining | None, nominal: Surface | None,
        lateral: float,
    ) -> None:  # fmt: skip
        super().__init__(recording, calibration, options, admission=admission, by_stamps=by_stamps)
        self._nominal, self._lateral, self._by_counter = nominal, lateral, by_stamps is None
        self._axes, self._distance = StreamWatch(), StreamWatch()
        self._z = (np.inf, -np.inf)
        names = ("error",) if nominal is None else ("error", "raw", "corrected")
        self._running = {name: RunningStatistics() for name in names}
        self.largest_uncertainty = 0.0
        self._drawn, self._path = EvenSelection(MOST_DRAWN), ScanPathReader(MAX_PATH_SAMPLES)
        self._blocks: list[AxisBlock] = []
        self._points: list[SurfacePoints] = []
        self._kept = 0

    def write(self, ply: PlyWriter) -> None:
        """Correct the whole bag into ``ply``; BagError as :meth:`steps`."""
        for block, points in self.steps():
            if block is not None:
                self._see(block)
            if points is not None:
                if self._nominal is not None and self._lateral:
                    points = with_lateral_uncertainty(points, self._nominal, self._lateral)
                self._add(points, ply.write(points))
        self.budget, self.path = self.corrector.budget, self._path.path()
        self.points = self._drawn.rows()
        running = self._running.items() if len(self._drawn) else ()
        self.statistics = {name: one.statistics() for name, one in running}
        self.faults, self.scan = self._faults(), None
        with suppress(DataError):  # points that make no scan
            if self._points:
                self.scan = scan_data(self._blocks, self._points, self.sample_period)[0]

    def _see(self, block: AxisBlock | DistanceBlock) -> None:
        self._path.add(block)
        if isinstance(block, AxisBlock) and np.any(here := np.isfinite(block.z)):
            low, high = self._z
            self._z = (min(low, block.z[here].min()), max(high, block.z[here].max()))
        if isinstance(block, AxisBlock) and self._kept <= _MOST_ADJUSTED:
            self._blocks.append(block)
        (self._axes if isinstance(block, AxisBlock) else self._distance).add(block)

    def _add(self, points: SurfacePoints, packed: NDArray[np.void]) -> None:
        self._drawn.add(packed)
        if not len(points):
            return
        largest = float(points.uncertainty.max())
        self.largest_uncertainty = max(self.largest_uncertainty, largest)
        self._kept += len(points)
        if self._kept <= _MOST_ADJUSTED:
            self._points.append(points)
        else:
            self._points, self._blocks = [], []
        x, y, error = points.x, points.y, points.dynamic_error
        self._running["error"].add(x, y, error)
        if self._nominal is not None:
            corrected = deviation(x, y, points.height, self._nominal)
            self._running["corrected"].add(x, y, corrected)
            self._running["raw"].add(x, y, corrected + error)

    def _faults(self) -> tuple[str, ...]:
        """Return findings from counters and stamps; none of axes that are joined by stamps.

        The first is that all points lie on one spot, as those of a step test; the last, that Z left
        the range in which its pitch was measured.
        """
        found: list[Notice | str] = [*self._distance.faults("distance")]
        if self._by_counter:
            skew = counter_skew(self._axes, self._distance)
            found = [*self._axes.faults("axes"), *found]
            lapse = self.time_lapse
            found += [*self._axes.period_fault("axes", lapse)]
            found += [*self._distance.period_fault("distance", lapse)]
            stated = self.options.sources
            resolution = stated.encoder_resolution if stated else 0.0
            found += self._axes.step_faults(resolution, self._lateral)
            samples = self.account.distance.counted.get("slipped", 0)
            if samples:
                found.append(
                    f"{samples} samples were not corrected: {self.corrector.pairing.watch.found}"
                )
            else:
                found += skew_fault(skew, self.sample_period, self.options.trigger)
        rows, pitch, (low, high) = self.points, self.options.pitch, self._z
        if len(rows) and max(np.ptp(rows["x"]), np.ptp(rows["y"])) < SPOT_M:
            found.insert(
                0,
                f"all points lie within {quantity(SPOT_M, 'm')}: X and C did not scan a surface; "
                "evaluate a step test with 'omsm identify', and test a calibration on one with "
                "'omsm verify'",
            )
        if pitch is not None and (low < pitch.position[0] or pitch.position[-1] < high):
            first, last = pitch.position[0], pitch.position[-1]
            found.append(
                f"Z goes from {quantity(low, 'm')} to {quantity(high, 'm')}, but its pitch was "
                f"measured from {quantity(first, 'm')} to {quantity(last, 'm')} and taken as "
                "constant beyond; measure it over the whole range of Z"
            )
        return tuple(map(str, found))


def add_lateral_errors(done: Correction, cloud: Path) -> None:
    """Add the effect of lateral errors to the uncertainty of each point of ``cloud``.

    Lateral errors change heights by the slope of the surface. Without a nominal surface the slope
    is that of a polynomial through all points, so the cloud is rewritten in a second pass.

    Budget, largest uncertainty and points of ``done`` have them then; all is as before if there is
    no such source, or a nominal surface is given.
    """
    trace, options = done.corrector.trace, done.options
    sources = [source for source in options.systematic if source.kind.needs_slope]
    if not sources or options.surface is not None or not trace.seen:
        return
    points = trace.points()
    if not resolves_per_turn_waves(points):
        left_out = (
            f"{', '.join(dict.fromkeys(source.name for source in sources))}: not in the "
            "uncertainty of the points, because the slopes of the surface are unknown; give "
            "--nominal SURFACE.yaml"
        )
        done.faults = (*done.faults, left_out)
        return
    by_source = standard_fields(sources, points.with_slopes(None))
    fields = scan_fields(by_source, trace.every)
    kept, done.largest_uncertainty = EvenSelection(MOST_DRAWN), 0.0

    def variance(first: int, count: int) -> FloatArray:
        return np.asarray(np.sum(fields.at(first, count) ** 2, axis=0), np.float64)

    for rows in with_added_variance(cloud, variance):
        kept.add(rows)
        largest = float(rows["uncertainty"].max())
        done.largest_uncertainty = max(done.largest_uncertainty, largest)
    heights = {name: float(np.sqrt(np.mean(np.sum(f**2, axis=0)))) for name, f in by_source.items()}
    done.budget, done.points = done.budget | heights, kept.rows()


def correct_bag(
    path: AnyBag,
    calibration: Calibration,
    cloud: Path,
    *,
    options: CorrectionOptions | None = None,
    admission: Admission = STRICT,
    nominal: Surface | None = None,
    lateral: float = 0.0,
    by_stamps: StampJoining | None = None,
) -> Correction:
    """Correct a bag into ``cloud`` (PLY).

    nominal: surface for the deviations;  lateral: standard uncertainty of x and y [m], which
        adds to the uncertainty of heights by the slope of ``nominal``
    by_stamps: join the streams by their stamps; None: by the trigger counter they share

    Memory is bounded, except with ``by_stamps``. If the correction fails, no cloud remains.
    Raises CalibrationError for a calibration that does not match the scan, unless overridden.
    """
    with Recording(path) as recording:
        done = Correction(
            recording, calibration, options or CorrectionOptions(), admission, by_stamps,
            nominal, lateral,
        )  # fmt: skip
        overridden = "; ".join(["OVERRIDDEN", *map(str, done.reasons)]) if done.reasons else ""
        comment = f"omsm_ros, metres, calibration {calibration.id} {overridden}"
        with PlyWriter(cloud, comment) as ply:
            done.write(ply)
        add_lateral_errors(done, cloud)
        return done
