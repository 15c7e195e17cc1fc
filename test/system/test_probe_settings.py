"""A calibration belongs to the probe as it was set, which the driver tells by itself."""

from __future__ import annotations

import json

import pytest
from omsm_msgs.srv import Identify
from std_srvs.srv import Trigger

from omsm_ros.core.correction.correct import CorrectionOptions
from omsm_ros.errors import CalibrationError
from omsm_ros.jobs import demonstrate as demonstration
from omsm_ros.jobs.corrected_scan import CorrectedScan
from omsm_ros.jobs.identify_bag import settings_of_bag
from omsm_ros.nodes.cell_demo_node import _follow, _scan
from omsm_ros.storage.calibration_file import load_calibration

pytestmark = [pytest.mark.timeout(180), pytest.mark.soak]


def test_a_scan_with_another_averaging_is_refused_live_and_offline(cell):
    plan = demonstration.Demonstration(
        cell.folder / "demo", seed=2, time_lapse=20.0, start_radius=0.5e-3, device="chrocodile"
    )
    plan.prepare()
    node, processes = cell.operator, cell.processes

    def driver(averaging):
        processes.start("confocal_driver", **plan.driver_parameters(), averaging=averaging)
        listeners = 2 + ("recorder" in processes._running)
        cell.wait("it", lambda: node.value("confocal_driver", "axes_subscribers") >= listeners)
        cell.wait("the device", lambda: node.value("confocal_driver", "connections") >= 1)

    def scanned(name, averaging):
        """A bag of a scan with ``averaging``, and what the corrector says of it at the end."""
        path = cell.folder / name
        processes.end("confocal_driver")
        processes.start("recorder", path=str(path))
        driver(averaging)
        cell.wait("the recorder", lambda: node.value("corrector", "points_subscribers") >= 1)
        return path

    processes.start("cell_emulator", link=plan.link, **plan.emulator_parameters())
    stated = json.dumps(plan.settings())
    processes.start("calibrator", output=str(plan.calibration_file), settings=stated)
    processes.start("corrector")
    driver(4)
    node.call(Trigger, "/omsm/cell_emulator/step_test", Trigger.Request())
    _follow(node, "calibrator", ("axes_held", "distance_held"), plan.step_test_samples, int)
    answer = node.call(Identify, "/omsm/calibrator/identify", Identify.Request())
    settings = json.loads(answer.calibration.settings)
    assert settings["probe.device"] == "chrocodile"
    assert settings["probe.averaging"] == 4
    # Exposures just above four times the trigger, as four are averaged for each.
    assert settings["probe.rate"] == pytest.approx(4 * 1050, rel=1e-3)
    cell.wait("it", lambda: node.text("corrector", "calibration") == answer.calibration.id)

    foreign = scanned("foreign.mcap", 8)
    said = "probe.averaging is 8.0, calibrated with 4.0"
    cell.wait("the refusal", lambda: said in node.text("corrector", "message"))
    node.call(Trigger, "/omsm/cell_emulator/scan", Trigger.Request())
    cell.wait("samples", lambda: node.value("corrector", "distance_uncalibrated") > 1000)
    assert node.value("corrector", "clouds_published") == 0
    node.call(Trigger, "/omsm/cell_emulator/stop", Trigger.Request())
    processes.end("recorder")
    calibration = load_calibration(plan.calibration_file)
    with pytest.raises(CalibrationError, match=said):
        CorrectedScan(foreign, calibration, CorrectionOptions()).__enter__()
    assert settings_of_bag(foreign, {})["probe.averaging"] == 8

    belonging = scanned("belonging.mcap", 4)
    cell.wait("its return", lambda: said not in node.text("corrector", "message"))
    _scan(node, plan, int)
    assert node.value("corrector", "clouds_published") > 0
    processes.end("recorder")
    with CorrectedScan(belonging, calibration, CorrectionOptions()) as scan:
        assert scan.reasons == ()
