"""The one pass over a recorded scan: its blocks go through the corrector as they are read."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import chain
from types import TracebackType
from typing import Any

from omsm_ros.core.correction.applicability import admit, objections
from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
from omsm_ros.core.correction.scan_trace import ScanTrace
from omsm_ros.core.correction.surface_points import SurfacePoints
from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.samples.accounts import Account, Reason
from omsm_ros.core.samples.blocks import AxisBlock, DistanceBlock
from omsm_ros.core.samples.joining_by_stamp import axes_at_probe
from omsm_ros.core.samples.slips import CommonTrigger, Slip
from omsm_ros.errors import BagError, ConfigurationError
from omsm_ros.jobs.progress import Progress, no_progress
from omsm_ros.quantities import TIME_LAPSE
from omsm_ros.storage import bags
from omsm_ros.storage.recording.topics import AnyBag

TOPICS = (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)
# A quarter of a gigabyte: one stream may be recorded that far ahead of the other.
MOST_WAITING = 4_000_000


@dataclass(frozen=True)
class Admission:
    """May a calibration be used here?

    settings: of this scan, to be compared with the calibration's; None = not known
    override: use it all the same; what spoke against it is written into every result
    """

    settings: Mapping[str, object] | None = None
    override: bool = False


@dataclass(frozen=True)
class ByStamps:
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
        by_stamps: ByStamps | None = None,
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
            self._corrector = Corrector(self._calibration, self._options, MOST_WAITING)
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
    def slip(self) -> Slip | None:
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
        name = Reason.OVERDUE.name.lower()
        account = self.account
        lost = min(s.counted.get(name, 0) for s in (account.axes, account.distance))
        if lost:
            raise BagError(
                f"{str(self.path)!r}: {lost} samples waited for their partners in vain, for one "
                f"stream was recorded more than {MOST_WAITING} samples ahead of the other; "
                "record both at the same time"
            )
        received = (account.axes.received, account.distance.received)
        for topic, samples in zip(TOPICS, received, strict=True):
            if not samples:
                raise BagError(f"{str(self.path)!r} has no samples on {topic!r}; record a scan")


def _joined_by_stamps(bag: bags.BagReader, how: ByStamps) -> Iterator[AxisBlock | DistanceBlock]:
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
