"""Programs on the real LinuxCNC of this machine, where it is installed."""

import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from omsm_ros.core.adjustment import ScanDesign
from omsm_ros.core.kinematics.trajectories import (
    PLANNED_COUNT,
    PLANNED_STEP_M,
    SECOND_SHARE,
    AxisPositions,
    plan_steps,
)
from omsm_ros.core.streams.blocks import AxisBlock
from omsm_ros.core.surface.nominal import PAPER_MIRROR, Flat
from omsm_ros.errors import DataError, DeviceError
from omsm_ros.io.bag_writer import AXES_TOPIC
from omsm_ros.io.bags import BagReader
from omsm_ros.io.gcode_file import steps_gcode
from omsm_ros.pipelines.plan_scans import scan_path, scan_program, write_scans
from omsm_ros.pipelines.record_bags import record_device, write_nominal, write_recording
from omsm_ros.twin.cell import Cell, record
from omsm_ros.twin.disturbances import Disturbances

sys.path.insert(0, str(Path(__file__).parents[2] / "config" / "linuxcnc"))
import behind
import demo
import precompensate
import start

REAL = pytest.mark.skipif(bool(start.missing()), reason=start.missing())
pytestmark = [pytest.mark.xdist_group("linuxcnc")]


def counters(bag):
    with BagReader(bag) as reader:
        blocks = [block for _, block in reader.records(AXES_TOPIC)]
    return [range(b.first_sample, b.first_sample + len(b)) for b in blocks]


@REAL
def test_a_program_is_executed_as_planned_and_no_cycle_is_lost(tmp_path):
    design = ScanDesign(rpm=60.0, start=2e-3, end=1e-3, pitch=2e-4)
    write_scans([design], PAPER_MIRROR, tmp_path, 1e-7, 1e-3)
    path, _ = scan_program(design, PAPER_MIRROR, 1e-7, 1e-3)
    counts = demo.run(tmp_path / "scan_1.nc", tmp_path / "command.mcap")
    assert counts.get("lost", 0) == counts.get("overruns", 0) == 0
    assert counts["samples"] == counts["decoded"] > 5000
    judged = behind.judge(tmp_path / "scan_1.csv", tmp_path / "command.mcap", path.error)
    assert judged["within"]
    assert judged["rate"] == pytest.approx(2 * np.pi, rel=1e-3)
    assert judged["rate_rms"] < 0.02 * 2 * np.pi
    axes, _ = behind.commanded(tmp_path / "command.mcap")
    time_ = (axes.c - path.c[0]) / (2 * np.pi)
    inner = (time_ > 0.1) & (time_ < path.time[-1] - 0.1)
    off = (axes.z - path.motion(time_)[1])[inner]
    assert np.max(np.abs(off)) < 1e-10  # the planner is known
    found = behind.behind(tmp_path / "command.mcap", None, Cell(), PAPER_MIRROR, 0.0)
    # The reading is what the twin's truth says, within its noise and resolution.
    truth = Cell().probe.scale * (found.surface_height - found.probe_motion)
    ok = found.distance.ok
    assert np.mean(ok) > 0.99
    assert np.std((found.distance.distance - truth)[ok]) < 12e-9


def numbers(bag):
    return np.concatenate([np.array(r) for r in counters(bag)])


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as free:
        return free.getsockname()[1]


def wait_until(reached, patience=30.0):
    end = time.monotonic() + patience
    while not reached():
        assert time.monotonic() < end, "nothing came in time"
        time.sleep(0.1)


@contextlib.contextmanager
def recorder(port, bag):
    """Run ``omsm record`` and yield its process after a second of samples."""
    command = ["omsm", "record", "--port", f"tcp://127.0.0.1:{port}", "--out", str(bag), "--json"]
    with subprocess.Popen([*command, "--silence", "30"], stdout=subprocess.PIPE) as process:
        try:
            wait_until(lambda: bag.exists() and bag.stat().st_size > 20_000)
            yield process
        finally:
            process.kill()


def test_a_recording_says_once_what_it_waits_for(tmp_path, monkeypatch):
    monkeypatch.setattr("omsm_ros.pipelines.record_bags._PATIENCE_S", 0.1)
    given = {"device": "linuxcnc", "port": f"tcp://127.0.0.1:{free_port()}"}
    said = []
    with pytest.raises(DeviceError, match="no sample came"):
        record_device(
            given, tmp_path / "1.mcap", lambda n, silent: n > 0 or silent > 1.0, waits=said.append
        )
    assert len(said) == 1
    assert said[0].startswith("no sample yet from 'tcp://127.0.0.1:")


@pytest.mark.soak
@REAL
def test_a_killed_reader_leaves_the_rest_to_the_next(tmp_path):
    port = free_port()
    given = {"device": "linuxcnc", "port": f"tcp://127.0.0.1:{port}"}
    program = steps_gcode(plan_steps(sample_period=1e-3, count=3, dwell=2.0))
    with start.running(program, port):
        with recorder(port, tmp_path / "1.mcap"):
            time.sleep(2.0)
        more = record_device(
            given, tmp_path / "2.mcap", lambda n, silent: n > 1000 or silent > 20.0
        )
    first, then = numbers(tmp_path / "1.mcap"), numbers(tmp_path / "2.mcap")
    assert len(first) > 1000
    assert len(then) > 1000
    assert np.all(np.diff(first) == 1)
    assert np.all(np.diff(then) == 1)
    # Lines that the dead reader had taken and not written are a gap of the count.
    assert 0 < then[0] - first[-1] < 2000
    assert more.get("lost", 0) == more.get("restarts", 0) == 0


@pytest.mark.soak
@REAL
def test_a_killed_linuxcnc_is_a_restart_of_the_count(tmp_path):
    port, bag = free_port(), tmp_path / "1.mcap"
    program = steps_gcode(plan_steps(sample_period=1e-3, count=3, dwell=2.0))
    with contextlib.ExitStack() as stack:
        with start.running(program, port):
            reader = stack.enter_context(recorder(port, bag))
            time.sleep(2.0)
            for number in start.processes()[0]:
                os.kill(number, signal.SIGKILL)
        with start.running(program, port):
            size = bag.stat().st_size
            wait_until(lambda: bag.stat().st_size > size + 50_000)
            reader.send_signal(signal.SIGINT)
            found = json.loads(reader.communicate(timeout=20.0)[0])
    assert found["restarts"] == 1
    assert found.get("lost", 0) == found.get("overruns", 0) == 0
    blocks = counters(bag)
    assert sum(map(len, blocks)) == found["samples"] == found["decoded"]
    # Each run is counted from the cycle in which it is homed, without a gap or a repetition.
    steps = np.diff(numbers(bag))
    (at,) = np.flatnonzero(steps != 1)
    assert 1 < numbers(bag)[at + 1] < 5000 < 10_000 * numbers(bag)[at]


ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/howto/linuxcnc.md").read_text()


def by_the_page(folder, begin):
    """Run the block of the page that begins so in ``folder``; return what it says."""
    (commands,) = (b for b in re.findall(r"```\n(.*?)```", PAGE, re.DOTALL) if b.startswith(begin))
    if not (folder / "config").exists():
        (folder / "config").symlink_to(ROOT / "config")
    said = folder / "log.txt"
    with said.open("w") as log:
        done = subprocess.run(
            ["bash", "-ec", commands], cwd=folder, check=False, stdout=log, stderr=log
        )
    assert done.returncode == 0, said.read_text()
    return said.read_text()


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """A folder with step test, scans and report."""
    folder = tmp_path_factory.mktemp("page")
    by_the_page(folder, "omsm plan steps")
    return folder


@pytest.mark.soak
@REAL
@pytest.mark.timeout(900)
def test_the_commands_of_the_page_lead_from_step_test_to_report(measured):
    assert (measured / "part" / "report.html").exists()
    found = json.loads((measured / "part" / "adjustment.json").read_text())
    # The twin's mirror has 113 nm.
    pv = found["figures"]["peak_to_valley"]
    assert abs(pv["value"] - 113e-9) < 2 * pv["standard_uncertainty"] + 10e-9


@pytest.mark.soak
@REAL
@pytest.mark.timeout(900)
def test_the_commands_of_the_page_filter_a_scan_as_predicted(measured):
    said = by_the_page(measured, "filter=")
    stated = re.findall(r"after: (\S+) nm \((\S+) to (\S+) nm\) as measured", said)
    middle, least, most = (float(v) * 1e-9 for v in stated[-1])
    off = float(re.search(r"'probe_rms': ([^,}]+)", said)[1])
    assert off == pytest.approx(middle, rel=0.2)
    assert 0.95 * least < off < 1.05 * most


@pytest.mark.soak
@REAL
@pytest.mark.timeout(900)
def test_the_commands_of_the_page_close_the_loop(tmp_path):
    by_the_page(tmp_path, "python config/linuxcnc/loop.py")
    pv = [found[0] for found in json.loads((tmp_path / "cuts" / "loop.json").read_text())]
    assert pv[0] > 600e-9
    assert pv[2] < 60e-9
    assert pv[0] > pv[1] > pv[2]
    # The single commands are those of the loop.
    made = [tmp_path / "cuts" / folder / "cut.nc" for folder in ("compensation_1", "after")]
    assert made[0].read_bytes() == made[1].read_bytes()


class Wave:
    duration = 1.0

    def positions(self, time):
        zero = np.zeros_like(time)
        z = 1e-5 * np.sin(2 * np.pi * 3 * np.clip(time, 0, 1))
        return AxisPositions(zero, zero, z, zero, zero)


def in_cycles(axes):
    """The block of a motion x, y, z, b, c (n,) in servo cycles."""
    return AxisBlock(
        stamp_ns=0, first_sample=0, sample_period=1e-3, **dict(zip("xyzbc", axes, strict=True))
    )


@pytest.mark.parametrize(("rpm", "servo"), [(60.0, 200.0), (120.0, 90.0)])
def test_filtered_commands_leave_what_is_predicted(tmp_path, rpm, servo):
    """The planner is its model here; servo, structure and encoder are the twin's."""
    cell = Cell(disturbances=Disturbances(servo_bandwidth_hz=servo))
    second = SECOND_SHARE * PLANNED_STEP_M
    steps = plan_steps(sample_period=1e-3, second_step=second, count=PLANNED_COUNT, dwell=1.0)
    asked = steps.positions(np.arange(round(steps.duration / 1e-3)) * 1e-3)
    axes = in_cycles((asked.x, asked.y, asked.z, asked.b, asked.c))
    found = record(cell, behind.CommandedMotion(axes), Flat())
    write_recording(tmp_path / "steps.mcap", found)
    write_recording(tmp_path / "command.mcap", replace(found, axes=axes))
    write_nominal(tmp_path / "mirror.yaml")
    plain, plan, before, after = precompensate.main(
        tmp_path / "command.mcap", tmp_path / "steps.mcap", tmp_path / "mirror.yaml",
        rpm, 12.7e-3, rpm / 20, tmp_path / "out.nc",
    )  # fmt: skip

    def off_the_path(planned):
        time_ = np.arange(0.0, planned.time[-1], 1e-3)
        x, z, c = planned.motion(time_)
        zero = np.zeros_like(x)
        motion = behind.CommandedMotion(in_cycles((x, zero, z, zero, c)))
        axes = record(replace(cell, seed=2), motion, PAPER_MIRROR).axes
        plan = np.loadtxt(tmp_path / "out.csv", delimiter=",", skiprows=1).T
        return behind.judge_path(plan, axes.x, axes.z, axes.c, 1e-3)["rms"]

    assert off_the_path(plain) == pytest.approx(before.seen[0], rel=0.02)
    off = off_the_path(plan)
    middle, least, most = after.seen
    assert off == pytest.approx(middle, rel=0.2)
    assert 0.95 * least < off < 1.05 * most
    assert most < before.seen[0] / 100
    assert np.max(np.abs(np.diff(plan.motion(np.arange(0.5, 2.0, 1e-3))[1], 2))) < 1e-6 * 10


def test_an_axis_that_is_too_slow_for_the_filtered_commands_is_named(monkeypatch):
    monkeypatch.setattr(precompensate, "limits", lambda: (1e-3, 20.0))
    follows = np.zeros(precompensate.AHEAD + precompensate.TAPS)
    follows[precompensate.AHEAD] = 1.0
    design = ScanDesign(rpm=60.0, start=12.7e-3, end=12.6e-3, pitch=2e-4)
    with pytest.raises(ValueError, match=r"Z would need .* m/s, allowed is half of 0.001"):
        precompensate.precompensated(
            lambda t: scan_path(design, PAPER_MIRROR, t), design.duration, follows
        )


def test_a_rehearsal_shows_the_lag_and_how_the_probe_follows_the_segments(tmp_path):
    """The reading is the path, late, and the ripple of the segments, smaller and late, in noise."""
    design = ScanDesign(rpm=120.0, start=12.7e-3, end=12.5e-3, pitch=5e-6)

    def path(time_):
        return scan_path(design, PAPER_MIRROR, time_)

    small = precompensate.reduced(path, design.duration)
    plan = precompensate.planned_at(small, design.duration, 4e-3, 1e-3)
    time_ = np.arange(int(plan.time[-1] / 1e-3)) * 1e-3
    x, z, c = plan.motion(time_)
    assert not np.any(x)
    assert np.ptp(z) < 2.01 * precompensate.REACH_M
    lag, gain = 3e-6, 2.0 * np.exp(-0.7j)
    off = z - small(time_)[1]
    followed = gain.real * off + gain.imag * np.imag(precompensate.hilbert(off))
    noise = np.random.default_rng(1).normal(0.0, 1e-8, len(z))
    found = record(Cell(), Wave(), Flat())
    zero = np.zeros_like(z)
    seen = replace(
        found,
        axes=in_cycles((x, zero, z, zero, c)),
        distance=replace(
            found.distance,
            distance=noise - 0.99 * (small(time_ - lag)[1] + followed),
            intensity=np.ones_like(z),
            status=np.zeros(len(z), found.distance.status.dtype),
        ),
    )
    write_recording(tmp_path / "rehearsal.mcap", seen)
    static = 0.99 / 1.0001, 1e-5
    seen = precompensate.rehearsed(tmp_path / "rehearsal.mcap", plan, small, small, static)
    assert seen.frequency == pytest.approx(4.0, rel=0.1)  # two waves a turn
    uncertain = np.linalg.norm(seen.factor, axis=1)
    z = small(time_)[1]
    sizes = [np.linalg.norm(v) for v in (np.gradient(z, time_), z, off, off)]
    expected = 1e-8 / 0.99 / np.array(sizes)
    expected[1] = np.hypot(expected[1], 1e-5)
    assert uncertain == pytest.approx(expected, rel=0.2)
    assert np.all(np.abs(seen.found - [lag, 1e-4, gain.real, gain.imag]) < 3 * uncertain)
    assert seen.noise == pytest.approx(1e-8 / 0.99, rel=0.02)


def test_a_motion_in_servo_cycles_is_the_motion():
    zero = np.zeros(1000)
    block = in_cycles((zero, zero, Wave().positions(np.arange(1000) * 1e-3).z, zero, zero))
    sampled = record(Cell(), behind.CommandedMotion(block), Flat())
    direct = record(Cell(), Wave(), Flat())
    inner = slice(50, -10)
    np.testing.assert_allclose(
        sampled.probe_motion[inner], direct.probe_motion[inner], rtol=0, atol=2e-11
    )


def test_without_linuxcnc_the_package_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(start.shutil, "which", lambda name: None)
    assert start.INSTALL in start.missing()
    with pytest.raises(SystemExit, match=r"apt-get install .* linuxcnc-uspace"):
        demo.main(str(tmp_path / "none"))


def test_a_recording_is_judged_against_its_plan():
    design = ScanDesign(rpm=30.0, start=2e-3, end=1.8e-3, pitch=1e-4)
    planned, _ = scan_program(design, PAPER_MIRROR)
    path = (planned.time, planned.x, planned.height, planned.c)
    t = np.arange(0, 4000) * 1e-3
    x, z, c = scan_path(design, PAPER_MIRROR, t)
    good = behind.judge_path(path, x, z + 3e-6, c, 1e-3)
    assert good["error"] < 1e-10
    assert good["mean"] == pytest.approx(3e-6)
    assert good["rate"] == pytest.approx(np.pi, rel=1e-6)
    bad = behind.judge_path(path, x, z + 2e-7 * np.sin(2 * t), c, 1e-3)
    assert 1.5e-7 < bad["error"] < 3e-7
    with pytest.raises(DataError):
        behind.judge_path(path, x, z, np.zeros_like(c), 1e-3)
