"""``corrector``: turns axes and distance into corrected surface points, as they come."""

from __future__ import annotations

import time
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

from omsm_msgs.msg import AxisBlock, DistanceBlock
from omsm_msgs.srv import LoadCalibration, PredictError
from rclpy.clock import Clock, ClockType
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String

from omsm_ros.core.correction.applicability import admit, objections
from omsm_ros.core.correction.correct import Corrector
from omsm_ros.core.correction.predict import Prediction
from omsm_ros.core.correction.surface_points import SurfacePoints, pack_points
from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.samples.merging import consecutive
from omsm_ros.core.verification.live_offset import LiveOffset
from omsm_ros.errors import OmsmError
from omsm_ros.jobs.judge_scan import live_light, with_sources
from omsm_ros.nodes.aside import Aside
from omsm_ros.nodes.calibration_topic import CalibrationTopic
from omsm_ros.nodes.correction_parameters import PARAMETERS, accuracy_of, options_of, sources_of
from omsm_ros.nodes.correction_state import PAUSE_S, CorrectionState, light_values
from omsm_ros.nodes.diagnostics import ERROR, WARN, Report
from omsm_ros.nodes.frames import tell_frames
from omsm_ros.nodes.managed import ManagedNode
from omsm_ros.nodes.running import run, settings_of
from omsm_ros.nodes.topics import LATCHED_BY_MANY_QOS, MessageInfo, listen
from omsm_ros.storage import conversions
from omsm_ros.storage.calibration_file import load_calibration, load_for_others
from omsm_ros.storage.calibration_folder import confined, since
from omsm_ros.storage.surface_file import load_surface

_STREAMS = {"axes": ("axes", AxisBlock), "distance": ("confocal", DistanceBlock)}
_COMPLAINT_PERIOD_S = 5.0
_OVERRIDDEN = "_overridden"


class CorrectorNode(ManagedNode):
    """Publishes nothing until it has a calibration; a new one begins a new correction."""

    def __init__(self) -> None:
        super().__init__("corrector", PARAMETERS)
        self._messages = conversions.ros_messages()

    def configure(self, undo: ExitStack) -> None:
        """Take up the calibration to start with, and answer requests."""
        self._settings = settings_of(self.values["settings"])
        self._options, self._sources = options_of(self.values), sources_of(self.values)
        nominal = self.values["nominal"]
        self._nominal = load_surface(nominal) if nominal else None
        self._frame = self.values["workpiece_frame"]
        self._corrector: Corrector | None = None
        self._motion: LiveOffset | None = None
        self._probe: dict[str, object] = {}
        self._foreign = ""
        self._overridden: tuple[str, ...] = ()
        self._state = CorrectionState()
        self._waiting: dict[str, list[Any]] = {}
        self._points = self.publish_on(undo, PointCloud2, "points")
        self._topic = CalibrationTopic(
            self, undo, lambda heard, _: self._use(heard), self.values["follow_calibrator"]
        )
        listen(self, undo, String, "probe_settings", self._on_probe, LATCHED_BY_MANY_QOS)
        tell_frames(self, undo, self._options.geometry, self.values)
        self._aside = Aside(self, undo)
        self._aside.serve(undo, LoadCalibration, "~/load_calibration", self._on_load)
        self._aside.serve(undo, PredictError, "~/predict_error", self._on_predict)
        if path := self.values["calibration"]:
            self._put_in_force(load_calibration(path), since(Path(path)))
        else:
            self.get_logger().info("no calibration yet: nothing will be published")

    def activate(self, undo: ExitStack) -> None:
        """Begin to correct."""
        undo.callback(self._publish_rest)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        timer = self.create_timer(PAUSE_S / 2, self._settle, clock=steady)
        undo.callback(self.destroy_timer, timer)
        for stream, (topic, kind) in _STREAMS.items():
            self._waiting[stream] = []
            take, push = partial(self._take, stream), partial(self._push, stream)
            listen(self, undo, kind, topic, take, after=push)

    def _put_in_force(self, calibration: Calibration, since_ns: int) -> None:
        self._use(calibration)
        self._topic.announce(calibration, since_ns)

    def _objections(self, calibration: Calibration) -> tuple[str, ...]:
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
        # Nothing is refused from here on: the calibration in force is one, wholly.
        self._publish_rest()
        # A viewer that waits for the usual frame shows nothing until somebody has seen why.
        self._frame = self.values["workpiece_frame"] + (_OVERRIDDEN if reasons else "")
        for reason in reasons:
            self.get_logger().warning(f"overridden: {reason}")
        self._corrector, self._foreign, self._overridden = corrector, "", reasons
        self._motion = LiveOffset(calibration, self._options.trigger.counter_offset)
        self.get_logger().info(f"calibration {calibration.id[:12]} in use")

    def _on_probe(self, message: String, _: MessageInfo) -> None:
        """Stop correcting where the calibration belongs to a probe set otherwise; else begin."""
        try:
            reported = conversions.probe_settings(message)
        except OmsmError as err:
            self._complain(f"probe settings refused: {err}")
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
            self._publish_rest()
            self._corrector, self._foreign = None, str(err)
            self.get_logger().error(self._foreign)

    def _publish_rest(self) -> None:
        if self._corrector is not None:
            self._publish(self._corrector.finish())
            self.get_logger().info(f"samples so far: {self._corrector.account.as_dict()}")

    async def _on_load(
        self, request: LoadCalibration.Request, response: LoadCalibration.Response
    ) -> None:
        response.id = self._in_force_id()
        path = confined(Path(request.path), self.values["calibration_folders"])
        calibration = await self._aside.do(partial(load_for_others, path))
        self._put_in_force(calibration, self._topic.decided())
        response.success, response.message = True, "in use"
        response.id = self._in_force_id()

    def _in_force_id(self) -> str:
        calibration = self._topic.calibration
        return calibration.id if calibration else ""

    async def _on_predict(
        self, request: PredictError.Request, response: PredictError.Response
    ) -> None:
        # What cannot be predicted is no error of zero.
        response.peak_to_valley = response.rms = response.outside_band_fraction = float("nan")
        prediction = await self._aside.do(
            partial(
                _prediction,
                self._topic.calibration,
                request.bag,
                request.z,
                request.sample_period,
            )
        )
        response.peak_to_valley = prediction.peak_to_valley
        response.rms = prediction.rms
        response.outside_band_fraction = prediction.outside_band_fraction
        response.safe = prediction.safe
        response.message = prediction.message

    def _take(self, stream: str, message: Any, info: MessageInfo) -> None:
        samples = len(message.z if stream == "axes" else message.distance)
        if stream not in self._state.begins_at:
            self.get_logger().info(f"{stream}: begins at trigger {message.first_sample}")
        period = message.sample_period
        self._state.heard(stream, message.first_sample, samples, period, time.monotonic())
        self._state.arrived(info["received_timestamp"])
        if self._corrector is None:
            self._state.uncalibrated[stream] += samples
            self._complain(
                self._foreign
                or "samples come, but there is no calibration: call identify or load one"
            )
            return
        convert = conversions.axis_block if stream == "axes" else conversions.distance_block
        try:
            block = convert(message)
            self._waiting[stream].append(block)
            if self._motion:
                self._motion.add(block)
        except OmsmError as err:
            self._refuse(stream, samples, err)

    def _push(self, stream: str) -> None:
        """Correct what was taken; the more waited, the less a sample costs."""
        blocks, self._waiting[stream] = self._waiting[stream], []
        if self._corrector is None:
            return
        push: Any = self._corrector.push_axes if stream == "axes" else self._corrector.push_distance
        for together in consecutive(blocks):
            try:
                push(*together)
            except OmsmError as err:
                self._refuse(stream, sum(map(len, together)), err)
            # One after the other: the middleware keeps room for its longest message many times.
            self._publish(self._corrector.take())
        self._state.done(time.time_ns())

    def _settle(self) -> None:
        """Publish what waits for stamps, where none come: the motion has ended."""
        if self._corrector and self._corrector.held and self._state.pauses(time.monotonic()):
            self._corrector.settle()
            self._publish(self._corrector.take())

    def _refuse(self, stream: str, samples: int, err: OmsmError) -> None:
        self._state.refused[stream] += samples
        self._state.refusal = str(err)
        self._complain(f"{stream} block refused: {err}")

    def _publish(self, points: SurfacePoints | None) -> None:
        if points is None:
            return
        cloud = conversions.cloud_message(
            self._messages, pack_points(points), points.stamp_ns, self._frame
        )
        self._points.publish(cloud)
        self._state.published += 1

    def _complain(self, text: str) -> None:
        self.get_logger().warning(text, throttle_duration_sec=_COMPLAINT_PERIOD_S)

    def report(self) -> Report:
        """Return the account, and what is wrong with it now."""
        if self._motion and self._corrector and not self._corrector.slips.one_driver:
            self._motion.judge()
        now, cpu = time.monotonic(), time.process_time()
        report = self._state.report(self._corrector, now, cpu, self._motion)
        report.values["calibration"] = self._in_force_id()
        # Before there is a point, all that is uncertain would make nothing.
        if self._state.published and self._corrector and self._topic.calibration is not None:
            light = live_light(
                self._corrector, self._topic.calibration, self._sources, accuracy_of(self.values)
            )
            report.values |= light_values(light)
        report.values["points_subscribers"] = self._points.get_subscription_count()
        report.values["requests_waiting"] = self._aside.waiting
        if self._frame != self.values["workpiece_frame"]:
            report.add(WARN, "correcting with a calibration that does not belong (overridden)")
        if self._foreign:
            report.add(ERROR, self._foreign)
        if self._topic.refused:
            report.add(WARN, f"a calibration was refused: {self._topic.refused}")
        return report


def _prediction(*motion: Any) -> Prediction:
    # What reads bags takes as long to load as all else; most correctors are never asked.
    from omsm_ros.jobs.predict_motion import predict_from

    return predict_from(*motion)


def main() -> None:
    """Run ``ros2 run omsm_ros corrector``."""
    run(CorrectorNode)


if __name__ == "__main__":
    main()
