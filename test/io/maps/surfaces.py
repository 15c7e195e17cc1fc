"""A surface that is not symmetric in anything, so that no axis can be mistaken for another."""

import numpy as np

from omsm_ros.core.surface.height_grid import HeightGrid
from omsm_ros.core.surface.measured_points import MeasuredPoints


def height(x, y):
    """Some tens of nanometres over some millimetres."""
    return 3e-6 * x + 1e-3 * x**2 + 2e-3 * x * y - 7e-6 * y + 20e-9 * np.sin(900 * x)


def grid(rows=7, columns=9, dx=0.5e-3, dy=0.25e-3, hole=True):
    x0, y0 = -1.1e-3, 0.4e-3
    x, y = np.meshgrid(x0 + dx * np.arange(columns), y0 + dy * np.arange(rows))
    z = height(x, y)
    if hole:
        z[2, 3] = np.nan
    return HeightGrid(height=z, x0=x0, y0=y0, dx=dx, dy=dy)


def scattered(count=5000, radius=5e-3, seed=0, spread=None):
    rng = np.random.default_rng(seed)
    r, a = radius * np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    x, y = r * np.cos(a), r * np.sin(a)
    return MeasuredPoints(
        x=x,
        y=y,
        height=height(x, y),
        uncertainty=None if spread is None else np.full(count, spread),
        sample=np.arange(count),
    )


def by_place(points):
    """Heights in an order that does not depend on the file."""
    order = np.lexsort((np.round(points.x, 9), np.round(points.y, 9)))
    return np.column_stack([points.x, points.y, points.height])[order]
