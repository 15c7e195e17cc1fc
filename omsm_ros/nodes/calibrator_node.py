"""``calibrator``: keeps the last motion and identifies the loop's dynamics on request."""

from __future__ import annotations

from pathlib import Path

from omsm_msgs.msg import AxisBlock, DistanceBlock
from omsm_msgs.msg import Calibration as CalibrationMessage
from omsm_msgs.srv import Identify
from rclpy.node import Node

from omsm_ros.core.dynamics.calibration import REJECTED, Calibration, verdict_of
from omsm_ros.core.identification.identify import Identification, identify
from omsm_ros.core.samples.motion_buffer import BlockBuffer
from omsm_ros.core.samples.motion_record import MotionRecord, assemble
from omsm_ros.errors import OmsmError
from omsm_ros.jobs.identify_bag import motion_of_bag
from omsm_ros.nodes.running import (
    LATCHED_QOS,
    NAMESPACE,
    OK,
    SAMPLES_QOS,
    Diagnostics,
    parameter,
    run,
    serve,
    settings_of,
)
from omsm_ros.quantities import BUFFER_SAMPLES, DURATION, ORDER
from omsm_ros.storage import conversions
from omsm_ros.storage.calibration_file import save_calibration


class CalibratorNode(Node):
    """Serves ``~/identify``; writes the calibration to a file and publishes it latched."""

    def __init__(self) -> None:
        super().__init__("calibrator", namespace=NAMESPACE)
        capacity = parameter(
            self, "buffer_samples", 3_600_000, "samples kept per topic", BUFFER_SAMPLES
        )
        self._output = parameter(
            self, "output", "calibration.json", "where to write the calibration"
        )
        self._report_folder = parameter(
            self, "report", "", "folder for the certificate of each identification; empty = none"
        )
        self._settings = settings_of(
            parameter(self, "settings", "{}", "JSON object of what the calibration belongs to")
        )
        self._axes: BlockBuffer = BlockBuffer(capacity)
        self._distance: BlockBuffer = BlockBuffer(capacity)
        self._reference: BlockBuffer = BlockBuffer(capacity)
        self._refused = 0
        self._last = "nothing identified yet"
        self._messages = conversions.ros_messages()
        self._publisher = self.create_publisher(CalibrationMessage, "calibration", LATCHED_QOS)
        self.create_subscription(AxisBlock, "axes", self._on_axes, SAMPLES_QOS)
        for topic, buffer in (("confocal", self._distance), ("reference", self._reference)):
            self.create_subscription(
                DistanceBlock,
                topic,
                lambda message, into=buffer: self._on_distance(message, into),
                SAMPLES_QOS,
            )
        serve(self, Identify, "~/identify", self._on_identify)
        self._diagnostics = Diagnostics(self, self._report)

    def _on_axes(self, message: AxisBlock) -> None:
        self._keep(conversions.axis_block, message, self._axes)

    def _on_distance(self, message: DistanceBlock, buffer: BlockBuffer) -> None:
        self._keep(conversions.distance_block, message, buffer)

    def _keep(self, convert, message, buffer: BlockBuffer) -> None:  # type: ignore[no-untyped-def]
        try:
            buffer.add(convert(message))
        except OmsmError as err:
            self._refused += 1
            self.get_logger().warning(f"block refused: {err}", throttle_duration_sec=5.0)

    def _on_identify(self, request: Identify.Request, response: Identify.Response) -> None:
        self._last = "identification failed, see the log"
        try:
            identified = self._identify(request)
            calibration = identified.calibration
            response.calibration = conversions.calibration_message(
                self._messages, calibration, self.get_clock().now().nanoseconds
            )
            response.success, self._last = self._judge(calibration)
            self._last += self._certified(request, identified)
        except OmsmError as err:
            response.success, self._last = False, f"identification failed: {err}"
        if response.success:
            self._publisher.publish(response.calibration)
            self.get_logger().info(self._last)
        else:
            self.get_logger().error(self._last)
        response.message = self._last

    def _judge(self, calibration: Calibration) -> tuple[bool, str]:
        verdict, reasons = verdict_of(calibration)
        if verdict == REJECTED:
            # An earlier, good calibration stays in its file and in use.
            return False, f"rejected: {'; '.join(reasons)}"
        save_calibration(self._output, calibration)
        return True, f"{verdict}; {calibration.id[:12]} written to {self._output}"

    def _certified(self, request: Identify.Request, identified: Identification) -> str:
        """Write the certificate, if wanted, and say so; a full disk does not undo a calibration."""
        if not self._report_folder:
            return ""
        # Drawing takes a second to import; most calibrators do without.
        from omsm_ros.jobs.certify import write_certificate

        try:
            page = write_certificate(
                Path(self._report_folder),
                identified,
                source=Path(request.bag).name or "live recording",
            )
        except OmsmError as err:
            return f"; no certificate: {err}"
        return f"; certificate in {page}"

    def _identify(self, request: Identify.Request) -> Identification:
        return identify(
            self._motion(request),
            order=ORDER.checked(request.order),
            input=request.input or "encoder",
            settings=self._settings,
        )

    def _motion(self, request: Identify.Request) -> MotionRecord:
        duration = DURATION.checked(request.duration)
        if request.bag:
            return motion_of_bag(Path(request.bag), duration=duration)
        return assemble(
            self._axes.recent(duration),
            self._distance.recent(duration),
            self._reference.recent(duration),
        )

    def _report(self) -> tuple[bytes, str, dict[str, object]]:
        values = {
            "axes_held": len(self._axes),
            "distance_held": len(self._distance),
            "reference_held": len(self._reference),
            "axes_forgotten": self._axes.forgotten,
            "distance_forgotten": self._distance.forgotten,
            "blocks_refused": self._refused,
        }
        return OK, self._last, values


def main() -> None:
    """Entry point of ``ros2 run omsm_ros calibrator``."""
    run(CalibratorNode)


if __name__ == "__main__":
    main()
