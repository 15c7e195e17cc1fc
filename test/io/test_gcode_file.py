"""G-code of each dialect, run through by a reader that knows that dialect only."""

import re
from functools import partial

import numpy as np
import pytest

from omsm_ros import cli
from omsm_ros.core.adjustment import ScanDesign
from omsm_ros.core.kinematics.planner import plan_path
from omsm_ros.core.kinematics.trajectories import plan_steps
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.io.gcode_file import DIALECTS, path_gcode, steps_gcode
from omsm_ros.pipelines.plan_scans import scan_path

# How a block waits, in seconds. FANUC counts P in steps of the increment system, and takes a
# decimal point with X alone, where the thousandth is the finest that every such system has.
DWELL = {
    "linuxcnc": r"G4 P(\d+\.\d+)$",
    "fanuc": r"G04 X(\d+\.\d{3})$",
    "siemens": r"G4 F(\d+\.\d+)$",
    "nanotech": r"G04 P(\d+\.\d+)$",
}
COMMENT = {
    "linuxcnc": r";[^\n]*",
    "siemens": r";[^\n]*",
    "fanuc": r"\([A-Z0-9 .,/=_-]*\)",
    "nanotech": r"\([A-Z0-9 .,/=_-]*\)",
}
LAST = {"linuxcnc": "M2", "fanuc": "%", "siemens": "M30", "nanotech": "M30"}


def blocks(text, dialect):
    """Return the blocks without their comments."""
    assert text.isascii()
    bare = re.sub(COMMENT[dialect], "", text)
    return [line.strip() for line in bare.splitlines() if line.strip()]


def edges(text, dialect):
    """Yield start [s] and height [m] of each move, and the end of the program last."""
    now = 0.0
    for block in blocks(text, dialect):
        if waited := re.fullmatch(DWELL[dialect], block):
            now += float(waited[1])
        elif moved := re.fullmatch(r"G1 Z(\S+) F(\S+)", block):
            height, feed = (float(part) * 1e-3 for part in moved.groups())
            yield now, height
            now += abs(height) / feed * 60
        else:
            assert block in (
                "G21", "G710", "G71", "G91", "G94", "G90", "%", "O0001", "M2", "M30",
                "M64 P0", "M65 P0",
            )  # fmt: skip
    yield now, 0.0


@pytest.mark.parametrize("dialect", DIALECTS)
def test_edges_are_where_the_plan_has_them(dialect):
    """To a microsecond, so that the dither within the sample period is there in milliseconds."""
    plan = plan_steps(sample_period=1e-3, second_step=3e-6, count=6)
    found = list(edges(steps_gcode(plan, dialect), dialect))
    starts, heights = zip(*found[:-1], strict=True)
    # Where the first edge is does not matter, to a millisecond.
    assert starts[0] == pytest.approx(plan.starts[0], abs=1e-3)
    np.testing.assert_allclose(np.diff(starts), np.diff(plan.starts), atol=1e-6)
    np.testing.assert_allclose(heights, plan.heights, atol=1e-12)
    assert found[-1][0] == pytest.approx(plan.duration, abs=1e-3)
    assert blocks(steps_gcode(plan, dialect), dialect)[-1] == LAST[dialect]


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_scan_turns_steadily_to_its_end(dialect):
    design = ScanDesign(rpm=30.0, start=1e-3, end=0.0, pitch=5e-4)
    path = plan_path(partial(scan_path, design, PAPER_MIRROR), design.duration, 1e-3, 1e-7)
    text = blocks(path_gcode(path, ["a scan"], dialect), dialect)
    word = r"C=IC\((\S+)\)" if dialect == "siemens" else r"C(\S+)"
    moves = [re.fullmatch(rf"G1 X(\S+) Z(\S+) {word} F(\S+)", b) for b in text if b[:3] == "G1 "]
    read = np.array([[float(v) for v in move.groups()] for move in moves])
    at = np.cumsum(read[:, 2]) if dialect in ("fanuc", "siemens") else read[:, 2]
    first = text.index("G93")
    if text[first + 1] == "G91":
        start = re.search(r"G0 X(\S+)\nG0 Z(\S+)", "\n".join(text[:first])).groups()
        read[:, :2] = np.cumsum(read[:, :2], axis=0) + np.array(start, float)
    np.testing.assert_allclose(read[:, 0], path.x[1:] * 1e3, atol=6e-7)
    np.testing.assert_allclose(read[:, 1], path.z[1:] * 1e3, atol=6e-7)
    np.testing.assert_allclose(at, np.degrees(path.c[1:]), atol=2e-6)
    # Inverse time: a segment takes 1/F minutes; the spindle turns at its speed.
    assert 60 / read[0, 3] * len(read) == pytest.approx(design.duration, rel=1e-6)
    assert any(block.startswith("G0 X") for block in text[:first])
    assert "G94" in text[first:]


def test_the_command_writes_the_dialect(tmp_path):
    assert cli.main(["plan", "steps", "--dialect", "fanuc", "--out", str(tmp_path)]) == 0
    assert (tmp_path / "steps.nc").read_text().startswith("%\nO0001\n(STEP TEST")
