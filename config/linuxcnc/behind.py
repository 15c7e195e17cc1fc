"""The twin behind LinuxCNC in the demonstration, and a comparison of a recording with its plan.

    python behind.py COMMAND.mcap OUT.mcap [flat|mirror|nominal]    what encoders and probe read
    python behind.py --judge scan_N.csv COMMAND.mcap|OUT.mcap       distance from the plan

LinuxCNC commands each servo cycle; servo of Z, encoder, structure, probe and part are simulated.
The part is a flat, a mirror with a deviation of form, or one without: there the probe reads how far
it is off the plan. Not imitated: real time (the servo thread is a process of the system), lag of X
and C, touch.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from omsm_ros.core.kinematics.trajectories import AxisPositions
from omsm_ros.core.streams.blocks import AxisBlock
from omsm_ros.core.surface.nominal import PAPER_MIRROR, Flat
from omsm_ros.errors import DataError
from omsm_ros.io import bags
from omsm_ros.io.topics import AXES_TOPIC, DISTANCE_TOPIC
from omsm_ros.pipelines.record_bags import write_recording
from omsm_ros.twin.cell import Cell, record
from omsm_ros.twin.plant import Trajectory
from omsm_ros.twin.scenario import Scenario


@dataclass(frozen=True, eq=False)
class CommandedMotion:
    """The motion that a controller commanded; between servo cycles a cubic, as drives do.

    axes: commanded positions of each servo cycle
    """

    axes: AxisBlock

    @property
    def duration(self):
        """Duration [s]."""
        return len(self.axes) * self.axes.sample_period

    def positions(self, time):
        """Return the commanded axes at ``time`` [s]; still before and after the record."""
        period = self.axes.sample_period
        within = np.clip(time, 0.0, (len(self.axes) - 1) * period)
        return AxisPositions(
            *(Trajectory(0.0, period, getattr(self.axes, n)).at(within) for n in "xyzbc")
        )


def blocks_of(bag):
    """Return the blocks of axes and of readings of a bag."""
    with bags.BagReader(bag) as reader:
        axes = [block for _, block in reader.records(AXES_TOPIC)]
        return axes, [block for _, block in reader.records(DISTANCE_TOPIC)]


def commanded(bag):
    """Return the commanded axes of a bag as one block, and whether the probe measures, each (n,).

    Raises DataError where servo cycles are missing.
    """
    axes, readings = blocks_of(bag)
    ends = [block.first_sample + len(block) for block in axes]
    if any(b.first_sample != end for b, end in zip(axes[1:], ends, strict=False)):
        raise DataError(f"{str(bag)!r} lacks servo cycles; the truth behind them is unknown")
    whole = AxisBlock(
        stamp_ns=axes[0].stamp_ns,
        first_sample=axes[0].first_sample,
        sample_period=axes[0].sample_period,
        **{name: np.concatenate([getattr(b, name) for b in axes]) for name in "xyzbc"},
    )
    return whole, np.concatenate([block.ok for block in readings])


def behind(bag, out, cell, part, stand_off=None):
    """Return what encoders and probe read while the motion in ``bag`` was commanded, with truth.

    Only what the program marked as measured is kept, from one servo cycle before it on.

    out: bag to write the recording into;  stand_off: as for the twin, None centres the probe
    """
    axes, measures = commanded(bag)
    there = np.flatnonzero(measures)
    if not len(there):
        raise DataError(f"the program of {str(bag)!r} marks nothing as measured (M64 P0)")
    part_of = slice(int(there[0]), int(there[-1]) + 1)
    kept = AxisBlock(
        stamp_ns=axes.stamp_ns,
        first_sample=0,
        sample_period=axes.sample_period,
        **{name: getattr(axes, name)[part_of] for name in "xyzbc"},
    )
    if stand_off is None:
        stand_off = -float(kept.z.max() + kept.z.min()) / 2
    recording = record(cell, CommandedMotion(kept), part, stand_off=stand_off)
    if out is not None:
        write_recording(out, recording)
    return recording


def judge_path(plan, x, z, c, period, distance=None):
    """Compare a recording (n,) every ``period`` [s] with its plan (t, x, z, c), at equal C.

    distance: of the probe, NaN without a target

    Returns the number of ``samples``; ``error``, ``rms`` and ``mean`` of Z, and ``x_error`` [m];
    ``rate`` of C and ``rate_rms``, its deviation [rad/s]; ``probe_rms``, of what the probe read
    [m], None if it read nothing. The mean of Z depends on the mounting and is removed. Raises
    DataError if less than a tenth of the plan was recorded.
    """
    t, plan_x, plan_z, plan_c = plan
    rate = (plan_c[-1] - plan_c[0]) / (t[-1] - t[0])
    time = (c - plan_c[0]) / rate + t[0]
    edge = 2 * (t[1] - t[0])
    there = (time >= t[0] + edge) & (time <= t[-1] - edge)
    if np.sum(there) * period < 0.1 * (t[-1] - t[0]):
        raise DataError("less than a tenth of the plan was recorded; do both belong together?")
    at_x, at_z = (Trajectory(t[0], t[1] - t[0], v).at(time[there]) for v in (plan_x, plan_z))
    off, speed = z[there] - at_z, np.diff(c)[there[1:] & there[:-1]] / period
    return {
        "samples": int(np.sum(there)),
        "error": float(np.max(np.abs(off - np.mean(off)))),
        "rms": float(np.std(off)),
        "mean": float(np.mean(off)),
        "x_error": float(np.max(np.abs(x[there] - at_x))),
        "rate": float(np.mean(speed)),
        "rate_rms": float(np.std(speed)),
        "probe_rms": None if distance is None else float(np.nanstd(distance[there])),
    }


def judge(program, recording, bound):
    """Compare the axes of a bag with the scan_N.csv that was run."""
    axes, measures = commanded(recording)
    plan = np.loadtxt(program, delimiter=",", skiprows=1).T
    read = np.concatenate([block.distance for block in blocks_of(recording)[1]])
    distance = np.where(measures, read, np.nan) if np.any(read[measures]) else None
    found = judge_path(plan, axes.x, axes.z, axes.c, axes.sample_period, distance)
    return {**found, "bound": bound, "within": found["error"] <= bound}


if __name__ == "__main__":
    if sys.argv[1] == "--judge":
        print(judge(sys.argv[2], Path(sys.argv[3]), np.inf))
    else:
        name = sys.argv[3] if len(sys.argv) > 3 else "flat"
        part = {"flat": Flat(), "mirror": Scenario().part, "nominal": PAPER_MIRROR}[name]
        behind(*map(Path, sys.argv[1:3]), Cell(), part, None if name == "flat" else 0.0)
