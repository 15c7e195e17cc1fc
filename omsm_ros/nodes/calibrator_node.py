"""``calibrator``: keeps the recent motion and identifies the dynamics of the loop on request."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omsm_msgs import action
from omsm_msgs.msg import AxisBlock, DistanceBlock
from omsm_msgs.srv import Identify
from std_msgs.msg import String

from omsm_ros import __version__, quantities
from omsm_ros.core.calibration.calibration import Calibration, settings_with
from omsm_ros.core.calibration.certificate import REJECTED, Origin
from omsm_ros.core.streams.monitoring import RecentIncrease
from omsm_ros.core.streams.motion_record import BlockBuffer, MotionRecord, assemble
from omsm_ros.core.streams.stamps import check_period
from omsm_ros.core.streams.trigger_slips import CommonTrigger
from omsm_ros.errors import BagError, ConfigurationError, FileError, OmsmError, one_line
from omsm_ros.io import message_mapping
from omsm_ros.io.calibration_file import CalibrationFolder
from omsm_ros.io.child_process import UNLIMITED, in_child
from omsm_ros.io.figure_messages import certificate_message
from omsm_ros.io.files import exclusive_lock, resolved_within
from omsm_ros.nodes.background_worker import BackgroundWorker, Goal, serve_action, silent
from omsm_ros.nodes.calibration_topic import CalibrationTopic
from omsm_ros.nodes.correction_parameters import BAG_FOLDERS, TRIGGER, trigger_of
from omsm_ros.nodes.diagnostics import WARN, StateReport
from omsm_ros.nodes.managed import ManagedNode
from omsm_ros.nodes.running import run, serve, settings_of
from omsm_ros.nodes.topics import LATCHED_BY_MANY_QOS, MessageInfo, listen
from omsm_ros.pipelines.history import record_in_catalogue
from omsm_ros.quantities import Parameter
from omsm_ros.report.verdict import verdict_text

# Identification takes seconds to load on a small computer, so it is imported in the thread that
# does the work, while samples are kept.
if TYPE_CHECKING:
    from omsm_ros.core.identification.identify import Identification

PARAMETERS = (
    Parameter("buffer_samples", 3_600_000, "samples kept per topic", quantities.BUFFER_SAMPLES),
    Parameter(
        "output",
        "calibration.json",
        "link to the calibration in force; each has a file in the same folder",
    ),
    Parameter("report", "", "folder for the certificate of each identification; empty = none"),
    Parameter("settings", "", "JSON object of the cell's settings, stored in the calibration"),
    Parameter("catalogue", "", "file or URL of the database to write it down in; empty = none"),
    BAG_FOLDERS,
    *TRIGGER,
)
_STREAMS = {"axes": AxisBlock, "confocal": DistanceBlock, "reference": DistanceBlock}


class CalibratorNode(ManagedNode):
    """Serves ``~/identify``; keeps every calibration, and publishes the one in force."""

    name, parameters = "calibrator", PARAMETERS

    def configure(self, undo: ExitStack) -> None:
        """Load the calibration that was in force, and answer requests."""
        self._settings = settings_of(self.values["settings"])
        self._trigger = trigger_of(self.values)
        self._folder = CalibrationFolder(Path(self.values["output"]))
        self._file = self._folder.link
        capacity = self.values["buffer_samples"]
        self._buffers: dict[str, BlockBuffer[Any]] = {
            topic: BlockBuffer(capacity) for topic in _STREAMS
        }
        self._refused = dict.fromkeys(_STREAMS, 0)
        self._recent = RecentIncrease()
        self._last, self._trouble = "nothing identified yet", ""
        try:
            undo.enter_context(exclusive_lock(self._folder.link))
        except FileError as err:  # it is published nevertheless
            self._trouble = str(err)
            self.get_logger().error(self._trouble)
        self._topic = CalibrationTopic(self, undo, self._adopt, listens=True)
        self._worker = BackgroundWorker(self, undo)
        serve(self, undo, Identify, "~/identify", self._on_identify)
        serve_action(self, undo, action.Identify, "~/identify", self._on_identify)
        self._probe: dict[str, object] = {}
        listen(self, undo, String, "probe_settings", self._on_probe, LATCHED_BY_MANY_QOS)
        self._publish_stored()

    def activate(self, undo: ExitStack) -> None:
        """Begin to keep the motion."""
        for topic, kind in _STREAMS.items():
            listen(self, undo, kind, topic, partial(self._keep, topic))

    def _keep(self, topic: str, message: AxisBlock | DistanceBlock, _: MessageInfo) -> None:
        try:
            self._buffers[topic].add(message_mapping.block_of(message))
        except OmsmError as err:
            self._refused[topic] += 1
            self.get_logger().warning(f"block refused: {err}", throttle_duration_sec=5.0)

    def _on_probe(self, message: String, _: MessageInfo) -> None:
        try:
            reported = message_mapping.probe_settings(message)
        except OmsmError as err:
            self.get_logger().error(f"probe settings refused: {err}", throttle_duration_sec=5.0)
            return
        if self._probe and reported != self._probe:
            self.get_logger().warning(
                "the probe's settings changed: the motion before is dropped; repeat the step test"
            )
            for buffer in self._buffers.values():
                buffer.forget()
        self._probe = reported

    def _publish_stored(self) -> None:
        try:
            known = self._folder.in_force()
        except OmsmError as err:
            self._trouble = str(err)
            self.get_logger().error(f"calibration in force: {err}")
            return
        if known is not None:
            self._topic.announce(*known)
            self._last = f"{known[0].id[:12]} in force, as before the start"

    def _adopt(self, calibration: Calibration, since_ns: int) -> None:
        """Keep a calibration of another node; it is published even if it cannot be kept."""
        certificate = calibration.certificate
        if certificate.verdict == REJECTED:
            raise ConfigurationError(f"rejected: {'; '.join(map(str, certificate.reasons))}")
        self._keep_file(calibration, since_ns)

    def _keep_file(self, calibration: Calibration, since_ns: int) -> str:
        try:
            self._file = file = self._folder.put(calibration, since_ns)
            self._trouble = ""
        except OmsmError as err:
            self._trouble = f"the calibration in force is not kept: {err}"
            self.get_logger().error(self._trouble)
            return self._trouble
        return f"kept as {file}"

    async def _on_identify(self, request: Any, response: Any, goal: Goal | None = None) -> None:
        """Answer the service, or the action with its ``goal``."""
        try:
            bag, folders = None, self.values["bag_folders"]
            if request.bag:
                bag = resolved_within(Path(request.bag), folders, BagError, "bag")
            identified = await self._worker.do(self._work(request, bag, goal), goal)
            if goal is not None:
                goal.attend()  # nothing is put in force for a goal that was cancelled
            calibration = identified.calibration
            since_ns = self._topic.decided()
            response.calibration = message_mapping.calibration_message(
                self._messages, calibration, since_ns
            )
            if goal is not None:
                response.certificate = certificate_message(self._messages, calibration)
            response.success, self._last = self._judge(calibration, since_ns)
            if response.success and self.values["catalogue"]:
                self._last += await self._worker.do(partial(self._noted, bag, calibration))
            if self.values["report"]:
                said = await self._worker.do(partial(self._certified, bag, identified))
                self._last += said
        except OmsmError as err:
            response.success, self._last = False, f"identification failed: {one_line(err)}"
        if response.success or (goal is not None and goal.cancelled):
            self.get_logger().info(self._last)
        else:
            self.get_logger().error(self._last)
        response.message = self._last

    def _judge(self, calibration: Calibration, since_ns: int) -> tuple[bool, str]:
        certificate = calibration.certificate
        if certificate.verdict == REJECTED:
            # An earlier calibration stays in use.
            return False, f"rejected: {'; '.join(map(str, certificate.reasons))}"
        kept = self._keep_file(calibration, since_ns)
        self._topic.announce(calibration, since_ns)
        return True, f"{verdict_text(calibration)}; {calibration.id[:12]} {kept}"

    def _noted(self, bag: Path | None, calibration: Calibration) -> str:
        """Add it to the catalogue and return a note; an error of the database is only a note."""
        # SQLAlchemy is an optional package.
        from omsm_ros.pipelines.history import keep_calibration

        warnings = record_in_catalogue(
            self.values["catalogue"],
            lambda: keep_calibration(self.values["catalogue"], calibration, self._file, bag),
        )
        return f"; {'; '.join(warnings)}" if warnings else "; written into the catalogue"

    def _certified(self, bag: Path | None, identified: Identification) -> str:
        """Write the certificate and return a note; an error of the disk is only a note."""
        # matplotlib takes a second to import, and most calibrators do not need it.
        from omsm_ros.pipelines.identify import write_certificate

        folder = Path(self.values["report"])
        try:
            source = bag.name if bag else "live recording"
            page = write_certificate(folder, identified, source=source)
        except OmsmError as err:
            return f"; no certificate: {err}"
        return f"; certificate in {page}"

    def _work(self, request: Any, bag: Path | None, goal: Goal | None):  # type: ignore[no-untyped-def]
        """Return the work of a request; the samples that it needs are taken now."""
        attend = goal.attend if goal is not None else None
        duration = quantities.DURATION.checked(request.duration)
        order = quantities.ORDER.checked(request.order)
        if (source := request.input or "encoder") not in ("encoder", "reference"):
            raise ConfigurationError("estimation.unknown_input", input=source)
        options = {"order": order, "input": source}
        if bag:
            lapse = self._time_lapse
            work = partial(_identify_bag, bag, duration, self._settings, lapse, self._trigger)
            return partial(in_child, partial(work, options), attend=attend)
        streams = [self._buffers[topic].recent(duration) for topic in _STREAMS]
        options |= {
            "settings": settings_with(self._settings, [self._probe]),
            "origin": _origin(int(self.get_clock().now().nanoseconds)),
        }

        def live() -> Any:
            work = partial(_identified, self._live_motion(*streams), options)
            return in_child(work, math.inf, UNLIMITED, attend) if attend else work()

        return live

    def _live_motion(self, *streams: Any) -> MotionRecord:
        faster = quantities.TIME_LAPSE.checked(self._time_lapse, ConfigurationError, "time_lapse")
        if faster == 1.0:  # the stamps of a time lapse depend on the computer that plays it
            for name, blocks in zip(_STREAMS, streams, strict=True):
                check_period(name, blocks)
        return assemble(*streams, trigger=self._trigger)  # type: ignore[misc]

    @property
    def _time_lapse(self) -> object:
        return self._settings.get("time_lapse", 1.0)

    def report(self) -> StateReport:
        """Return the samples held, the calibration in force, and the blocks refused."""
        values: dict[str, object] = {
            "calibration": self._topic.id,
            "requests_waiting": self._worker.waiting,
            "blocks_refused": sum(self._refused.values()),
        }
        for topic, buffer in self._buffers.items():
            name = "distance" if topic == "confocal" else topic
            values |= {f"{name}_held": len(buffer), f"{name}_forgotten": buffer.forgotten}
        report = StateReport(self._last, values)
        for topic in self._recent.update(self._refused, time.monotonic()):
            report.add(WARN, f"blocks on {topic} are refused, see the log")
        if self._trouble:
            report.add(WARN, self._trouble)
        return report


def _identify_bag(
    bag: Path,
    duration: float,
    stated: dict[str, object],
    time_lapse: object,
    trigger: CommonTrigger,
    options: dict[str, Any],
    progress: Callable[..., None] = silent,
) -> Identification:
    # Loaded on demand, because reading bags takes long to import.
    from omsm_ros.pipelines.recording import Recording

    with Recording(bag) as recording:
        motion = recording.motion(duration=duration, time_lapse=time_lapse, trigger=trigger)
        settings = recording.settings(stated)
        origin = _origin(recording.recorded_ns)
    options = {**options, "settings": settings, "origin": origin}
    return _identified(motion, options, progress)


def _identified(
    motion: MotionRecord, options: dict[str, Any], progress: Callable[..., None] = silent
) -> Identification:
    from omsm_ros.core.identification.identify import identify

    return identify(motion, progress=progress, **options)


def _origin(recorded_ns: int | None) -> Origin:
    return Origin(recorded_ns=recorded_ns, software=f"omsm_ros {__version__}")


main = partial(run, CalibratorNode)
