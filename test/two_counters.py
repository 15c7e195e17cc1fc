"""Two devices that count one trigger, before a fixed target: written down in plain numpy."""

from __future__ import annotations

import numpy as np

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.correction.counter_offset import LiveOffset
from omsm_ros.core.streams.blocks import AxisBlock, DistanceBlock, FloatArray
from omsm_ros.twin.plant import PAPER_STATIC_GAIN, Plant

N, BLOCK, PERIOD, NOISE = 8000, 50, 1e-3, 10e-9
G = Plant().dynamics
CALIBRATION = Calibration(
    dynamics=G,
    static_gain=PAPER_STATIC_GAIN,
    sample_period=PERIOD,
    valid_up_to=100.0,
    covariance=np.diag(np.full(len(G.numerator) + len(G.denominator), 1e-24)),
)
LAG = G.low_frequency_delay / PERIOD
Blocks = list[tuple[AxisBlock, DistanceBlock]]


def motion(kind: str) -> FloatArray:
    """Return Z of a chirp, of uneven steps, of a sine, or of a stationary axis [m], (n,)."""
    t = np.arange(N + 2000) * PERIOD
    if kind == "chirp":
        return np.asarray(20e-6 * np.sin(2 * np.pi * (0.5 * t + 0.35 * t**2)))
    if kind == "sine":
        return np.asarray(20e-6 * np.sin(2 * np.pi * t / 0.12))
    if kind == "rest":
        return np.zeros(len(t))
    edges = np.cumsum(np.random.default_rng(2).integers(150, 450, 60))
    window = np.hanning(31) / np.hanning(31).sum()
    return np.convolve(np.searchsorted(edges, t / PERIOD) % 4 * 10e-6, window, "same")


def blocks(z: FloatArray, slip: int, *, late: float = 0.0, followed: float = 0.0) -> Blocks:
    """Both streams: equal counts mean triggers ``slip`` apart, axes are stamped ``late`` [s].

    followed: share of the motion of Z that the surface makes, too, 25 samples later
    """
    random, made = np.random.default_rng(4), []
    still = np.zeros(BLOCK)
    for first in range(500, N, BLOCK):
        k = first + np.arange(BLOCK)
        at = np.arange(len(z))
        seen = np.interp(k + slip - LAG, at, z) - followed * np.interp(k + slip - 25, at, z)
        distance = 50e-6 - PAPER_STATIC_GAIN * seen + random.normal(0.0, NOISE, BLOCK)
        when, stamp = first * PERIOD, {"first_sample": first, "sample_period": PERIOD}
        axes = AxisBlock(
            stamp_ns=round((when + late) * 1e9), x=still, y=still, z=z[k], b=still, c=still, **stamp
        )
        jitter = float(random.normal(0.0, 5e-6))
        made.append(
            (axes, DistanceBlock(stamp_ns=round((when + jitter) * 1e9), distance=distance, **stamp))
        )
    return made


def watched(came: Blocks, in_use: int = 0) -> LiveOffset:
    watch = LiveOffset(CALIBRATION, in_use)
    for i, (axes, distance) in enumerate(came):
        watch.add(axes)
        watch.add(distance)
        if i % 20 == 0:
            watch.judge()
    return watch
