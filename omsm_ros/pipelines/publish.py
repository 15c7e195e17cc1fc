"""Write the report of a measurement or of a registered part."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.surface.deviation import RunningStatistics, deviation
from omsm_ros.errors import CalibrationError, ConfigurationError
from omsm_ros.io.files import CLOUD, CURVES, DEVIATION, FORM, REPORT, SUMMARY, save_text
from omsm_ros.io.maps.read_map import read_points
from omsm_ros.io.results import (
    MOST_DRAWN,
    CloudFile,
    read_curves,
    read_form,
    read_summary,
    summary_of_points,
)
from omsm_ros.readable import now_text, quantity
from omsm_ros.report import style
from omsm_ros.report.measurement.figures import (
    form_figures,
    levelled,
    registered_map,
    surface_figures,
    unit_for,
)
from omsm_ros.report.measurement.page import Report, render
from omsm_ros.report.measurement.surface_map import CloudView, EmbeddedMap, Layer, embedded
from omsm_ros.report.response_figures import HasResponse, bode


def view_of(cloud: NDArray[np.void], sample_period: float) -> CloudView | None:
    """Return the columns of a cloud for the figures; None if it has no points."""
    if not len(cloud):
        return None
    sample = cloud["sample"].astype(np.int64)
    names = ("x", "y", "height", "dynamic_error", "uncertainty")
    columns = {name: cloud[name].astype(np.float64) for name in names}
    return CloudView(time=(sample - sample[0]) * sample_period, **columns)


def map_of(view: CloudView | None, nominal: Surface | None, out: Path) -> EmbeddedMap | None:
    """Return the zoomable map, the deviation without the pose of the part first.

    This is the registered deviation if ``out`` has one, else that without piston and tilt.
    """
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
        seated, _ = levelled(view, nominal, tilt=False)
        corrected, raw = levelled(view, nominal)
        for name, away in (
            ("corrected", corrected),
            ("uncorrected", raw),
            ("corrected, tilt kept", seated),
        ):
            unit = unit_for(float(np.max(np.abs(away))))
            layers.append(Layer(name, view.x, view.y, away, unit))
    spread = Layer("uncertainty, k = 1", view.x, view.y, view.uncertainty, "nm", symmetric=False)
    return embedded([*layers, spread])


def publish_scan(
    out: Path,
    summary: Mapping[str, Any],
    calibration: Calibration,
    nominal: Surface | None,
    cloud: NDArray[np.void],
    title: str = "",
    true: HasResponse | None = None,
) -> None:
    """Write ``report.html`` of a corrected scan, with figures and map of its ``cloud``.

    title: empty for that in the settings, or the name of the bag
    true: response of the twin, None if unknown
    """
    named = (summary.get("settings") or {}).get("title")
    title = title or str(named or f"Surface of {Path(str(summary.get('bag', out))).name}")
    # Differs from the calibration's after an override; summaries of old versions lack it.
    period = summary.get("sample_period", calibration.sample_period)
    view = view_of(cloud, period)
    figures = surface_figures(view, nominal) if view is not None else {}
    figures["bode"] = style.png(bode(calibration, true, period))
    publish(out, title, summary, calibration, figures, map_of(view, nominal, out))


def publish(
    out: Path,
    title: str,
    summary: Mapping[str, Any],
    calibration: Calibration | None,
    figures: Mapping[str, bytes],
    surface: EmbeddedMap | None = None,
    origin: Mapping[str, Any] = MappingProxyType({}),
) -> None:
    """Write ``report.html`` into ``out``, with the content of ``form.json`` there, if any.

    surface: zoomable map;  origin: title block, default: that of the summary
    """
    form = read_form(out / FORM) if (out / FORM).is_file() else {}
    curves = read_curves(out / CURVES) if (out / CURVES).is_file() else {}
    if form:
        figures = {**figures, **form_figures(form, curves)}
        if (out / DEVIATION).is_file():
            part = read_points(out / DEVIATION)
            drawn = registered_map(part.x, part.y, part.height, form)
            figures["form_map"] = style.png(drawn)
    date = now_text()
    block = origin or summary.get("origin") or {}
    page = render(Report(title, date, summary, calibration, figures, form, curves, surface, block))
    save_text(out / REPORT, page)


def publish_form(
    measured: Path, out: Path, name: str, origin: Mapping[str, Any] = MappingProxyType({})
) -> None:
    """Write ``report.html`` of a registered part from its results in ``out``.

    measured: file or folder of the measurement; its summary, if any, is part of the report
    name: of the measurement, for the title
    origin: entries of the title block
    """
    part = read_points(out / DEVIATION)
    layer = Layer("registered deviation", part.x, part.y, part.height, "nm")
    summary = summary_of_points(measured) or {}
    # Figures and conformity of this page are those of the form.
    kept = {name: v for name, v in summary.items() if name not in ("figures", "conformity")}
    publish(out, f"Form of {name}", kept, None, {}, embedded([layer]), origin)


# Relative difference of the rms of evenly chosen points from that of the whole cloud.
_SAME_RMS = 0.05


def report_again(result: Path, calibration: Calibration, nominal: Surface | None = None) -> Path:
    """Write ``report.html`` into the folder ``result`` of ``omsm correct``; return its path.

    All numbers come from the summary in the folder, all maps from its cloud. Raises FileError for
    a folder without a measurement, CalibrationError for another calibration than that of the
    correction, ConfigurationError for another nominal surface, or none if there was one.
    """
    summary = read_summary(result / SUMMARY)
    used = summary.get("calibration")
    if used != calibration.id:
        raise CalibrationError(
            f"{str(result)!r} was corrected with calibration {str(used)[:12]!r}, not with "
            f"{calibration.id[:12]!r}; give the calibration of the correction"
        )
    if nominal is None and "deviation" in summary:
        raise ConfigurationError(
            f"{str(result)!r} was corrected with a nominal surface; give the same one (--nominal)"
        )
    cloud = CloudFile(result / CLOUD).read(MOST_DRAWN)
    if nominal is not None and "deviation" in summary and len(cloud):
        x, y, height = (cloud[name].astype(np.float64) for name in ("x", "y", "height"))
        found = RunningStatistics()
        found.add(x, y, deviation(x, y, height, nominal))
        here, rms = found.statistics().rms, summary["deviation"]["corrected"]["rms"]
        if abs(here - rms) > _SAME_RMS * max(here, rms):
            raise ConfigurationError(
                f"the cloud deviates by {quantity(here, 'm')} rms from this nominal surface, and "
                f"by {quantity(rms, 'm')} from that of the correction; give the same surface"
            )
    publish_scan(result, summary, calibration, nominal, cloud)
    return result / REPORT
