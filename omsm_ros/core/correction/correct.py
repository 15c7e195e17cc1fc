"""Correction of a scan for the dynamics of the machine.

``height = H(z) + polarity · distance / static_gain`` (Eq. 10, 13), where H is the discretised G_m,
run over the encoder's stream. A lost reading of the probe costs only its own point. The points do
not depend on how the streams are cut into blocks and interleaved, to the last bit, so that live
and offline agree.
"""

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.calibration.calibration_set import CalibrationSet
from omsm_ros.core.correction.machine_sources import (
    NOTHING_STATED,
    OF_CALIBRATION,
    POINT_SOURCES,
    whole_scan_sources,
)
from omsm_ros.core.correction.motion_filter import MOVED, RATE, MotionFilter, MotionFilters
from omsm_ros.core.correction.source_kinds import SystematicSource
from omsm_ros.core.correction.surface_points import SurfacePoints, join_points
from omsm_ros.core.correction.systematic import MOST_TRACED, ScanPoints, ScanTrace
from omsm_ros.core.correction.uncertainty import SCAN_SCATTER, ErrorSources, reading_variances
from omsm_ros.core.kinematics.kinematics import Geometry, PitchCurve, Surface, workpiece_points
from omsm_ros.core.streams.blocks import (
    SAME_PERIOD,
    Account,
    AxisBlock,
    Block,
    DistanceBlock,
    FloatArray,
    RejectionReason,
    joined,
)
from omsm_ros.core.streams.pairing import Pairing, SampleRun, StreamInput
from omsm_ros.core.streams.statistics import RunningScatter
from omsm_ros.core.streams.trigger_slips import EQUAL_COUNTS, CommonTrigger
from omsm_ros.errors import CalibrationError, ConfigurationError
from omsm_ros.quantities import LAG, WAIT, CheckedRecord
from omsm_ros.units import NANOSECONDS_PER_S


@dataclass(frozen=True, kw_only=True)
class CorrectionOptions(CheckedRecord):
    """Options of the correction.

    polarity: 1 if the distance falls when z rises, -1 for a probe mounted the other way
    accept_other_rate: correct data of another sample period than the calibration's
    max_pending: time that a sample waits for its partner [s]; the newest block always waits
    sources: uncertainties of single points; None takes those of the calibration's certificate
    probe_latency: latency of the probe [s], by which X, Y, B and C are delayed; None takes that of
        the calibration's certificate
    geometry: of the probe
    systematic: sources of the whole scan that are added to the uncertainty of each point; those
        that need slopes only with a ``surface``
    surface: nominal, for its slopes
    pitch: measured curve of Z, by which the encoder is corrected over the Abbe arm
    trigger: statement about the counters of the two streams
    """

    polarity: int = 1
    accept_other_rate: bool = False
    max_pending: float = WAIT.of_field(10.0)
    sources: ErrorSources | None = None
    probe_latency: float | None = LAG.of_field(None)
    geometry: Geometry = field(default_factory=Geometry)
    systematic: tuple[SystematicSource, ...] = ()
    surface: Surface | None = None
    pitch: PitchCurve | None = None
    trigger: CommonTrigger = EQUAL_COUNTS

    def __post_init__(self) -> None:
        if self.polarity not in (1, -1):
            raise ConfigurationError("correction.polarity", polarity=self.polarity)
        CheckedRecord.__post_init__(self)


class Corrector:
    """Corrects axis and distance blocks to surface points, in the order of their triggers.

    Push the blocks of both streams in the order of their arrival. Samples that wait longer than
    ``max_pending`` for their partner are dropped, so that memory is bounded.

    most_waiting: number of samples that may wait, for files; None takes ``max_pending``
    most_traced: largest number of points in ``trace``
    trace: evenly spaced points for the systematic errors of the whole scan
    pairing: of the two streams, with its verdicts on slips and the pairs that are held for one
    """

    def __init__(
        self,
        calibration: Calibration,
        options: CorrectionOptions = CorrectionOptions(),
        most_waiting: int | None = None,
        most_traced: int = MOST_TRACED,
    ) -> None:
        self._calibration = calibration
        self._options = options
        self._most_waiting = most_waiting
        self._sources = options.sources or ErrorSources.of(calibration)
        self._period: float | None = None
        self._axes, self._distance = StreamInput(), StreamInput(options.trigger.counter_offset)
        self.pairing = Pairing(self._axes, self._distance, options.trigger)
        self._motion: MotionFilter | None = None
        names = (*OF_CALIBRATION, *POINT_SOURCES, SCAN_SCATTER)
        self._variance = defaultdict(float, dict.fromkeys(names, 0.0))
        self._ready: list[SurfacePoints] = []
        own = whole_scan_sources(calibration, self._sources, options.geometry, NOTHING_STATED)
        self._systematic = [
            source
            for source in (*own, *options.systematic)
            if options.surface is not None or not source.kind.needs_slope
        ]
        self.trace = ScanTrace(most_traced)

    def push_axes(self, *blocks: AxisBlock) -> None:
        """Filter the encoder samples of one block or of several consecutive ones.

        Raises CalibrationError for a sample period for which the calibration does not hold.
        """
        block = joined(blocks)
        motion = self._filter_for(block)
        if (arrival := self._axes.new(block, blocks)) is not None:
            values = np.array([block.x, block.y, block.z, block.b, block.c], np.float64)
            whole = SampleRun.of(block, arrival, np.zeros(len(block), np.uint8), values)
            for run in motion.push(whole):
                self.pairing.axes.push(run)
            self._join()
            self.pairing.axes.limit(self._most_pending(block))

    def push_distance(self, *blocks: DistanceBlock) -> None:
        """Queue the readings of one block or of several consecutive ones.

        Raises CalibrationError for a sample period for which the calibration does not hold.
        """
        block = joined(blocks)
        self._filter_for(block)
        if (arrival := self._distance.new(block, blocks)) is not None:
            intensity = block.intensity if len(block.intensity) else np.full(len(block), np.nan)
            reasons = np.where(block.ok, RejectionReason.NONE, RejectionReason.INVALID)
            values = np.array([block.distance, intensity], np.float64)
            self.pairing.distance.push(
                SampleRun.of(block, arrival, reasons.astype(np.uint8), values)
            )
            self._join()
            self.pairing.distance.limit(self._most_pending(block))

    def _most_pending(self, newest: AxisBlock | DistanceBlock) -> int:
        live = int(self._options.max_pending / newest.sample_period)
        return max(live if self._most_waiting is None else self._most_waiting, len(newest))

    def take(self) -> SurfacePoints | None:
        """Return the points completed since the last call, None if there are none."""
        if not self._ready:
            return None
        points = self._ready[0] if len(self._ready) == 1 else join_points(self._ready)
        self._ready = []
        return points

    def settle(self) -> None:
        """Correct the pairs that wait for further stamps, because both streams have paused."""
        self._correct(self.pairing.end())

    def finish(self) -> SurfacePoints | None:
        """End both streams and return the remaining points; later blocks begin a new session."""
        if self._motion is not None:
            for run in self._motion.end():
                self.pairing.axes.push(run)
        self._join()
        self._correct(self.pairing.end())
        for queue in (self.pairing.axes, self.pairing.distance):
            queue.clear()
        for stream in (self._axes, self._distance):
            stream.end()
        return self.take()

    @property
    def account(self) -> Account:
        """Account of every sample received so far."""
        warming = self._motion.pending if self._motion else 0
        axes, distance = self.pairing.axes, self.pairing.distance
        return Account(
            axes=self._axes.tally.snapshot(axes.pending + axes.held + warming),
            distance=self._distance.tally.snapshot(distance.pending + distance.held),
        )

    @property
    def budget(self) -> dict[str, float]:
        """Standard uncertainty of the heights by source [m], rms over all points."""
        points = max(self._axes.tally.corrected, 1)
        return {name: float(np.sqrt(sum_ / points)) for name, sum_ in self._variance.items()}

    def _filter_for(self, block: Block) -> MotionFilter:
        period = block.sample_period
        if self._motion is None or self._period is None:
            self._motion = self._begin(period)
        elif abs(period - self._period) > SAME_PERIOD * self._period:
            raise CalibrationError("correction.period_changed", period=period, before=self._period)
        return self._motion

    def _begin(self, period: float) -> MotionFilter:
        expected = self._calibration.sample_period
        same = abs(period - expected) <= SAME_PERIOD * expected
        if not (same or self._options.accept_other_rate):
            raise CalibrationError("correction.other_rate", period=period, calibrated=expected)
        self._period = period
        known = self._calibration
        lag = latency_in_use(known, self._options)
        members = known.members if isinstance(known, CalibrationSet) else (known,)
        filters = [MotionFilters.of(member, period, lag) for member in members]
        noise_gain = max(each.height.noise_gain for each in filters)
        self._random = reading_variances(self._sources, noise_gain, self._calibration.static_gain)
        self._scatter = RunningScatter(float(np.sqrt(sum(self._random.values()))))
        self._random["discretisation"] = self._sources.discretisation**2
        rows = [np.arange(len(f.dynamics)) >= len(f.dynamics) - f.undetected for f in filters]
        # The differences between members of a set come last and are not model errors.
        self.trace.undetected = np.concatenate([*rows, np.zeros(len(filters) - 1, np.bool_)])
        return MotionFilter(*filters, places=known if isinstance(known, CalibrationSet) else None)

    def _join(self) -> None:
        self._correct(self.pairing.pairs())

    def _correct(self, pairs: Iterable[tuple[SampleRun, SampleRun]]) -> None:
        for axes, distance in pairs:
            points = self._points(axes, distance)
            if len(points):
                self._ready.append(points)

    def _points(self, axes: SampleRun, distance: SampleRun) -> SurfacePoints:
        sample = np.arange(axes.first, axes.end)
        axis_values, probe_values = axes.values, distance.values
        if axes.reasons.any() or distance.reasons.any():
            good = (axes.reasons | distance.reasons) == RejectionReason.NONE
            sample = sample[good]
            axis_values, probe_values = axis_values[:, good], probe_values[:, good]
        x, y, b, c, dynamic_error, moved = axis_values[:RATE]
        if self._options.pitch is not None:
            moved = moved - self._options.pitch.over(self._options.geometry.abbe_arm, moved)
        reading, intensity = probe_values
        away = reading * (self._options.polarity / self._calibration.static_gain)
        where = workpiece_points(self._options.geometry, (x, y, moved), b, c, away)
        time = np.asarray(sample * (axes.period_ns / NANOSECONDS_PER_S), np.float64)
        points = self.trace.add(axes.session, time, where, (b, c), axis_values[MOVED:], away)
        return SurfacePoints(
            sample=sample,
            x=where.x,
            y=where.y,
            height=where.height,
            dynamic_error=dynamic_error,
            uncertainty=self._uncertainty(
                points, self._scatter.excess(axes.session, sample, where.height)
            ),
            intensity=intensity.astype(np.float32),
            stamp_ns=round(axes.stamp_of(int(sample[0]))) if len(sample) else 0,
        )

    def _uncertainty(self, points: ScanPoints, excess: FloatArray) -> FloatArray:
        variances: dict[str, FloatArray | float] = {**self._random, SCAN_SCATTER: excess}
        if any(source.kind.needs_slope for source in self._systematic):
            points = points.with_slopes(self._options.surface)
        for source in self._systematic:
            variances[source.name] = variances.get(source.name, 0.0) + source.variance(points)
        for name, variance in variances.items():
            common = isinstance(variance, float)
            self._variance[name] += float(np.sum(variance)) * (len(points) if common else 1)
        return np.sqrt(sum(variances.values()))


def latency_in_use(calibration: Calibration, options: CorrectionOptions) -> float:
    """Return the delay of X, Y, B and C [s]: the stated one, else the calibration's latency."""
    stated = options.probe_latency
    return calibration.latency.delay_s if stated is None else stated
