"""``corrector``: turns axes and distance into corrected surface points, as they come."""

from __future__ import annotations

import time
from dataclasses import fields, replace
from pathlib import Path
from typing import TypeAlias

from omsm_msgs.msg import AxisBlock, DistanceBlock
from omsm_msgs.msg import Calibration as CalibrationMessage
from omsm_msgs.srv import LoadCalibration, PredictError
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from omsm_ros.core.correction.applicability import admit, objections
from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
from omsm_ros.core.correction.surface_points import SurfacePoints, pack_points
from omsm_ros.core.correction.uncertainty import ErrorSources, sources_with
from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.machine.kinematics import Geometry
from omsm_ros.core.samples.throughput import LoadMeter
from omsm_ros.errors import OmsmError
from omsm_ros.jobs.predict_motion import predict_from
from omsm_ros.nodes.running import (
    LATCHED_QOS,
    NAMESPACE,
    OK,
    SAMPLES_QOS,
    WARN,
    Diagnostics,
    parameter,
    run,
    serve,
    settings_of,
)
from omsm_ros.storage import conversions
from omsm_ros.storage.calibration_file import load_calibration

MessageInfo: TypeAlias = "dict[str, int]"

FRAME, OVERRIDDEN_FRAME = "workpiece", "workpiece_overridden"
SOURCES = tuple(field.name for field in fields(ErrorSources))
GEOMETRY = tuple(field.name for field in fields(Geometry))

_COMPLAINT_PERIOD_S = 5.0


class CorrectorNode(Node):
    """Publishes nothing until it has a calibration; a new one begins a new correction."""

    def __init__(self) -> None:
        super().__init__("corrector", namespace=NAMESPACE)
        path = parameter(self, "calibration", "", "calibration file to start with; empty = wait")
        follow = parameter(
            self, "follow_calibrator", True, "take what appears on the calibration topic"
        )
        self._settings = settings_of(
            parameter(self, "settings", "{}", "JSON object of how the cell is set now")
        )
        self._override = parameter(
            self, "override", False, "use a calibration that does not belong; every cloud says so"
        )
        self._options = self._options_asked()
        self._sources = self._sources_stated()
        self._frame = FRAME
        self._messages = conversions.ros_messages()
        self._calibration: Calibration | None = None
        self._corrector: Corrector | None = None
        self._uncalibrated = {"axes": 0, "distance": 0}
        self._refused = {"axes": 0, "distance": 0}
        self._complaint = ""
        self._load = LoadMeter()
        self._published = 0
        self._points = self.create_publisher(PointCloud2, "points", SAMPLES_QOS)
        if path:
            self._use(load_calibration(path))
        if follow:
            self.create_subscription(
                CalibrationMessage, "calibration", self._on_calibration, LATCHED_QOS
            )
        self.create_subscription(AxisBlock, "axes", self._on_axes, SAMPLES_QOS)
        self.create_subscription(DistanceBlock, "confocal", self._on_distance, SAMPLES_QOS)
        serve(self, LoadCalibration, "~/load_calibration", self._on_load)
        serve(self, PredictError, "~/predict_error", self._on_predict)
        self._diagnostics = Diagnostics(self, self._report)
        if not path:
            self.get_logger().info("no calibration yet: nothing will be published")

    def _options_asked(self) -> CorrectionOptions:
        lag = parameter(self, "lateral_lag", -1.0, "of the probe [s]; negative = as calibrated")
        return CorrectionOptions(
            polarity=parameter(
                self, "polarity", 1, "+1: distance falls as z rises; -1: the other way"
            ),
            accept_other_rate=self._override,
            lateral_lag=None if lag < 0 else float(lag),
            geometry=Geometry(
                **{
                    name: parameter(self, f"geometry.{name}", 0.0, "of the probe [m] or slope")
                    for name in GEOMETRY
                }
            ),
        )

    def _sources_stated(self) -> dict[str, float]:
        """What the certificate tells is used unless something else is stated here."""
        stated = {
            name: parameter(self, f"sources.{name}", 0.0, "SI, k = 1; 0 = certificate")
            for name in SOURCES
        }
        ErrorSources(**stated)  # refuses what is no uncertainty
        return {name: value for name, value in stated.items() if value}

    # ------------------------------------------------------------------- calibration

    def _use(self, calibration: Calibration) -> None:
        reasons = objections(
            calibration, settings=self._settings or None, polarity=self._options.polarity
        )
        admit(calibration, reasons, self._override)
        sources = sources_with(calibration, self._sources)
        corrector = Corrector(calibration, replace(self._options, sources=sources))
        # Nothing is refused from here on: the calibration in force is one, wholly.
        self._publish_rest()
        # A viewer that waits for the usual frame shows nothing until somebody has seen why.
        self._frame = OVERRIDDEN_FRAME if reasons else FRAME
        for reason in reasons:
            self.get_logger().warning(f"overridden: {reason}")
        self._calibration, self._corrector = calibration, corrector
        self.get_logger().info(f"calibration {calibration.id[:12]} in use")

    def _publish_rest(self) -> None:
        if self._corrector is not None:
            self._publish(self._corrector.finish())
            self.get_logger().info(f"samples so far: {self._corrector.account.as_dict()}")

    def _on_calibration(self, message: CalibrationMessage) -> None:
        try:
            calibration = conversions.calibration(message)
            if self._calibration is None or calibration.id != self._calibration.id:
                self._use(calibration)
        except OmsmError as err:
            self.get_logger().error(f"calibration refused: {err}")

    def _on_load(
        self, request: LoadCalibration.Request, response: LoadCalibration.Response
    ) -> None:
        response.id = self._calibration.id if self._calibration else ""
        self._use(load_calibration(Path(request.path)))
        response.success, response.message = True, "in use"
        response.id = self._calibration.id if self._calibration else ""

    def _on_predict(self, request: PredictError.Request, response: PredictError.Response) -> None:
        prediction = predict_from(self._calibration, request.bag, request.z, request.sample_period)
        response.peak_to_valley = prediction.peak_to_valley
        response.rms = prediction.rms
        response.outside_band_fraction = prediction.outside_band_fraction
        response.safe = prediction.safe
        response.message = prediction.message

    # ----------------------------------------------------------------------- samples

    def _on_axes(self, message: AxisBlock, info: MessageInfo) -> None:
        self._take("axes", message, len(message.z), info)

    def _on_distance(self, message: DistanceBlock, info: MessageInfo) -> None:
        self._take("distance", message, len(message.distance), info)

    def _take(
        self, stream: str, message: AxisBlock | DistanceBlock, samples: int, info: MessageInfo
    ) -> None:
        if self._corrector is None:
            self._uncalibrated[stream] += samples
            self._complain("samples come, but there is no calibration: call identify or load one")
            return
        try:
            if stream == "axes":
                self._corrector.push_axes(conversions.axis_block(message))
            else:
                self._corrector.push_distance(conversions.distance_block(message))
        except OmsmError as err:
            self._refused[stream] += samples
            self._complain(f"{stream} block refused: {err}")
            return
        if (points := self._corrector.take()) is not None:
            self._publish(points)
            self._load.block(info["received_timestamp"], time.time_ns())

    def _publish(self, points: SurfacePoints | None) -> None:
        if points is None or not self.context.ok():
            return
        cloud = conversions.cloud_message(
            self._messages, pack_points(points), points.stamp_ns, self._frame
        )
        self._points.publish(cloud)
        self._published += 1

    def _complain(self, text: str) -> None:
        self._complaint = text
        self.get_logger().warning(text, throttle_duration_sec=_COMPLAINT_PERIOD_S)

    # -------------------------------------------------------------------- diagnostics

    def _report(self) -> tuple[bytes, str, dict[str, object]]:
        values: dict[str, object] = {
            f"{stream}_{reason}": count
            for reason, counts in (("uncalibrated", self._uncalibrated), ("refused", self._refused))
            for stream, count in counts.items()
        }
        values["clouds_published"] = self._published
        values["points_subscribers"] = self._points.get_subscription_count()
        if self._corrector is None or self._calibration is None:
            return WARN, "no calibration: nothing is published", values
        values["calibration"] = self._calibration.id
        values |= self._load.report(time.process_time(), time.monotonic())
        values["stamp_skew_s"] = self._corrector.stamp_skew
        values |= {f"rms_{name}_m": value for name, value in self._corrector.budget.items()}
        for stream, account in self._corrector.account.as_dict().items():
            counted = account.pop("counted")
            values |= {f"{stream}_{name}": value for name, value in account.items()}
            values |= {f"{stream}_{name}": value for name, value in counted.items()}
        if self._frame != FRAME:
            return WARN, "correcting with a calibration that does not belong (overridden)", values
        return OK, "correcting", values


def main() -> None:
    """Entry point of ``ros2 run omsm_ros corrector``."""
    run(CorrectorNode)


if __name__ == "__main__":
    main()
