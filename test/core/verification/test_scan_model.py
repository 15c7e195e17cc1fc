"""What cannot be fitted to is told before."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from omsm_ros.core.verification.scan_model import ScanModel
from omsm_ros.core.verification.scan_reader import ScanColumns
from omsm_ros.errors import DataError


def spiral(points: int = 2000) -> ScanColumns:
    time = np.arange(points) * 1e-3
    zero = np.zeros(points)
    return ScanColumns(
        time=time, radius=5e-3 - 1e-3 * time, angle=6.0 * time, radial_rate=np.full(points, -1e-3),
        angular_rate=np.full(points, 6.0), height=zero, motion_rate=zero,
        motion_acceleration=zero, motion=zero,
    )  # fmt: skip


def test_a_scan_whose_pace_is_not_known_is_refused() -> None:
    good = spiral()
    turns = ScanModel([good, good], 3).turns
    assert turns == pytest.approx([2 * 6.0 / (2 * np.pi)] * 2, rel=1e-3)
    lost = np.where(np.arange(2000) == 7, np.nan, good.angular_rate)
    with pytest.raises(DataError, match="pace of C"):
        ScanModel([good, replace(good, angular_rate=lost)], 3)
