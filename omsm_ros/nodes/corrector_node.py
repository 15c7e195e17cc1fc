"""``corrector``: computes corrected surface points from axes and distance, continuously."""

import time
from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

from omsm_msgs import action
from omsm_msgs.msg import Account as AccountMessage
from omsm_msgs.msg import AxisBlock, DistanceBlock, Verdict
from omsm_msgs.srv import LoadCalibration, PredictError
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String

from omsm_ros.core.calibration.applicability import admit, objections
from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.correction.correct import Corrector
from omsm_ros.core.correction.counter_offset import LiveOffset
from omsm_ros.core.correction.predict import Prediction
from omsm_ros.core.correction.surface_points import SurfacePoints, pack_points
from omsm_ros.core.streams.blocks import Account, consecutive
from omsm_ros.core.streams.monitoring import LoadMeter, RecentIncrease, SampleFlow
from omsm_ros.core.streams.trigger_slips import TriggerSlip
from omsm_ros.errors import BagError, CalibrationError, Notice, OmsmError
from omsm_ros.io import message_mapping
from omsm_ros.io.calibration_file import load_calibration, load_for_others, since
from omsm_ros.io.child_process import in_child
from omsm_ros.io.descriptions import load_surface
from omsm_ros.io.figure_messages import account_message, verdict_message
from omsm_ros.io.files import resolved_within
from omsm_ros.nodes import topics
from omsm_ros.nodes.background_worker import BackgroundWorker, Goal, serve_action
from omsm_ros.nodes.calibration_topic import CalibrationTopic
from omsm_ros.nodes.correction_parameters import PARAMETERS, accuracy_of, options_of, sources_of
from omsm_ros.nodes.diagnostics import ERROR, WARN, StateReport
from omsm_ros.nodes.managed import ManagedNode
from omsm_ros.nodes.running import run, serve, settings_of
from omsm_ros.nodes.topics import LATCHED_BY_MANY_QOS, MessageInfo, every, listen, take_rest
from omsm_ros.pipelines.measure import live_verdict, with_sources
from omsm_ros.report.verdict import next_steps

# A motion has paused after this time without a block, or the duration of three blocks [s].
PAUSE_S, _PAUSE_BLOCKS = 1.0, 3
_STREAMS = {"axes": ("axes", AxisBlock), "distance": ("confocal", DistanceBlock)}
# At the end, drivers send their last block within the time of so many looks.
_LAST_LOOKS = 20
# Half of the two seconds for which small blocks can wait [ms].
_DELAYED_MS = 1000.0
# Reasons that mean a loss of data, unlike a probe without a target.
_LOSSES = ("unmatched", "late", "overdue", "jumped")
_FLOW = ("received", "refused", "corrected", "invalid")


class CorrectionState:
    """Counts samples that are not corrected, and reports on all of them."""

    def __init__(self) -> None:
        self.uncalibrated = dict.fromkeys(_STREAMS, 0)
        self.refused = dict.fromkeys(_STREAMS, 0)
        self.outside = {"uncalibrated": self.uncalibrated, "refused": self.refused}
        self.refusal = ""
        self.published = 0
        self.load = LoadMeter()
        self.begins_at: dict[str, int] = {}
        self._heard = dict.fromkeys(_STREAMS, 0)
        self._period = dict.fromkeys(_STREAMS, 0.0)
        self._flows = {stream: SampleFlow() for stream in _STREAMS}
        self._recent = RecentIncrease()
        self._oldest_ns = 0
        self._resumes = 0.0
        self._ended = Account()

    def keep(self, account: Account) -> None:
        """Add the account of a correction that has ended to those before it."""
        self._ended += account

    def account(self, corrector: Corrector | None) -> Account:
        """Return the account of all corrections since the node was configured."""
        return self._ended + corrector.account if corrector else self._ended

    def heard(self, stream: str, first: int, samples: int, period: float, now: float) -> None:
        """Count a block; first: its trigger number;  now: [s]."""
        self._resumes = now + max(PAUSE_S, _PAUSE_BLOCKS * samples * period)
        self.begins_at.setdefault(stream, first)
        self._heard[stream] += samples
        self._period[stream] = period

    def has_paused(self, now: float) -> bool:
        """Return whether no block came for longer than within a motion; now: [s]."""
        return now > self._resumes

    def arrived(self, stamp_ns: int) -> None:
        """Note the arrival of one of the messages that are now taken [ns]."""
        self._oldest_ns = min(self._oldest_ns or stamp_ns, stamp_ns)

    def done(self, now_ns: int) -> None:
        """Note that all messages that arrived are processed [ns]."""
        if self._oldest_ns:
            self.load.block(self._oldest_ns, now_ns)
        self._oldest_ns = 0

    def report(
        self, corrector: Corrector | None, now: float, cpu: float, motion: LiveOffset | None = None
    ) -> StateReport:
        """Return the report; ``corrector`` is None without a calibration.

        motion: estimate of the offset of two devices' counters
        """
        report = StateReport("correcting", {"clouds_published": self.published})
        for name, counts in self.outside.items():
            report.values |= {f"{stream}_{name}": counts[stream] for stream in _STREAMS}
        report.values |= {f"begins_at_{name}": first for name, first in self.begins_at.items()}
        for stream, flow in self._flows.items():
            flow.update(self._heard[stream], now)
            report.values[f"rate_hz_{stream}"] = round(flow.rate, 3)
            none = f"no sample of {stream}"
            silent, period = flow.silent(now), self._period[stream]
            report.add_silence(silent, period, f"{none} for {{:.0f}} s", f"{none} yet")
        if corrector is None:
            report.add(WARN, "no calibration: nothing is published")
            return report
        report.values |= self.load.report(cpu, now)
        report.values["stamp_skew_s"] = corrector.pairing.stamp_skew
        slip = corrector.pairing.watch.state
        report.values |= {"slip_samples": slip.samples, "slip_seen_from_samples": slip.seen_from}
        report.values["pairs_held"] = corrector.pairing.axes.held
        if slip.samples:
            report.add(ERROR, f"not corrected: {slip}")
        if corrector.pairing.watch.in_doubt:
            report.add(WARN, "the stamps do not show yet whether both devices count alike: waiting")
        if motion is not None:
            _add_motion(report, slip, motion)
        report.values |= {f"rms_{name}_m": value for name, value in corrector.budget.items()}
        self._add_losses(report, self._account(report, corrector), now)
        waited = self.load.worst_ms()
        if waited > _DELAYED_MS:
            report.add(WARN, f"falls behind: samples waited {waited / 1000:.1f} s")
        return report

    def _account(self, report: StateReport, corrector: Corrector) -> dict[str, float]:
        """Enter all counts into ``report``; return those that may mean a loss."""
        watched: dict[str, float] = {}
        for stream, account in self.account(corrector).as_dict().items():
            counts: dict[str, int] = {**account}  # type: ignore[dict-item]
            counted: dict[str, int] = counts.pop("counted")  # type: ignore[assignment]
            missing = counts.pop("missing")
            report.values[f"missing_{stream}"] = watched[f"{stream} missing"] = missing
            for name, value in (counts | counted).items():
                report.values[f"{stream}_{name}"] = value
                if name in (*_LOSSES, *_FLOW):
                    watched[f"{stream} {name}"] = value
            watched[f"{stream} refused"] = self.refused[stream]
        return watched

    def _add_losses(self, report: StateReport, watched: dict[str, float], now: float) -> None:
        rises = self._recent.update(watched, now)
        for stream in _STREAMS:
            received, refused, corrected, invalid = (
                rises.pop(f"{stream} {name}", 0) for name in _FLOW
            )
            if refused and not received:
                report.add(ERROR, f"every block of {stream} is refused: {self.refusal}")
            elif refused:
                report.add(WARN, f"just now: {refused:.0f} samples of {stream} refused")
        if invalid and not corrected:  # alike in both streams
            why = "the probe sees no surface, or an axis is lost"
            report.add(WARN, f"nothing to correct: {invalid:.0f} samples invalid just now: {why}")
        if rises:
            text = ", ".join(f"{name} {rise:.0f}" for name, rise in rises.items())
            report.add(WARN, f"just now: {text}")


def _add_motion(report: StateReport, slip: TriggerSlip, motion: LiveOffset) -> None:
    """Enter the counter offset estimated from a motion, and compare it with the stamps."""
    offset = motion.established
    report.values["motion_offset_samples"] = offset and offset.samples
    if offset and offset.samples:
        report.add(
            ERROR,
            f"the motion shows that the counts are {offset.samples} samples apart (± "
            f"{offset.uncertainty:.2g}), so heights are wrong by what Z moves meanwhile: state "
            f"counter_offset {motion.in_use + offset.samples}, or identify again if "
            "the lag changed",
        )
    elif offset and slip.samples:
        report.add(ERROR, "but the motion shows that equal counts are one trigger: a link is late")


_COMPLAINT_PERIOD_S = 5.0
_OVERRIDDEN = "_overridden"


class CorrectorNode(ManagedNode):
    """Publishes points as soon as it has a calibration; a new one begins a new correction."""

    name, parameters = "corrector", PARAMETERS

    def configure(self, undo: ExitStack) -> None:
        """Load the initial calibration, and answer requests."""
        self._settings = settings_of(self.values["settings"])
        self._options, self._sources = options_of(self.values), sources_of(self.values)
        nominal = self.values["nominal"]
        self._nominal = load_surface(nominal) if nominal else None
        self._frame = self.values["workpiece_frame"]
        self._corrector: Corrector | None = None
        self._motion: LiveOffset | None = None
        self._probe: dict[str, object] = {}
        self._foreign = ""
        self._overridden: tuple[Notice, ...] = ()
        self._state = CorrectionState()
        self._waiting: dict[str, list[Any]] = {}
        self._points = self.publish_on(undo, PointCloud2, "points")
        self._accounts = self.publish_on(undo, AccountMessage, "account")
        self._verdicts = self.publish_on(undo, Verdict, "verdict")
        self._topic = CalibrationTopic(
            self, undo, lambda heard, _: self._use(heard), self.values["follow_calibrator"]
        )
        listen(self, undo, String, "probe_settings", self._on_probe, LATCHED_BY_MANY_QOS)
        topics.publish_frames(self, undo, self._options.geometry, self.values)
        self._worker = BackgroundWorker(self, undo)
        serve(self, undo, LoadCalibration, "~/load_calibration", self._on_load)
        serve(self, undo, PredictError, "~/predict_error", self._on_predict)
        serve_action(self, undo, action.PredictError, "~/predict_error", self._on_predict)
        if path := self.values["calibration"]:
            self._put_in_force(load_calibration(path), since(Path(path)))
        else:
            self.get_logger().info("no calibration yet: nothing will be published")

    def activate(self, undo: ExitStack) -> None:
        """Begin to correct."""
        undo.callback(self._publish_rest)
        heard: list[Any] = []
        every(self, undo, PAUSE_S / 2, self._settle)
        for stream, (topic, kind) in _STREAMS.items():
            self._waiting[stream] = []
            take, push = partial(self._take, stream), partial(self._push, stream)
            heard.append((listen(self, undo, kind, topic, take, after=push), take))
        undo.callback(self._take_rest, heard)

    def _take_rest(self, heard: Sequence[Any]) -> None:
        """Correct what the drivers, which end at the same time, have sent last."""
        if not take_rest(heard, _LAST_LOOKS):
            self.get_logger().warning("the last samples were not corrected: too many waited")
        for stream in _STREAMS:
            self._push(stream)

    def _put_in_force(self, calibration: Calibration, since_ns: int) -> None:
        self._use(calibration)
        self._topic.announce(calibration, since_ns)

    def _objections(self, calibration: Calibration) -> tuple[Notice, ...]:
        return objections(
            calibration,
            settings=self._settings or None,
            probe=[self._probe],
            polarity=self._options.polarity,
        )

    def _use(self, calibration: Calibration) -> None:
        reasons = self._objections(calibration)
        override = self.values["override"]
        admit(calibration, reasons, override)
        corrector = Corrector(
            calibration, with_sources(self._options, calibration, self._sources, self._nominal)
        )
        # No error can occur from here on, so the new calibration is either wholly in force or not.
        self._end_correction()
        # With another frame, a viewer of the usual frame shows nothing until the user has noticed.
        self._frame = self.values["workpiece_frame"] + (_OVERRIDDEN if reasons else "")
        for reason in reasons:
            self.get_logger().warning(f"overridden: {reason}")
        self._corrector, self._foreign, self._overridden = corrector, "", reasons
        self._motion = LiveOffset(calibration, self._options.trigger.counter_offset)
        self.get_logger().info(f"calibration {calibration.id[:12]} in use")

    def _on_probe(self, message: String, _: MessageInfo) -> None:
        """Stop the correction if the calibration is for other settings of the probe; else begin."""
        try:
            reported = message_mapping.probe_settings(message)
        except OmsmError as err:
            self._warn(f"probe settings refused: {err}")
            return
        if reported == self._probe:
            return
        self._probe = reported
        known = self._topic.calibration
        if known is None or (self._corrector and self._objections(known) == self._overridden):
            return
        try:
            self._use(known)
        except OmsmError as err:
            self._end_correction()
            self._foreign = str(err)
            self.get_logger().error(self._foreign)

    def _publish_rest(self) -> None:
        if self._corrector is not None:
            self._publish(self._corrector.finish())
            account = self._state.account(self._corrector)
            self.get_logger().info(f"samples so far: {account.as_dict()}")
            self._publish_account()

    def _publish_account(self) -> None:
        state, now_ns = self._state, self.get_clock().now().nanoseconds
        counts = state.account(self._corrector), state.outside, state.published
        self._accounts.publish(account_message(self._messages, *counts, now_ns))

    def _end_correction(self) -> None:
        self._publish_rest()
        if self._corrector is not None:
            self._state.keep(self._corrector.account)
            self._corrector = None

    async def _on_load(
        self, request: LoadCalibration.Request, response: LoadCalibration.Response
    ) -> None:
        response.id = self._topic.id
        if not request.path:
            raise CalibrationError("no path is given; name a file of a calibration, CAL.json")
        folders = self.values["calibration_folders"]
        path = resolved_within(Path(request.path), folders, CalibrationError, "calibration")
        calibration = await self._worker.do(partial(load_for_others, path))
        self._put_in_force(calibration, self._topic.decided())
        response.success, response.message = True, "in use"
        response.id = self._topic.id

    async def _on_predict(self, request: Any, response: Any, goal: Goal | None = None) -> None:
        # Without a prediction the error is not zero but unknown.
        response.peak_to_valley = response.rms = response.outside_band_fraction = float("nan")
        bag = request.bag
        if bag:
            bag = str(resolved_within(Path(bag), self.values["bag_folders"], BagError, "bag"))
        known, period = self._topic.calibration, request.sample_period
        predict = partial(_prediction, known, bag, request.z, period)
        if goal is not None or bag:
            predict = partial(in_child, predict, attend=goal.attend if goal else None)
        prediction = await self._worker.do(predict, goal)
        for name in ("peak_to_valley", "rms", "outside_band_fraction", "safe", "message"):
            setattr(response, name, getattr(prediction, name))
        if goal is not None:
            response.success = True

    def _take(self, stream: str, message: Any, info: MessageInfo) -> None:
        samples = len(message.z if stream == "axes" else message.distance)
        if stream not in self._state.begins_at:
            self.get_logger().info(f"{stream}: begins at trigger {message.first_sample}")
        period = message.sample_period
        self._state.heard(stream, message.first_sample, samples, period, time.monotonic())
        if self._corrector is None:
            self._state.uncalibrated[stream] += samples
            self._warn(
                self._foreign or "samples arrive without a calibration: call identify or load one"
            )
            return
        self._state.arrived(info["received_timestamp"])
        try:
            block = message_mapping.block_of(message)
            self._waiting[stream].append(block)
            if self._motion:
                self._motion.add(block)
        except OmsmError as err:
            self._refuse(stream, samples, err)

    def _push(self, stream: str) -> None:
        """Correct the waiting blocks together, which takes less time per sample."""
        blocks, self._waiting[stream] = self._waiting[stream], []
        if self._corrector is None:
            return
        push: Any = self._corrector.push_axes if stream == "axes" else self._corrector.push_distance
        for together in consecutive(blocks):
            try:
                push(*together)
            except OmsmError as err:
                self._refuse(stream, sum(map(len, together)), err)
            # One cloud for each run, since the middleware reserves memory for its longest message.
            self._publish(self._corrector.take())
        self._state.done(time.time_ns())

    def _settle(self) -> None:
        """Publish the samples that wait for stamps once the motion has ended."""
        if (
            self._corrector
            and self._corrector.pairing.axes.held
            and self._state.has_paused(time.monotonic())
        ):
            self._corrector.settle()
            self._publish(self._corrector.take())

    def _refuse(self, stream: str, samples: int, err: OmsmError) -> None:
        self._state.refused[stream] += samples
        self._state.refusal = str(err)
        self._warn(f"{stream} block refused: {err}")

    def _publish(self, points: SurfacePoints | None) -> None:
        if points is None:
            return
        cloud = message_mapping.cloud_message(
            self._messages, pack_points(points), points.stamp_ns, self._frame
        )
        self._points.publish(cloud)
        self._state.published += 1

    def _warn(self, text: str) -> None:
        self.get_logger().warning(text, throttle_duration_sec=_COMPLAINT_PERIOD_S)

    def report(self) -> StateReport:
        """Return the account, and the present faults; publish account and verdict."""
        if self._motion and self._corrector and not self._corrector.pairing.watch.same_stamps:
            self._motion.judge()
        now, cpu = time.monotonic(), time.process_time()
        now_ns = self.get_clock().now().nanoseconds
        report = self._state.report(self._corrector, now, cpu, self._motion)
        report.values["calibration"] = self._topic.id
        # Without a point there is nothing to assess.
        if self._state.published and self._corrector and self._topic.calibration is not None:
            used, accuracy = self._topic.calibration, accuracy_of(self.values)
            verdict = live_verdict(self._corrector, used, self._sources, accuracy)
            steps = next_steps(verdict)
            # They do not change the level of the node.
            report.values |= {
                "verdict": verdict["code"],
                "verdict_text": verdict["text"],
                "verdict_next": "; ".join(steps),
                "verdict_uncertainty_m": verdict["uncertainty"],
            }
            self._verdicts.publish(
                verdict_message(self._messages, verdict, steps, used.id, accuracy, now_ns)
            )
        self._publish_account()
        report.values["points_subscribers"] = self._points.get_subscription_count()
        report.values["requests_waiting"] = self._worker.waiting
        if self._frame != self.values["workpiece_frame"]:
            report.add(
                WARN, "correcting although the settings do not match the calibration (overridden)"
            )
        if self._foreign:
            report.add(ERROR, self._foreign)
        if self._topic.refused:
            report.add(WARN, f"a calibration was refused: {self._topic.refused}")
        return report


def _prediction(*motion: Any) -> Prediction:
    # Readers of bags take long to load, and most correctors do not need them.
    from omsm_ros.pipelines.verify_calibration import predict_from

    return predict_from(*motion)


main = partial(run, CorrectorNode)
