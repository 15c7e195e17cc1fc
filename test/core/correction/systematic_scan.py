"""A spiral over the paper's mirror as sensitivity fields see it, in closed form."""

from __future__ import annotations

import numpy as np

from omsm_ros.core.correction.systematic import ScanPoints
from omsm_ros.core.kinematics.kinematics import workpiece_xy
from omsm_ros.core.surface.nominal import PAPER_MIRROR

RADIUS, TURNS, OMEGA = 12.7e-3, 20.0, np.pi


def spiral_points(n: int = 3000) -> ScanPoints:
    """Twenty turns in 40 s from the rim to the centre; Z follows but for a swinging 20 µm."""
    time = np.linspace(0.0, TURNS * 2 * np.pi / OMEGA, n)
    c = OMEGA * time
    slide_x, slide_y = RADIUS * (1 - time / time[-1]), np.zeros(n)
    x, y = workpiece_xy(slide_x, slide_y, c)
    height = PAPER_MIRROR.height(x, y)
    distance = 20e-6 * np.sin(0.7 * time)
    z = height - distance
    points = ScanPoints(
        time=time, x=x, y=y, height=height, z=z, z_rate=np.gradient(z, time),
        b=np.zeros(n), c=c, distance=distance,
    )  # fmt: skip
    return points.with_slopes(PAPER_MIRROR)
