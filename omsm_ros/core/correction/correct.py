"""What is the surface's height, free of the machine's dynamics?

``height = H(z) + polarity · distance / static_gain`` (Eq. 10, 13), with H the discretised G_m
run over the encoder's stream. The probe's dropouts cost their own points only. A stream may
be cut into blocks anywhere and the two be interleaved anyhow: the points are the same to
the last bit, live and offline.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from omsm_ros.core.calibration.calibration import Calibration, latency_of
from omsm_ros.core.calibration.calibration_set import CalibrationSet
from omsm_ros.core.correction.motion_filter import (
    MOVED,
    RATE,
    Blend,
    MotionFilter,
    MotionFilters,
    undetected_rows,
)
from omsm_ros.core.correction.surface_points import SurfacePoints, join_points
from omsm_ros.core.correction.systematic import ScanPoints, ScanTrace, SystematicSource
from omsm_ros.core.correction.uncertainty import (
    SCAN_SCATTER,
    ErrorSources,
    contributions,
    reading_variances,
)
from omsm_ros.core.kinematics.kinematics import Geometry, PitchCurve, Surface, workpiece_points
from omsm_ros.core.streams.blocks import (
    SAME_PERIOD,
    Account,
    AxisBlock,
    Block,
    BoolArray,
    DistanceBlock,
    FloatArray,
    RejectionReason,
    joined,
)
from omsm_ros.core.streams.continuity import Arrival
from omsm_ros.core.streams.pairing import Pairing, SampleRun, StreamInput
from omsm_ros.core.streams.statistics import RunningScatter
from omsm_ros.core.streams.trigger_slips import EQUAL_COUNTS, CommonTrigger, TriggerSlipDetector
from omsm_ros.errors import CalibrationError, ConfigurationError
from omsm_ros.quantities import GAIN, LAG, WAIT
from omsm_ros.units import NANOSECONDS_PER_S


@dataclass(frozen=True, kw_only=True)
class CorrectionOptions:
    """How to correct.

    polarity: 1 if the distance falls when z rises, -1 for a probe mounted the other way
    static_gain: probe travel per encoder travel [1]; None takes the calibration's
    accept_other_rate: correct data of another sample period than the calibration's
    max_pending: how long a sample waits for its partner [s]; the newest block always may
    sources: other uncertainties; None takes what the calibration's certificate states
    lateral_lag: how late the probe's reading is [s], by which X, Y, B and C are delayed too;
        None takes the latency that the calibration's certificate states
    geometry: where the probe sits and looks
    systematic: what else is uncertain of the whole scan; into each point's uncertainty goes what
        can be known of it there: what shifts points laterally, only with a ``surface``
    surface: nominal, for its slopes
    pitch: of Z, measured; over the geometry's Abbe arm it is taken off the encoder
    trigger: what is stated of the counters of the two streams
    """

    polarity: int = 1
    static_gain: float | None = None
    accept_other_rate: bool = False
    max_pending: float = 10.0
    sources: ErrorSources | None = None
    lateral_lag: float | None = None
    geometry: Geometry = field(default_factory=Geometry)
    systematic: tuple[SystematicSource, ...] = ()
    surface: Surface | None = None
    pitch: PitchCurve | None = None
    trigger: CommonTrigger = EQUAL_COUNTS

    def __post_init__(self) -> None:
        if self.polarity not in (1, -1):
            raise ConfigurationError(f"polarity {self.polarity!r}, expected 1 or -1")
        if self.static_gain is not None:
            GAIN.checked(self.static_gain, ConfigurationError, "static_gain")
        if self.lateral_lag is not None:
            LAG.checked(self.lateral_lag, ConfigurationError, "lateral_lag")
        WAIT.checked(self.max_pending, ConfigurationError, "max_pending")


class Corrector:
    """Turns axis and distance blocks into surface points, in the order of their triggers.

    trace: some of the points, evenly chosen, for what acts on the whole scan

    Push the two streams about as they came: what waits longer than ``max_pending`` for its
    partner is given up, so that memory stays bounded. Each may also come as one block.

    most_waiting: samples that may wait, for files, which know no time; None = ``max_pending``
    """

    def __init__(
        self,
        calibration: Calibration,
        options: CorrectionOptions = CorrectionOptions(),
        most_waiting: int | None = None,
    ) -> None:
        self._calibration = calibration
        self._options = options
        self._most_waiting = most_waiting
        self._static_gain = options.static_gain or calibration.static_gain
        self._sources = options.sources or ErrorSources.of(calibration)
        self._period: float | None = None
        self._axes, self._distance = StreamInput(), StreamInput(options.trigger.counter_offset)
        self._pairing = Pairing(self._axes, self._distance, options.trigger)
        self._motion: MotionFilter | None = None
        self._noise_gain = 1.0
        self._variance: defaultdict[str, float] = defaultdict(float)
        self._ready: list[SurfacePoints] = []
        self._systematic = [
            source
            for source in options.systematic
            if options.surface is not None or not source.needs_slope
        ]
        self.trace = ScanTrace()

    def push_axes(self, *blocks: AxisBlock) -> None:
        """Filter the encoder's samples of a block, or of several that follow on, at once.

        Raises CalibrationError for a sample period the calibration does not hold for.
        """
        block = joined(blocks)
        motion = self._filter_for(block)
        if (arrival := self._axes.new(block, blocks)) is not None:
            for run in motion.push(_axes_run(block, arrival)):
                self._pairing.axes.push(run)
            self._join()
            self._pairing.axes.limit(self._most_pending(block))

    def push_distance(self, *blocks: DistanceBlock) -> None:
        """Queue the probe's readings of a block, or of several that follow on, at once.

        Raises CalibrationError for a sample period the calibration does not hold for.
        """
        block = joined(blocks)
        self._filter_for(block)
        if (arrival := self._distance.new(block, blocks)) is not None:
            self._pairing.distance.push(_distance_run(block, arrival))
            self._join()
            self._pairing.distance.limit(self._most_pending(block))

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
        """Correct the pairs that wait for stamps to come, for both streams have paused."""
        self._correct(self._pairing.end())

    def finish(self) -> SurfacePoints | None:
        """End both streams and take what is left; what comes later begins a new session."""
        if self._motion is not None:
            for run in self._motion.end():
                self._pairing.axes.push(run)
        self._join()
        self._correct(self._pairing.end())
        for queue in (self._pairing.axes, self._pairing.distance):
            queue.clear()
        for intake in (self._axes, self._distance):
            intake.end()
        return self.take()

    @property
    def account(self) -> Account:
        """Where every sample received so far has gone."""
        warming = self._motion.pending if self._motion else 0
        axes, distance = self._pairing.axes, self._pairing.distance
        return Account(
            axes=self._axes.tally.snapshot(axes.pending + axes.held + warming),
            distance=self._distance.tally.snapshot(distance.pending + distance.held),
        )

    @property
    def stamp_skew(self) -> float | None:
        """Time of the axes minus time of the distance for the newest common trigger [s].

        Large or drifting, it is a sign of devices that count different triggers.
        """
        return self._pairing.stamp_skew

    @property
    def held(self) -> int:
        """Pairs that wait for stamps to show that their equal counts are one trigger [samples]."""
        return self._pairing.axes.held

    @property
    def slips(self) -> TriggerSlipDetector:
        """Whether the two counters have slipped against each other, and by how much."""
        return self._pairing.watch

    @property
    def budget(self) -> dict[str, float]:
        """Standard uncertainty of the heights by its source [m], root mean square of all points."""
        points = max(self._axes.tally.corrected, 1)
        return {name: float(np.sqrt(sum_ / points)) for name, sum_ in self._variance.items()}

    def _filter_for(self, block: Block) -> MotionFilter:
        period = block.sample_period
        if self._motion is None or self._period is None:
            self._motion = self._begin(period)
        elif abs(period - self._period) > SAME_PERIOD * self._period:
            raise CalibrationError(
                f"sample period {period!r} s after blocks of {self._period!r} s; "
                "both streams must keep one sample period"
            )
        return self._motion

    def _begin(self, period: float) -> MotionFilter:
        expected = self._calibration.sample_period
        same = abs(period - expected) <= SAME_PERIOD * expected
        if not (same or self._options.accept_other_rate):
            raise CalibrationError(
                f"sample period {period!r} s, but the calibration was identified at "
                f"{expected!r} s; identify at this rate or accept another rate explicitly"
            )
        self._period = period
        known = self._calibration
        lag = lateral_lag(known, self._options)
        members = known.members if isinstance(known, CalibrationSet) else (known,)
        filters = [MotionFilters.of(member, period, lag) for member in members]
        self._noise_gain = max(each.height.noise_gain for each in filters)
        stated = reading_variances(self._sources, self._noise_gain, self._static_gain)
        self._scatter = RunningScatter(float(np.sqrt(sum(stated.values()))))
        self.trace.undetected = undetected_rows(filters)
        blend = Blend(known) if isinstance(known, CalibrationSet) else None
        return MotionFilter(*filters, blend=blend)

    def _join(self) -> None:
        self._correct(self._pairing.pairs())

    def _correct(self, pairs: Iterable[tuple[SampleRun, SampleRun]]) -> None:
        for axes, distance in pairs:
            points = self._points(axes, distance)
            if len(points):
                self._ready.append(points)

    def _points(self, axes: SampleRun, distance: SampleRun) -> SurfacePoints:
        sample = np.arange(axes.first, axes.end)
        axis_values, probe_values = axes.values, distance.values
        if axes.reasons.any() or distance.reasons.any():
            good = _as_slice((axes.reasons | distance.reasons) == RejectionReason.NONE)
            sample = sample[good]
            axis_values, probe_values = axis_values[:, good], probe_values[:, good]
        x, y, b, c, dynamic_error, moved = axis_values[:RATE]
        if self._options.pitch is not None:
            moved = moved - self._options.pitch.over(self._options.geometry.abbe_arm, moved)
        reading, intensity = probe_values
        away = reading * (self._options.polarity / self._static_gain)
        where = workpiece_points(self._options.geometry, (x, y, moved), b, c, away)
        time = np.asarray(sample * (axes.period_ns / NANOSECONDS_PER_S), np.float64)
        points = self.trace.add(axes.session, time, where, c, axis_values[MOVED:], away)
        return SurfacePoints(
            sample=sample,
            x=where.x,
            y=where.y,
            height=where.height,
            dynamic_error=dynamic_error,
            uncertainty=self._uncertainty(
                reading, points, self._scatter.excess(axes.session, sample, where.height)
            ),
            intensity=intensity.astype(np.float32),
            stamp_ns=round(axes.stamp_of(int(sample[0]))) if len(sample) else 0,
        )

    def _dynamics_variances(self, points: ScanPoints) -> tuple[FloatArray, FloatArray]:
        """Return the variances of H(z) [m²], (n,), by the step test's noise and by hidden terms."""
        noise, undetected = np.zeros((2, len(points)))
        for row, may_be_undetected in zip(points.dynamics, points.undetected, strict=True):
            total = undetected if may_be_undetected else noise
            total += row**2
        return noise, undetected

    def _uncertainty(
        self, reading: FloatArray, points: ScanPoints, excess: FloatArray
    ) -> FloatArray:
        variances = contributions(
            self._sources,
            self._noise_gain,
            self._static_gain,
            reading,
            *self._dynamics_variances(points),
            points.z_rate,
            self._options.geometry.abbe_arm,
        )
        variances[SCAN_SCATTER] = excess
        if self._systematic and self._options.surface is not None:
            points = points.with_slopes(self._options.surface)
        for source in self._systematic:
            variances[source.name] = variances.get(source.name, 0.0) + source.variance(points)
        for name, variance in variances.items():
            common = isinstance(variance, float)
            self._variance[name] += float(np.sum(variance)) * (len(reading) if common else 1)
        return np.sqrt(sum(variances.values()))


def _as_slice(chosen: BoolArray) -> BoolArray | slice:
    """Return ``chosen`` (n,), as a slice where it is one: then nothing is copied."""
    first, last = int(np.argmax(chosen)), len(chosen) - int(np.argmax(chosen[::-1]))
    return slice(first, last) if np.sum(chosen) == last - first else chosen


def lateral_lag(calibration: Calibration, options: CorrectionOptions) -> float:
    """Return the delay of X, Y, B and C [s]: the stated one, else the calibration's latency."""
    stated = options.lateral_lag
    return latency_of(calibration).delay_s if stated is None else stated


def _axes_run(block: AxisBlock, arrival: Arrival) -> SampleRun:
    values = np.array([block.x, block.y, block.z, block.b, block.c], np.float64)
    return SampleRun.of(block, arrival, np.zeros(len(block), np.uint8), values)


def _distance_run(block: DistanceBlock, arrival: Arrival) -> SampleRun:
    intensity = block.intensity if len(block.intensity) else np.full(len(block), np.nan)
    reasons = np.where(block.ok, RejectionReason.NONE, RejectionReason.INVALID).astype(np.uint8)
    return SampleRun.of(block, arrival, reasons, np.array([block.distance, intensity], np.float64))
