"""The page of a finished measurement, or of a part that was registered."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.machine.surface_height import Surface
from omsm_ros.readable import moment
from omsm_ros.report.common import style
from omsm_ros.report.common.response_figures import bode
from omsm_ros.report.maps.surface_map import EmbeddedMap, Layer, embedded
from omsm_ros.report.measurement.cloud_view import CloudView
from omsm_ros.report.measurement.form_figures import form_figures
from omsm_ros.report.measurement.gallery import levelled, surface_figures
from omsm_ros.report.measurement.page import Report, render
from omsm_ros.storage.files import CURVES, DEVIATION, FORM, REPORT, save_text
from omsm_ros.storage.form_file import read_curves, read_form
from omsm_ros.storage.maps.read_map import read_points


def figures_of(
    view: CloudView | None,
    calibration: Calibration,
    nominal: Surface | None,
    sample_period: float,
) -> dict[str, bytes]:
    """Return PNG files for the page of a cloud whose truth nobody knows."""
    figures = surface_figures(view, nominal) if view is not None else {}
    return figures | {"bode": style.png(bode(calibration, None, sample_period))}


def view_of(cloud: NDArray[np.void], sample_period: float) -> CloudView | None:
    """Return the columns of a cloud for the figures; None if it has no points.

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


def map_of(view: CloudView | None, nominal: Surface | None, out: Path) -> EmbeddedMap | None:
    """Return the map that a reader can enlarge; of the registered deviation if ``out`` has one."""
    if view is None:
        return None
    layers = []
    if (out / DEVIATION).is_file():
        part = read_points(out / DEVIATION)
        layers.append(Layer("registered deviation", part.x, part.y, part.height, "nm"))
    if nominal is None:
        height = view.height - view.height.min()
        layers.append(Layer("height", view.x, view.y, height, "µm", symmetric=False))
    else:
        heights = {"corrected": (view.height, "nm"), "uncorrected": (view.raw_height, "µm")}
        for name, (height, unit) in heights.items():
            level = levelled(view, height, nominal)
            layers.append(Layer(f"{name}, piston removed", view.x, view.y, level, unit))
    spread = Layer("uncertainty, k = 1", view.x, view.y, view.uncertainty, "nm", symmetric=False)
    return embedded([*layers, spread])


def publish(
    out: Path,
    title: str,
    summary: Mapping[str, Any],
    calibration: Calibration | None,
    figures: Mapping[str, bytes],
    surface: EmbeddedMap | None = None,
) -> None:
    """Write ``report.html`` into ``out``; with what ``form.json`` there says of the part.

    surface: map that a reader can enlarge
    """
    form = read_form(out / FORM) if (out / FORM).is_file() else {}
    curves = read_curves(out / CURVES) if (out / CURVES).is_file() else {}
    if form:
        figures = {**figures, **form_figures(form, curves)}
    date = moment(datetime.now(timezone.utc))
    page = render(Report(title, date, summary, calibration, figures, form, curves, surface))
    save_text(out / REPORT, page)


def publish_form(out: Path, title: str, summary: Mapping[str, Any] | None = None) -> None:
    """Write ``report.html`` of a registered part, from what was written of it into ``out``.

    summary: of the measurement that its points are of, if there is one
    """
    part = read_points(out / DEVIATION)
    layer = Layer("registered deviation", part.x, part.y, part.height, "nm")
    publish(out, title, summary or {}, None, {}, embedded([layer]))
