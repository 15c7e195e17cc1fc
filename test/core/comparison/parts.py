"""A part with a form of its own, scanned and mapped with errors that are known."""

import numpy as np

from omsm_ros.core.comparison.stated_errors import ComparedMeasurement
from omsm_ros.core.surface.measured_points import MeasuredPoints

RADIUS = 5e-3


def form(x, y):
    """Coma, trefoil and a rim: it has no symmetry, so a shift and a turn of it show."""
    u, v = x / RADIUS, y / RADIUS
    return 200e-9 * (3 * u * (u**2 + v**2) - 2 * u) + 90e-9 * (u**3 - 3 * u * v**2) + 3e-6 * u * v


def astigmatism(x, y, size=20e-9):
    return size * ((x / RADIUS) ** 2 - (y / RADIUS) ** 2)


def spiral(feed, rpm, period=4e-3):
    """Places of a scan from rim to centre."""
    time = np.arange(0, RADIUS / feed * 60 / rpm, period)
    angle = 2 * np.pi * rpm / 60 * time
    radius = RADIUS - feed * angle / (2 * np.pi)
    return radius * np.cos(angle), radius * np.sin(angle), time


def scan(seed, feed=1.5e-4, rpm=30, added=None, walk=0.0, noise=10e-9, stated=None, name="scan",
         **known):  # fmt: skip
    """A scan with noise and, over its time, a drift: a random walk of ``walk`` [m/√s]."""
    random = np.random.default_rng(seed)
    x, y, time = spiral(feed, rpm)
    steps = random.normal(0, walk * np.sqrt(time[1]), len(time))
    height = form(x, y) + np.cumsum(steps) + random.normal(0, noise, len(time))
    if added is not None:
        height += added(x, y)
    points = MeasuredPoints(
        x=x,
        y=y,
        height=height,
        uncertainty=None if stated is None else np.full(len(x), stated),
        sample=np.arange(len(x)),
    )
    return ComparedMeasurement(name=name, points=points, **known)


def mapped(shift=(0.0, 0.0), turn=0.0, noise=0.5e-9, stated=None, seed=9, side=81, added=None,
           **known):  # fmt: skip
    """A map all at once, of the part moved by ``shift`` [m] and turned by ``turn`` [rad]."""
    random = np.random.default_rng(seed)
    at = np.linspace(-RADIUS, RADIUS, side)
    x, y = (part.ravel() for part in np.meshgrid(at, at))
    inside = np.hypot(x, y) < 0.97 * RADIUS
    x, y = x[inside], y[inside]
    dx, dy = x - shift[0], y - shift[1]
    u, v = dx * np.cos(turn) + dy * np.sin(turn), -dx * np.sin(turn) + dy * np.cos(turn)
    height = form(u, v) + random.normal(0, noise, len(x))
    if added is not None:
        height += added(u, v)
    spread = None if stated is None else np.full(len(x), stated)
    points = MeasuredPoints(x=x, y=y, height=height, uncertainty=spread)
    return ComparedMeasurement(name="map", points=points, **known)
