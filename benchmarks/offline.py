"""The offline commands as whole processes: time, growth with length, memory."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.row import Row, at_most
from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.samples.blocks import AxisBlock, DistanceBlock
from omsm_ros.storage import bags
from omsm_ros.storage.calibration_file import save_calibration
from omsm_ros.twin.plant import PAPER_DYNAMICS, PAPER_STATIC_GAIN
from omsm_ros.units import NANOSECONDS_PER_S

PAPER_POINTS = 290_011
LONG_POINTS = 50_000_000
_BLOCK = 100


def _write_bag(path: Path, samples: int, block: int = _BLOCK) -> None:
    """A spiral-like motion of ``samples``, cheap to make."""
    random = np.random.default_rng(0)
    noise = random.normal(0.0, 1e-8, block)
    zero = np.zeros(block)
    with bags.BagWriter(path, (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)) as bag:
        for first in range(0, samples, block):
            n = min(block, samples - first)
            angle = np.pi * 1e-3 * np.arange(first, first + n)
            radius = np.full(n, 0.0127 * (1 - first / samples))
            common = {
                "stamp_ns": first * NANOSECONDS_PER_S // 1000,
                "first_sample": first,
                "sample_period": 1e-3,
            }
            z = 3.4 * radius**2 * np.cos(2 * angle)
            bag.write_axes(AxisBlock(**common, x=radius, y=zero[:n], z=z, b=zero[:n], c=angle))
            bag.write_distance(DistanceBlock(**common, distance=noise[:n]))


def _calibration(path: Path) -> None:
    coefficients = np.r_[PAPER_DYNAMICS.numerator, PAPER_DYNAMICS.denominator[1:], 0.0]
    variance = (1e-3 * coefficients) ** 2
    variance[0] = 0.0
    save_calibration(
        path,
        Calibration(
            dynamics=PAPER_DYNAMICS,
            static_gain=PAPER_STATIC_GAIN,
            sample_period=1e-3,
            valid_up_to=100.0,
            covariance=np.diag(variance),
            certificate={"verdict": "accepted", "polarity": 1},
        ),
    )


def _correct(folder: Path, bag: str) -> tuple[float, float]:
    """Seconds and peak memory [GiB] of ``omsm correct`` on a bag."""
    command = [sys.executable, "-m", "omsm_ros.cli", "correct", str(folder / bag), "--no-report"]
    command += ["--calibration", str(folder / "cal.json"), "--out", str(folder / "result")]
    begin = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise RuntimeError(f"omsm correct ended with {status}")
    return time.perf_counter() - begin, usage.ru_maxrss * 1024 / 2**30


def rows(full: bool) -> Iterator[Row]:
    """Bag to cloud of the paper's scan, of ten times it, and of a very long one."""
    long_points = LONG_POINTS if full else LONG_POINTS // 10
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _calibration(folder / "cal.json")
        for bag, samples in (("paper", PAPER_POINTS), ("ten", 10 * PAPER_POINTS)):
            _write_bag(folder / f"{bag}.mcap", samples)
        once = min(_correct(folder, "paper.mcap")[0] for _ in range(3))
        yield at_most("omsm correct, 290 011 points, whole process", once, "s", 1.5)
        ten = _correct(folder, "ten.mcap")[0]
        yield at_most("omsm correct, ten times the samples: times the time", ten / once, "1", 11.0)
        _write_bag(folder / "long.mcap", long_points)
        seconds, memory = _correct(folder, "long.mcap")
        size = (folder / "long.mcap").stat().st_size / 2**30
        text = f"bag of {size:.1f} GiB, {seconds:.0f} s"
        yield at_most(f"omsm correct, {long_points} points: memory", memory, "GiB", 1.0, text)
