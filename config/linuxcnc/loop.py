"""Close the loop on LinuxCNC and the twin: cut, measure, compensate, cut again.

    python loop.py OUT [CYCLES [--model]]     --model: the planner of omsm_ros instead of LinuxCNC

The twin cuts: the surface is what the nose of the tool leaves along the true motion of the tip,
with a servo that lags behind, and a nose that is not round. The same cell measures it in one scan.
"""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
from behind import CommandedMotion, commanded
from demo import run

from omsm_ros.core.adjustment import ScanDesign
from omsm_ros.core.form.compensation import cut_path
from omsm_ros.core.kinematics.planner import plan_path
from omsm_ros.core.kinematics.trajectories import plan_steps
from omsm_ros.core.streams.blocks import AxisBlock
from omsm_ros.core.surface.nominal import PAPER_MIRROR, Flat
from omsm_ros.io.gcode_file import path_gcode
from omsm_ros.pipelines.plan_scans import scan_program
from omsm_ros.pipelines.record_bags import NOMINAL, write_nominal, write_recording
from omsm_ros.twin.cell import Cell, record
from omsm_ros.twin.disturbances import Disturbances

RADIUS_M, FEED_M, RPM, NOSE_M, SERVO_HZ = 2.2e-3, 2e-5, 120.0, 5e-3, 200.0
SCAN_RPM, SCAN_FEED_M, LOW_PASS_M = 60.0, 1e-4, 0.8e-3
CYCLE_S = 1e-3
ANGLES = 360


def nose(u):
    """Return the height [m] of the real nose above its tip at ``u`` [m] beside it."""
    waves = 60e-9 * (1 - np.cos(2 * np.pi * u / 0.15e-3))
    return NOSE_M - np.sqrt(NOSE_M**2 - u**2) + waves


class CutPart:
    """Surface after a cut: deviation from the nominal on circles, linear between them."""

    def __init__(self, axes, tip):
        turn = axes.c / (2 * np.pi)
        place = np.arange(int(turn[0] * ANGLES) + 1, int(turn[-1] * ANGLES)) / ANGLES
        x, z = np.interp(place, turn, axes.x), np.interp(place, turn, tip)
        turns = len(place) // ANGLES
        x, z = (v[: turns * ANGLES].reshape(turns, ANGLES) for v in (x, z))
        self.first = place[0] % 1
        self.radius = np.arange(0.0, x[0, 0] - 5 * FEED_M, FEED_M / 2)
        reach = np.linspace(-0.35e-3, 0.35e-3, 281)
        self.deviation = np.empty((len(self.radius), ANGLES))
        angle = 2 * np.pi * (self.first + np.arange(ANGLES) / ANGLES)
        for k in range(ANGLES):
            order = np.argsort(x[:, k])
            at = self.radius[:, None] + reach
            # The nose at each turn: the tip's height over X, and what the nose adds beside it.
            nearest = np.clip(np.rint((at - x[order[0], k]) / FEED_M), 0, turns - 1).astype(int)
            tips, heights = x[order, k][nearest], z[order, k][nearest]
            left = np.min(heights + nose(self.radius[:, None] - tips), axis=1)
            on = PAPER_MIRROR.height(
                self.radius * np.cos(angle[k]), -self.radius * np.sin(angle[k])
            )
            self.deviation[:, k] = left - on

    def error(self, x, y):
        """Return the deviation along z [m] at x, y [m]."""
        r = np.clip(np.hypot(x, y) / (FEED_M / 2), 0, len(self.radius) - 1.001)
        a = ((np.arctan2(-y, x) / (2 * np.pi) - self.first) % 1.0) * ANGLES
        i, j = r.astype(int), a.astype(int) % ANGLES
        u, v, d = r - i, a - np.floor(a), self.deviation
        one = d[i, j] * (1 - u) + d[i + 1, j] * u
        return (
            one * (1 - v) + (d[i, (j + 1) % ANGLES] * (1 - u) + d[i + 1, (j + 1) % ANGLES] * u) * v
        )

    def height(self, x, y):
        """Return the height [m] at x, y [m]."""
        return PAPER_MIRROR.height(x, y) + self.error(x, y)


def executed(path, program, out, model):
    """Return the axes that were commanded by a program: on LinuxCNC, or by a planner's model."""
    if not model:
        run(program, out)
        return commanded(out)[0]
    time = np.arange(0.0, path.time[-1], CYCLE_S)
    x, z, c = path.motion(time)
    zero = np.zeros_like(x)
    return AxisBlock(
        stamp_ns=0, first_sample=0, sample_period=CYCLE_S, x=x, y=zero, z=z, b=zero, c=c
    )


def turning(axes):
    """Return the part of a motion in which C turns."""
    moves = np.flatnonzero(np.abs(np.diff(axes.c)) > 1e-6)
    cut = slice(int(moves[0]), int(moves[-1]) + 1)
    return AxisBlock(
        stamp_ns=0,
        first_sample=0,
        sample_period=axes.sample_period,
        **{name: getattr(axes, name)[cut] for name in "xyzbc"},
    )


def cell(seed):
    """Return the cell that cuts and measures."""
    return Cell(seed=seed, disturbances=Disturbances(servo_bandwidth_hz=SERVO_HZ))


def figures(part):
    """Return PV and rms [m] of the true form over the measured radius, pose removed."""
    r, a = np.meshgrid(
        np.sqrt(np.linspace(0.01, 1, 150)) * 0.9 * RADIUS_M, np.arange(180) * np.pi / 90
    )
    x, y = (r * np.cos(a)).ravel(), (r * np.sin(a)).ravel()
    columns = np.stack([np.ones_like(x), x, y], axis=1)
    error = part.error(x, y)
    error = error - columns @ np.linalg.lstsq(columns, error, rcond=None)[0]
    return float(np.ptp(error)), float(np.std(error))


def loop(out, cycles=2, model=False, sign=1):
    """Return PV and rms of the part after the first cut and each cycle; sign: -1 cuts reversed."""
    out.mkdir(parents=True)
    write_nominal(out / NOMINAL)
    motion = plan_steps(sample_period=CYCLE_S, second_step=3e-6, count=8, dwell=1.0)
    steps = record(cell(1), motion, Flat())
    write_recording(out / "steps.mcap", steps)
    omsm("identify", out / "steps.mcap", "--out", out / "cal.json")
    wanted, previous, found = PAPER_MIRROR, None, []
    path, duration = cut_path(wanted, 1.12 * RADIUS_M, FEED_M, RPM, NOSE_M)
    plan = plan_path(path, duration, CYCLE_S, 1e-8)
    program = out / "cut_0.nc"
    program.write_text(path_gcode(plan, ["first cut"], measures=False))
    for k in range(cycles + 1):
        axes = turning(executed(plan, program, out / f"cut_{k}.mcap", model))
        part = CutPart(axes, record(cell(10 + k), CommandedMotion(axes), Flat()).probe_motion)
        found.append(figures(part))
        print(
            f"cut {k}: PV {found[-1][0] * 1e9:.0f} nm, rms {found[-1][1] * 1e9:.1f} nm", flush=True
        )
        if k == cycles:
            break
        design = ScanDesign(rpm=SCAN_RPM, start=RADIUS_M, end=0.0, pitch=SCAN_FEED_M)
        scan, text = scan_program(design, PAPER_MIRROR)
        (out / f"scan_{k}.nc").write_text(text)
        seen = turning(executed(scan, out / f"scan_{k}.nc", out / f"scan_{k}_command.mcap", model))
        write_recording(out / f"scan_{k}.mcap", record(cell(20 + k), CommandedMotion(seen), part))
        result, made = out / f"result_{k}", out / f"compensation_{k}"
        omsm("correct", out / f"scan_{k}.mcap", "--calibration", out / "cal.json",
             "--nominal", out / NOMINAL, "--out", result, "--no-report")  # fmt: skip
        words = ["--previous", previous / "compensation.csv"] if previous else []
        omsm("compensate", result, "--nominal", out / NOMINAL, "--low-pass", LOW_PASS_M, "--fit",
             "piston", "--spiral", FEED_M, "--tool-radius", NOSE_M, "--rpm", RPM, "--out", made,
             *words)  # fmt: skip
        previous, program = made, made / "cut.nc"
        plan = vertices(program, plan)
        if sign < 0:
            reverse(plan)
            program.write_text(path_gcode(plan, ["reversed"], measures=False))
    return found


def vertices(program, like):
    """Return the path of a program of omsm_ros, as its planner has it."""
    words = [line.split() for line in program.read_text().splitlines() if line.startswith("G1 ")]
    x, z, c, f = (np.array([float(word[k][1:]) for word in words]) for k in (1, 2, 3, 4))
    segment = 60 / f[0]
    lead = 2 * c[0] - c[1], 2 * x[0] - x[1], 2 * z[0] - z[1]
    c, x, z = (np.concatenate([[a], v]) for a, v in zip(lead, (c, x, z), strict=True))
    time = np.arange(len(x)) * segment
    return type(like)(time, x * 1e-3, z * 1e-3, np.radians(c), z * 1e-3, CYCLE_S, 0.0, 0.0)


def reverse(plan):
    """Mirror the offsets of a cut about the nominal one, as a wrong sign does."""
    nominal = cut_path(PAPER_MIRROR, plan.x[0], FEED_M, RPM, NOSE_M)[0](plan.time)
    plan.z[:] = 2 * nominal[1] - plan.z


def omsm(*words):
    """Run a command of omsm; RuntimeError with what it says if it refuses."""
    command = [sys.executable, "-m", "omsm_ros.cli", *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(done.stderr.strip())


if __name__ == "__main__":
    number = int(sys.argv[2]) if len(sys.argv) > 2 else 2
    results = loop(Path(sys.argv[1]), number, "--model" in sys.argv)
    Path(sys.argv[1], "loop.json").write_text(json.dumps(results))
