"""Figures of a measured surface: deviation maps, profiles, dynamic error.

Every function returns a matplotlib Figure; arguments are in SI units, labels state the unit drawn.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase
from matplotlib.image import AxesImage
from matplotlib.patches import Polygon
from matplotlib.ticker import MaxNLocator

from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.surface import deviation as form
from omsm_ros.core.surface.deviation import Profile
from omsm_ros.errors import ConfigurationError
from omsm_ros.report import style
from omsm_ros.report.measurement.surface_map import CloudView, Raster, rasterise
from omsm_ros.units import MICROMETRE_M, MILLIMETRE_M, NANOMETRE_M

UNITS_M = {"nm": NANOMETRE_M, "µm": MICROMETRE_M, "mm": MILLIMETRE_M}

Limits = tuple[float, float]

# Share of the pixels within the colour range, so that outliers do not set it.
_SHOWN_SHARE = 0.998
_BREAK_AT_GAPS = 4
# Length over width of a map that is still drawn to scale.
_NARROW = 5.0
# Left, bottom, width, height relative to the figure.
_MAP_PLACE = (0.125, 0.13, 0.66, 0.765)
_FULL_WIDTH = 6.1, 5.1
_BAR_PLACE = (0.815, 0.19, 0.026, 0.645)


def symmetric_limits(x: FloatArray, y: FloatArray, deviation: FloatArray) -> Limits:
    """Return the colour limits ±v [m] that hold all but 0.2 % of the pixels of a map."""
    return _symmetric(rasterise(x, y, deviation))


def _symmetric(raster: Raster) -> Limits:
    size = np.abs(raster.image[np.isfinite(raster.image)])
    bound = float(np.quantile(size, _SHOWN_SHARE)) or NANOMETRE_M
    return -bound, bound


def deviation_map(
    x: FloatArray,
    y: FloatArray,
    deviation: FloatArray,
    *,
    unit: str,
    title: str,
    limits: Limits | None = None,
    quantity: str = "deviation",
) -> Figure:
    """Draw a deviation or other ``quantity`` (n,) [m] over the workpiece as colours in ``unit``.

    unit: "nm", "µm" or "mm"
    limits: ends of the colour range [m], equal for maps that are compared;
        None: see :func:`symmetric_limits`
    """
    made = style.empty(4.0, 3.35)
    _draw_map(made, rasterise(x, y, deviation), unit, title, limits, quantity)
    return made


def registered_map(
    x: FloatArray, y: FloatArray, deviation: FloatArray, form: Mapping[str, Any]
) -> Figure:
    """Draw the deviation (n,) [m] of a registered part, points left out, and where none are.

    form: content of ``form.json``
    """
    made = style.empty(*_FULL_WIDTH)
    _draw_map(made, rasterise(x, y, deviation), "nm", "Registered deviation [nm]")
    axes = made.axes[0]
    if rim := (form.get("aperture") or {}).get("rim"):
        edge = np.array(rim) / MILLIMETRE_M
        # Below the image, whose pixels without a point are transparent.
        look: dict[str, Any] = {"fc": style.MISSING, "ec": style.MUTED, "hatch": "////"}
        axes.add_patch(Polygon(edge.T, zorder=-1, lw=0, **look))
        low, high = edge.min(axis=1), edge.max(axis=1)
        axes.set_xlim(low[0] - 0.01 * (high - low)[0], high[0] + 0.01 * (high - low)[0])
        axes.set_ylim(low[1] - 0.01 * (high - low)[1], high[1] + 0.01 * (high - low)[1])
    dust = form.get("left_out") or {}
    if "x" in dust:
        at = [np.array(dust[name], np.float64) / MILLIMETRE_M for name in "xy"]
        axes.plot(*at, "x", color=style.INK, markersize=4, markeredgewidth=0.8)
    return made


def _draw_map(
    part: FigureBase,
    raster: Raster,
    unit: str,
    title: str,
    limits: Limits | None = None,
    quantity: str = "deviation",
) -> None:
    scale = _unit(unit)
    # Fixed positions, so that maps side by side have equal size.
    axes, bar = part.add_axes(_MAP_PLACE), part.add_axes(_BAR_PLACE)
    style.quiet(axes)
    low, high = limits or _symmetric(raster)
    left, right, bottom, top = (edge / MILLIMETRE_M for edge in raster.extent)
    image = axes.imshow(
        raster.image / scale,
        origin="lower",
        extent=(left, right, bottom, top),
        cmap=style.MAP_COLOURS,
        vmin=low / scale,
        vmax=high / scale,
        interpolation="nearest",
    )
    if not 1 / _NARROW < (top - bottom) / (right - left) < _NARROW:
        axes.set_aspect("auto")  # a strip would be a line
        title = f"{title}, not to scale"
    axes.grid(False)
    for spine in axes.spines.values():
        spine.set_visible(False)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(5, integer=True))
    style.label(axes, x="x [mm]", y="y [mm]", title=title)
    _colour_bar(image, bar, _clipped(raster, low, high), f"{quantity} [{unit}]")


def _clipped(raster: Raster, low: float, high: float) -> str:
    below, above = np.nanmin(raster.image) < low, np.nanmax(raster.image) > high
    return {(0, 0): "neither", (1, 0): "min", (0, 1): "max"}.get((int(below), int(above)), "both")


def _colour_bar(image: AxesImage, place: Axes, extend: str, text: str) -> None:
    bar = place.figure.colorbar(image, cax=place, extend=extend, ticks=MaxNLocator(7))
    bar.outline.set_visible(False)
    place.tick_params(labelsize=style.TEXT_PT, colors=style.MUTED, labelcolor=style.INK, length=2)
    bar.set_label(text, fontsize=style.TEXT_PT, color=style.INK)


def profile(raw: Profile, corrected: Profile, *, title: str, position: str) -> Figure:
    """Draw one profile before and after the correction in µm, and below it that after in nm.

    position: name of the horizontal axis, drawn in mm
    """
    made, axes = style.figure(6.1, 3.6, rows=2, sharex=True)
    upper, lower = axes[:, 0]
    _draw_profile(upper, raw, MICROMETRE_M, color=style.BEFORE, label="uncorrected")
    _draw_profile(upper, corrected, MICROMETRE_M, color=style.AFTER, label="corrected")
    _draw_profile(lower, corrected, NANOMETRE_M, color=style.AFTER, label="corrected")
    style.legend_above(upper)
    style.label(upper, y="deviation [µm]", title=title)
    style.label(lower, x=f"{position} [mm]", y="deviation [nm]")
    return made


def _draw_profile(axes: Axes, drawn: Profile, scale: float, **look: Any) -> None:
    gap = np.diff(drawn.position, prepend=drawn.position[0])
    breaks = np.flatnonzero(gap > _BREAK_AT_GAPS * np.median(gap))
    position = np.insert(drawn.position, breaks, np.nan)
    value = np.insert(drawn.value, breaks, np.nan)
    axes.plot(position / MILLIMETRE_M, value / scale, linewidth=1.1, **look)


def dynamic_error(
    time: FloatArray, before: FloatArray, *, uncertainty: FloatArray | None = None
) -> Figure:
    """Draw the dynamic error over the scan in µm, and the uncertainty of a height below it in nm.

    time: [s];  before: [m];  uncertainty: standard, drawn as ±2u [m]; each (n,)
    """
    shown = uncertainty is not None
    made, axes = style.figure(6.1, 3.7 if shown else 2.2, rows=1 + shown, sharex=True)
    upper, lower = axes[0, 0], axes[-1, 0]
    _draw_envelope(upper, time, before, MICROMETRE_M, style.BEFORE)
    style.label(upper, y="before [µm]", title="Dynamic error over the scan")
    if uncertainty is not None:
        at, _, largest = style.envelope(time, uncertainty)
        bound = 2 * largest / NANOMETRE_M
        lower.fill_between(
            at, -bound, bound, color=style.AFTER, alpha=0.18, linewidth=0, label="±2u of a height"
        )
        style.legend_above(lower)
        style.label(lower, y="after [nm]")
    style.label(lower, x="time [s]")
    return made


def _draw_envelope(
    axes: Axes, time: FloatArray, value: FloatArray, scale: float, colour: str
) -> None:
    at, low, high = style.envelope(time, value)
    axes.fill_between(at, low / scale, high / scale, color=colour, linewidth=0.6)
    axes.axhline(0.0, color=style.MUTED, linewidth=0.6)
    axes.margins(x=0.01)


def _unit(name: str) -> float:
    if name not in UNITS_M:
        raise ConfigurationError(f"unit {name!r} of a map is unknown, expected one of {[*UNITS_M]}")
    return UNITS_M[name]


# Width of a profile's band relative to the aperture, and number of its segments across it.
_BAND_SHARE = 1 / 200
_SEGMENTS = 200


def surface_figures(cloud: CloudView, nominal: Surface | None) -> dict[str, bytes]:
    """Return PNG files of a cloud; without a nominal surface maps of height and error."""
    trace = dynamic_error(cloud.time, cloud.dynamic_error, uncertainty=cloud.uncertainty)
    made = {"dynamic_error": style.png(trace)}
    if nominal is None:
        return {**made, **_height_maps(cloud)}
    heights = {"raw": cloud.raw_height, "corrected": cloud.height}
    deviations = {name: levelled(cloud, h, nominal) for name, h in heights.items()}
    return {**made, **_maps(cloud, deviations), **_profiles(cloud, deviations)}


def levelled(cloud: CloudView, height: FloatArray, nominal: Surface) -> FloatArray:
    """Return ``height`` (n,) [m] minus the nominal surface, with zero mean over the area."""
    away = form.deviation(cloud.x, cloud.y, height, nominal)
    return form.level(cloud.x, cloud.y, away, weights=cloud.area)


def _height_maps(cloud: CloudView) -> dict[str, bytes]:
    height = cloud.height - cloud.height.min()
    look: dict[str, Any] = {"limits": (0.0, float(height.max()) or 1.0)}
    above = "above the lowest point"
    shown = {
        "height_map": (height, "Height [µm]", {**look, "quantity": above}),
        "error_map": (cloud.dynamic_error, "Dynamic error [µm]", {"quantity": "dynamic error"}),
    }
    return {
        name: style.png(deviation_map(cloud.x, cloud.y, v, unit="µm", title=title, **more))
        for name, (v, title, more) in shown.items()
    }


def _maps(cloud: CloudView, deviations: dict[str, FloatArray]) -> dict[str, bytes]:
    raw, corrected = deviations["raw"], deviations["corrected"]
    limits = symmetric_limits(cloud.x, cloud.y, raw)
    shown = {
        "raw_map": (raw, "µm", "Uncorrected [µm]", limits),
        "corrected_map_same_scale": (corrected, "µm", "Corrected, same scale [µm]", limits),
        "corrected_map": (corrected, "nm", "Corrected, enlarged [nm]", None),
    }
    return {
        name: style.png(deviation_map(cloud.x, cloud.y, v, unit=unit, title=title, limits=ends))
        for name, (v, unit, title, ends) in shown.items()
    }


_LINES = {
    "profile_x": (0.0, "Profile along x", "x"),
    "profile_y": (np.pi / 2, "Profile along y", "y"),
    "profile_diagonal": (np.pi / 4, "Profile at 45°", "distance along x = y"),
}


def _profiles(cloud: CloudView, deviations: dict[str, FloatArray]) -> dict[str, bytes]:
    x, y = cloud.x, cloud.y
    size = 2 * float(np.hypot(x, y).max())
    feed = _feed(cloud)
    # Segments of full turns average out the errors of other orders.
    spacing = feed * np.ceil(size / _SEGMENTS / feed) if feed else size / _SEGMENTS
    made = {}
    for name, (angle, title, position) in _LINES.items():
        cuts = {
            kind: form.line_profile(
                x, y, value, angle=angle,
                half_width=size * _BAND_SHARE / 2, spacing=spacing,
            )
            for kind, value in deviations.items()
        }  # fmt: skip
        if len(cuts["raw"].position):
            made[name] = _profile(cuts, title, position)
    rings = {
        kind: form.radial_profile(x, y, value, spacing=spacing)
        for kind, value in deviations.items()
    }
    if len(rings["raw"].position):
        made["profile_radius"] = _profile(rings, "Mean over each ring", "radius")
    return made


def _feed(cloud: CloudView) -> float:
    """Return the feed per turn of a spiral [m]; 0 for less than one turn."""
    turns = abs(np.ptp(np.unwrap(np.arctan2(cloud.y, cloud.x)))) / (2 * np.pi)
    return float(np.ptp(np.hypot(cloud.x, cloud.y)) / turns) if turns >= 1 else 0.0


def _profile(cuts: dict[str, form.Profile], title: str, position: str) -> bytes:
    return style.png(profile(cuts["raw"], cuts["corrected"], title=title, position=position))
