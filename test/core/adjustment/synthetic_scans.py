"""Scans of one part in closed form, of a model written apart from the fit: no twin, no filter."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from omsm_ros.core.adjustment.scan_data import ScanData
from omsm_ros.core.streams.blocks import FloatArray

Surface = Callable[[FloatArray, FloatArray], FloatArray]
OUTER_M, INNER_M, PERIOD_S = 10e-3, 2e-3, 4e-3


def saddle(x: FloatArray, y: FloatArray) -> FloatArray:
    """Heights [m] of two waves a turn and one, and a bowl; cubics of the radius at most."""
    u, v = x / OUTER_M, y / OUTER_M
    return 40e-6 * (u**2 - v**2) + 30e-6 * u * (u**2 + v**2) + 20e-6 * (u**2 + v**2)


def coma(x: FloatArray, y: FloatArray) -> FloatArray:
    """Heights [m] of one wave a turn: all that slow slides follow of :func:`saddle`."""
    return 30e-6 * x * (x**2 + y**2) / OUTER_M**3


def scanned(
    rpm: float,
    surface: Surface = saddle,
    followed: Surface | None = None,
    *,
    turns: int = 16,
    lag: float = 0.0,
    curvature: float = 0.0,
    latency: float = 0.0,
    clocking: float = 0.0,
    moved: tuple[float, float] = (0.0, 0.0),
    noise: float = 1e-9,
    seed: int = 0,
) -> ScanData:
    """Return a scan of ``surface`` by a probe that is late by ``latency`` [s].

    followed: by Z; the surface itself where none is given

    lag [s], curvature [s²]: by which the correction of Z is wrong
    clocking [rad], moved [m]: how the part has turned and shifted since
    """
    omega = rpm * np.pi / 30
    duration = turns * 60 / abs(rpm)
    time = np.arange(round(duration / PERIOD_S)) * PERIOD_S
    feed = -(OUTER_M - INNER_M) / duration

    def place(at: FloatArray) -> FloatArray:
        return (OUTER_M + feed * at) * np.exp(-1j * omega * at)

    def seen(heights: Surface, at: FloatArray) -> FloatArray:
        there = place(at) * np.exp(-1j * clocking)
        return heights(there.real - moved[0], there.imag - moved[1])

    step = 1e-4
    before, here, after = (seen(followed or surface, time + k * step) for k in (-1, 0, 1))
    rate, acceleration = (after - before) / (2 * step), (after - 2 * here + before) / step**2
    scatter = np.random.default_rng(seed).normal(0.0, noise, len(time))
    height = seen(surface, time - latency) + lag * rate - curvature * acceleration + scatter
    at = place(time)
    return ScanData(
        time=time,
        x=at.real,
        y=at.imag,
        height=height,
        distance=height - here,
        motion=here,
        removed=np.zeros(len(time)),
        # No reading lies just where a turn begins.
        c=omega * time + 1e-3,
    )
