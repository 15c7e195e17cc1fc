"""A calibration belongs to the probe as it was set, which the driver tells by itself."""

from __future__ import annotations

import json

import pytest
from omsm_msgs.srv import Identify
from std_srvs.srv import Trigger

from omsm_ros.core.correction.correct import CorrectionOptions
from omsm_ros.errors import CalibrationError
from omsm_ros.io.calibration_file import load_calibration
from omsm_ros.nodes.cell_demo_node import _follow, _scan
from omsm_ros.pipelines import demonstrate as demonstration
from omsm_ros.pipelines.correct import CorrectedScan
from omsm_ros.pipelines.recording import Recording

pytestmark = pytest.mark.soak


class Bench:
    """A cell with a CHRocodile, whose driver begins anew with another averaging."""

    def __init__(self, cell):
        self.cell, self.node, self.processes = cell, cell.operator, cell.processes
        self.plan = demonstration.Demonstration(
            cell.folder / "demo", seed=2, time_lapse=20.0, start_radius=0.5e-3, device="chrocodile"
        )
        self.plan.prepare()
        link, parameters = self.plan.link, self.plan.emulator_parameters()
        self.processes.start("cell_emulator", link=link, **parameters)
        output, stated = str(self.plan.calibration_file), json.dumps(self.plan.settings())
        self.processes.start("calibrator", output=output, settings=stated)
        self.processes.start("corrector")

    def driver(self, averaging):
        parameters = self.plan.driver_parameters()
        self.processes.start("confocal_driver", **parameters, averaging=averaging)
        listeners = 2 + ("recorder" in self.processes._running)
        # Its diagnostics are those of the earlier one until it reports 0 blocks.
        self.cell.wait("a new one", lambda: self.node.value("confocal_driver", "blocks") == 0)
        self._until("it", "confocal_driver", "axes_subscribers", listeners)
        self._until("the device", "confocal_driver", "connections", 1)

    def _until(self, what, of, counted, count):
        self.cell.wait(what, lambda: self.node.value(of, counted) >= count)

    def recorded(self, name, averaging):
        """The bag that is being written, of samples with ``averaging``."""
        path = self.cell.folder / name
        self.processes.end("confocal_driver")
        self.processes.start("recorder", path=str(path))
        self.driver(averaging)
        self._until("the recorder", "corrector", "points_subscribers", 1)
        return path

    def move(self, motion):
        self.node.call(Trigger, f"/omsm/cell_emulator/{motion}", Trigger.Request())

    def identified(self):
        """Return the calibrator's answer after a step test."""
        self.move("step_test")
        held = {"axes_held": 0, "distance_held": 0}
        _follow(self.node, "calibrator", held, self.plan.samples()[0], int)
        return self.node.call(Identify, "/omsm/calibrator/identify", Identify.Request()).calibration


def test_a_scan_with_another_averaging_is_refused_live_and_offline(cell):
    bench, node = Bench(cell), cell.operator
    bench.driver(4)
    identified = bench.identified()
    settings = json.loads(identified.settings)
    assert settings["probe.device"] == "chrocodile"
    assert settings["probe.averaging"] == 4
    # Exposures just above four times the trigger, as four are averaged for each.
    assert settings["probe.rate"] == pytest.approx(4 * 1050, rel=1e-3)
    cell.wait("it", lambda: node.text("corrector", "calibration") == identified.id)

    foreign = bench.recorded("foreign.mcap", 8)
    said = "probe.averaging is 8.0, calibrated with 4.0"
    cell.wait("the refusal", lambda: said in node.text("corrector", "message"))
    bench.move("scan")
    cell.wait("samples", lambda: node.value("corrector", "distance_uncalibrated") > 1000)
    assert node.value("corrector", "clouds_published") == 0
    bench.move("stop")
    cell.processes.end("recorder")
    calibration = load_calibration(bench.plan.calibration_file)
    with Recording(foreign) as recording:
        with pytest.raises(CalibrationError, match=said):
            CorrectedScan(recording, calibration, CorrectionOptions())
        assert recording.settings({})["probe.averaging"] == 8

    belonging = bench.recorded("belonging.mcap", 4)
    cell.wait("its return", lambda: said not in node.text("corrector", "message"))
    _scan(node, bench.plan, "scan", bench.plan.samples()[1], int)
    assert node.value("corrector", "clouds_published") > 0
    cell.processes.end("recorder")
    with Recording(belonging) as recording:
        scan = CorrectedScan(recording, calibration, CorrectionOptions())
        assert scan.reasons == ()
