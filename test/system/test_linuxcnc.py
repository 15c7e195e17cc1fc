"""Real nodes behind the real LinuxCNC: its planner moves and the twin answers."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from omsm_ros.core.adjustment import ScanDesign
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.io.calibration_file import save_calibration
from omsm_ros.pipelines.plan_scans import scan_program
from omsm_ros.twin.scenario import Scenario

LINUXCNC = Path(__file__).parents[2] / "config" / "linuxcnc"
sys.path.insert(0, str(LINUXCNC))
import start  # noqa: E402

pytestmark = [pytest.mark.soak, pytest.mark.xdist_group("linuxcnc")]
FROM, TO = 7031, 7032
PROBE = {
    "device": "six_channel_text",
    "columns": "sequence device_time - - - - - status distance",
    "port": f"tcp://127.0.0.1:{TO}",
}


@pytest.mark.skipif(bool(start.missing()), reason=start.missing())
def test_axes_from_linuxcnc_and_a_second_driver_make_true_points(cell, true_calibration):
    save_calibration(cell.folder / "cal.json", true_calibration)
    _, program = scan_program(ScanDesign(rpm=60.0, start=2e-3, end=1e-3, pitch=2e-4), PAPER_MIRROR)
    clouds = cell.clouds()
    cell.processes.start("corrector", calibration=str(cell.folder / "cal.json"))
    cell.processes.start("axis_driver", device="linuxcnc", port=f"tcp://127.0.0.1:{TO}")
    cell.processes.start("confocal_driver", **PROBE)
    value = cell.operator.value
    cell.wait("a listener", lambda: value("axis_driver", "axes_subscribers") >= 1)
    twin = [sys.executable, LINUXCNC / "live.py", str(FROM), str(TO), "mirror", "2"]
    with start.running(program, FROM), subprocess.Popen(twin) as live:
        cell.wait("the end of the scan", lambda: live.poll() is not None)
        cell.settle("corrector", "axes_corrected")
    axes, distance = cell.closed_account("axes"), cell.closed_account("distance")
    assert axes == distance > 5000
    assert value("axis_driver", "lost") == value("confocal_driver", "lost") == 0
    points = np.concatenate([np.frombuffer(c.data, fields_of(c)) for c in clouds])
    assert len(points) > 4000
    part = Scenario().part
    off = points["height"] - part.height(points["x"].astype(float), points["y"].astype(float))
    # Noise of the probe and its resolution, and what a bias of the static gain makes of the height.
    assert np.std(off) < 15e-9


def fields_of(cloud):
    kinds = {7: "<f4", 8: "<f8", 6: "<u4", 2: "u1", 4: "<u2"}
    return np.dtype(
        {
            "names": [f.name for f in cloud.fields],
            "formats": [kinds[f.datatype] for f in cloud.fields],
            "offsets": [f.offset for f in cloud.fields],
            "itemsize": cloud.point_step,
        }
    )
