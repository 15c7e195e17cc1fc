"""The offline commands as whole processes: time, growth with length, memory."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rosbags.rosbag2 import Reader
from scipy import signal

from benchmarks.row import Row, at_least, at_most, shown
from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.calibration.certificate import Certificate, Residual, StaticGain
from omsm_ros.core.streams.blocks import AxisBlock, DistanceBlock, FloatArray
from omsm_ros.io import bags
from omsm_ros.io.bag_writer import BagWriter
from omsm_ros.io.calibration_file import save_calibration
from omsm_ros.io.message_mapping import bag_messages, block_message
from omsm_ros.twin.plant import PAPER_DYNAMICS, PAPER_STATIC_GAIN
from omsm_ros.units import NANOSECONDS_PER_S

PAPER_POINTS = 290_011
# Over five hours at 1 kHz; what is done once, however long a scan is, tells little there.
LONG_POINTS, LONGEST_POINTS = 20_000_000, 50_000_000
TWO_DRIVERS_OFFSET = 4711
# Samples of a message; of the probe where it has a driver of its own.
_BLOCK, _PROBE_BLOCK = 100, 64
_RUNS = 5


def write_spiral(path: Path, samples: int, block: int = _BLOCK, seed: int = 0) -> None:
    """Write a spiral-like motion of ``samples``, from one driver of both streams."""
    noise = np.random.default_rng(seed).normal(0.0, 1e-8, block)
    with BagWriter(path, (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)) as bag:
        for first in range(0, samples, block):
            n = min(block, samples - first)
            bag.write_block(_axes(first, n, samples))
            bag.write_block(_distance(first, noise[:n]))


def write_two_drivers(path: Path, samples: int, seed: int = 0) -> None:
    """Write the same motion as sent by separate drivers of axes and probe.

    Each cuts its own blocks and counts from its own start: the count of the axes is that of the
    probe plus TWO_DRIVERS_OFFSET. Its clock scatters by 20 µs, and it delivers up to 20 ms late.
    """
    random = np.random.default_rng(seed)
    noise = random.normal(0.0, 1e-8, _BLOCK)
    sent = [
        (first + length + random.uniform(0, 20), first, length)
        for length in (_BLOCK, _PROBE_BLOCK)
        for first in range(0, samples, length)
    ]
    messages = bag_messages()
    with BagWriter(path, (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)) as bag:
        for received_ms, first, length in sorted(sent):
            n = min(length, samples - first)
            received, late = round(received_ms * 1e6), round(random.normal(20e3, 20e3))
            if length == _BLOCK:
                axes = _axes(first, n, samples)
                count = first + TWO_DRIVERS_OFFSET
                axes = replace(axes, first_sample=count, stamp_ns=axes.stamp_ns + late)
                bag.write(bags.AXES_TOPIC, received, block_message(messages, axes))
            else:
                distance = _distance(first, noise[:n])
                distance = replace(distance, stamp_ns=distance.stamp_ns + late)
                bag.write(bags.DISTANCE_TOPIC, received, block_message(messages, distance))


def _axes(first: int, n: int, samples: int) -> AxisBlock:
    angle = np.pi * 1e-3 * np.arange(first, first + n)
    radius = np.full(n, 0.0127 * (1 - first / samples))
    zero = np.zeros(n)
    return AxisBlock(
        stamp_ns=first * NANOSECONDS_PER_S // 1000,
        first_sample=first,
        sample_period=1e-3,
        x=radius,
        y=zero,
        z=3.4 * radius**2 * np.cos(2 * angle),
        b=zero,
        c=angle,
    )


def _distance(first: int, distance: FloatArray) -> DistanceBlock:
    return DistanceBlock(
        stamp_ns=first * NANOSECONDS_PER_S // 1000,
        first_sample=first,
        sample_period=1e-3,
        distance=distance,
    )


def save_paper_calibration(path: Path, rate: float = 1e3) -> None:
    """Save the paper's response at ``rate`` [Hz], known to a thousandth."""
    coefficients = np.r_[PAPER_DYNAMICS.numerator, PAPER_DYNAMICS.denominator[1:], 0.0]
    variance = (1e-3 * coefficients) ** 2
    variance[0] = 0.0
    save_calibration(
        path,
        Calibration(
            dynamics=PAPER_DYNAMICS,
            static_gain=PAPER_STATIC_GAIN,
            sample_period=1 / rate,
            valid_up_to=100.0,
            covariance=np.diag(variance),
            certificate=Certificate(
                verdict="accepted",
                residual=Residual(noise_m=1e-8),
                static_gain=StaticGain(polarity=1),
            ),
        ),
    )


class Used(NamedTuple):
    """Resources of a finished process: wall clock and processor [s], peak memory [GiB]."""

    wall: float
    cpu: float
    memory: float


def _correct(folder: Path, bag: str, *options: str, report: bool = False) -> Used:
    """Run ``omsm correct`` on a bag in a process of its own."""
    command = [sys.executable, "-m", "omsm_ros.cli", "correct", str(folder / bag)]
    command += ["--calibration", str(folder / "cal.json"), "--out", str(folder / "result")]
    command += [*options, *([] if report else ["--no-report"])]
    begin = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise RuntimeError(f"omsm correct ended with {status}")
    wall = time.perf_counter() - begin
    return Used(wall, usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024 / 2**30)


def _whole_processes(folder: Path) -> Iterator[Row]:
    """The paper's scan with and without its page, beside what loading scipy.signal takes."""
    for report, limit in ((False, 1.0), (True, 2.0)):
        runs = [_correct(folder, "paper.mcap", report=report) for _ in range(_RUNS)]
        wall, cpu = (float(np.median([getattr(r, n) for r in runs])) for n in ("wall", "cpu"))
        name = f"omsm correct, 290 011 points, whole process, {'' if report else 'no '}report"
        peer = f"{cpu:.2f} s of a core"
        yield at_most(name, wall, "s", limit, peer, runs=_RUNS)
    command = [sys.executable, "-c", "import scipy.signal"]
    loading = []
    for _ in range(_RUNS):
        begin = time.perf_counter()
        subprocess.run(command, check=True)
        loading.append(time.perf_counter() - begin)
    yield shown("python -c 'import scipy.signal', beside it", float(np.median(loading)), "s")


def _rates(folder: Path, samples: int, used: Used, start: Used) -> Iterator[Row]:
    """Samples a second and core from bag to cloud, beside a bare read and one linear filter.

    start: of ten times the paper's scan, whose adjustment takes as long: both reduce their points
    """
    ours = (samples - 10 * PAPER_POINTS) / (used.cpu - start.cpu)
    begin = time.process_time()
    with Reader(folder / "long.mcap") as reader:
        for _ in reader.messages():
            pass
    read = samples / (time.process_time() - begin)
    numerator, denominator = signal.butter(5, 0.2)
    z = np.random.default_rng(0).normal(size=1_000_000)
    begin = time.process_time()
    signal.lfilter(numerator, denominator, z)
    filtered = len(z) / (time.process_time() - begin)
    name = "bag to cloud with uncertainty, long bag, samples a second and core"
    yield at_least(name, ours / 1e6, "10⁶/s", 2.5)
    yield _of_two_drivers(folder, start, ours)
    yield shown("  bare read of the same bag, times as fast", read / ours, "1")
    yield shown("  scipy.signal.lfilter of order 5, times as fast", filtered / ours, "1")


def _of_two_drivers(folder: Path, start: Used, of_one: float) -> Row:
    """The same rate where axes and probe were recorded from drivers of their own."""
    write_two_drivers(folder / "two.mcap", LONG_POINTS)
    used = _correct(folder, "two.mcap", "--counter-offset", str(TWO_DRIVERS_OFFSET))
    rate = (LONG_POINTS - 10 * PAPER_POINTS) / (used.cpu - start.cpu)
    text = f"{rate / of_one:.2f} of one driver's"
    name = "  the same of two drivers, blocks of 100 and 64, offset counters"
    return at_least(name, rate / 1e6, "10⁶/s", 2.0, text)


def rows(full: bool) -> Iterator[Row]:
    """Bag to cloud of the paper's scan, of ten times it, and of a very long one."""
    long_points = LONGEST_POINTS if full else LONG_POINTS
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        save_paper_calibration(folder / "cal.json")
        for bag, samples in (("paper", PAPER_POINTS), ("ten", 10 * PAPER_POINTS)):
            write_spiral(folder / f"{bag}.mcap", samples)
        yield from _whole_processes(folder)
        once = _correct(folder, "paper.mcap")
        ten = _correct(folder, "ten.mcap")
        text = "omsm correct, ten times the samples: times the time"
        yield at_most(text, ten.cpu / once.cpu, "1", 11.0)
        write_spiral(folder / "long.mcap", long_points)
        used = _correct(folder, "long.mcap")
        yield from _rates(folder, long_points, used, ten)
        size = (folder / "long.mcap").stat().st_size / 2**30
        text = f"bag of {size:.1f} GiB, {used.wall:.0f} s"
        yield at_most(f"omsm correct, {long_points} points: memory", used.memory, "GiB", 1.0, text)
