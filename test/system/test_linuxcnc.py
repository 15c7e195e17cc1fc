"""Real nodes behind the real LinuxCNC: its planner moves and the twin answers."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from omsm_ros.core.adjustment import ScanDesign
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.io.calibration_file import save_calibration
from omsm_ros.pipelines.plan_scans import scan_program, write_scans
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


REAL = pytest.mark.skipif(bool(start.missing()), reason=start.missing())


@REAL
@pytest.mark.parametrize("killed", [None, "axis_driver", "confocal_driver"])
def test_axes_from_linuxcnc_and_a_second_driver_make_true_points(cell, true_calibration, killed):
    save_calibration(cell.folder / "cal.json", true_calibration)
    _, program = scan_program(ScanDesign(rpm=60.0, start=2e-3, end=1e-3, pitch=2e-4), PAPER_MIRROR)
    clouds = cell.clouds()
    cell.processes.start("corrector", calibration=str(cell.folder / "cal.json"))
    given = {"axis_driver": {"device": "linuxcnc", "port": PROBE["port"]}, "confocal_driver": PROBE}
    for name in given:
        cell.processes.start(name, **given[name])
    value = cell.operator.value
    cell.wait("a listener", lambda: value("axis_driver", "axes_subscribers") >= 1)
    twin = [sys.executable, LINUXCNC / "live.py", str(FROM), str(TO), "mirror", "2"]
    with start.running(program, FROM), subprocess.Popen(twin) as live:
        if killed:
            cell.wait("points", lambda: sum(cloud.width for cloud in clouds) > 1000)
            cell.processes.end(killed, how=signal.SIGKILL)
            cell.processes.start(killed, **given[killed])
        cell.wait("the end of the scan", lambda: live.poll() is not None)
        cell.settle("corrector", "axes_corrected")
    axes, distance = cell.closed_account("axes"), cell.closed_account("distance")
    lost = {"axis_driver": axes, "confocal_driver": distance}
    assert value("axis_driver", "lost") == value("confocal_driver", "lost") == 0
    if killed:
        # Only the samples that the dead driver had taken are missing; points between are left out.
        missing = value("corrector", "missing_axes" if "axis" in killed else "missing_distance")
        assert 0 < missing < 4000
        assert lost[killed] + missing == max(axes, distance) > 5000
    else:
        assert axes == distance > 5000
    assert true_points(clouds) > (1500 if killed else 4000)


def true_points(clouds):
    """The number of the points, which are on the mirror."""
    points = np.concatenate([np.frombuffer(c.data, fields_of(c)) for c in clouds])
    part = Scenario().part
    off = points["height"] - part.height(points["x"].astype(float), points["y"].astype(float))
    # Noise of the probe and its resolution, and what a bias of the static gain makes of the height.
    assert np.std(off) < 15e-9
    assert np.max(np.abs(off - np.mean(off))) < 75e-9
    return len(points)


@REAL
def test_the_commands_of_the_page_make_true_points(cell, true_calibration):
    page = (LINUXCNC.parents[1] / "docs/howto/linuxcnc.md").read_text()
    (commands,) = (b for b in re.findall(r"```\n(.*?)```", page, re.DOTALL) if "live.py" in b)
    (cell.folder / "config").symlink_to(LINUXCNC.parent)
    save_calibration(cell.folder / "cal.json", true_calibration)
    design = ScanDesign(rpm=60.0, start=2e-3, end=1e-3, pitch=2e-4)
    write_scans([design], PAPER_MIRROR, cell.folder / "plan", 1e-7, 1e-3)
    clouds = cell.clouds()
    # The nodes of a workspace of wheels are found by name. On a busy computer they start slowly, so
    # the machine waits for them, as its operator does.
    nodes, moves = commands.split("python", 1)
    shell = ["bash", "-c", f'ros2() {{ shift 2; "$@"; }}\n{nodes}read\npython{moves}']
    value, given = cell.operator.value, {"cwd": cell.folder, "stdin": subprocess.PIPE}
    with subprocess.Popen(shell, start_new_session=True, **given) as page:
        try:
            cell.wait("a listener", lambda: value("confocal_driver", "axes_subscribers") >= 1)
            page.stdin.write(b"\n")
            page.stdin.flush()
            cell.wait("the end of the scan", lambda: page.poll() is not None)
            cell.settle("corrector", "axes_corrected")
        finally:
            os.killpg(page.pid, signal.SIGTERM)
    assert page.returncode == 0
    assert true_points(clouds) > 2500  # from where the nodes have found each other


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
