"""The page of a finished measurement."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.machine.surface_height import Surface
from omsm_ros.report.common import style
from omsm_ros.report.common.response_figures import bode
from omsm_ros.report.measurement.cloud_view import CloudView
from omsm_ros.report.measurement.gallery import surface_figures
from omsm_ros.report.measurement.page import Report, render
from omsm_ros.storage.files import REPORT, save_text


def figures_of(
    cloud: NDArray[np.void],
    calibration: Calibration,
    nominal: Surface | None,
    sample_period: float,
) -> dict[str, bytes]:
    """PNG files for the page of a cloud whose truth nobody knows."""
    view = view_of(cloud, sample_period)
    figures = surface_figures(view, nominal) if view is not None else {}
    return figures | {"bode": style.png(bode(calibration, None, sample_period))}


def view_of(cloud: NDArray[np.void], sample_period: float) -> CloudView | None:
    """Columns of a cloud for the figures; None if it has no points.

    Without the dynamic correction its height would be ``raw_height``.
    """
    if not len(cloud):
        return None
    sample = cloud["sample"].astype(np.int64)
    error = cloud["dynamic_error"].astype(np.float64)
    return CloudView(
        time=(sample - sample[0]) * sample_period,
        x=cloud["x"].astype(np.float64),
        y=cloud["y"].astype(np.float64),
        height=cloud["height"].astype(np.float64),
        raw_height=cloud["height"] + error,
        dynamic_error=error,
        uncertainty=cloud["uncertainty"].astype(np.float64),
    )


def publish(
    out: Path,
    title: str,
    summary: Mapping[str, Any],
    calibration: Calibration,
    figures: Mapping[str, bytes],
) -> None:
    """Write ``report.html`` into ``out``."""
    date = datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC")
    page = render(Report(title, date, summary, calibration=calibration, figures=figures))
    save_text(out / REPORT, page)
