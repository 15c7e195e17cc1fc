"""Figures of a measured surface: maps, profiles, dynamic error; of a registered part: form.

Every function returns a matplotlib Figure; arguments are in SI units, labels state the unit drawn.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure, FigureBase
from matplotlib.patches import Polygon
from matplotlib.ticker import MaxNLocator

from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.surface import deviation as form
from omsm_ros.core.surface.deviation import Profile
from omsm_ros.report import style
from omsm_ros.report.measurement.surface_map import CloudView, Raster, rasterise
from omsm_ros.units import DEGREE_RAD, MICROMETRE_M, MILLIMETRE_M, NANOMETRE_M

UNITS_M = {"nm": NANOMETRE_M, "µm": MICROMETRE_M, "mm": MILLIMETRE_M}


def unit_for(largest: float) -> str:
    """Return the unit in which a deviation of ``largest`` [m] has few zeros."""
    return "nm" if largest < MICROMETRE_M else "µm"


Limits = tuple[float, float]

# Share of the pixels within the colour range, so that outliers do not set it.
_SHOWN_SHARE = 0.998
# Length over width of a map that is still drawn to scale.
_NARROW = 5.0
# Left, bottom, width, height relative to the figure.
_MAP_PLACE = (0.125, 0.13, 0.66, 0.765)
_FULL_WIDTH = 6.1, 5.1
_BAR_PLACE = (0.815, 0.19, 0.026, 0.645)


def symmetric_limits(raster: Raster) -> Limits:
    """Return the colour limits ±v [m] that hold all but 0.2 % of the pixels of a map."""
    size = np.abs(raster.image[np.isfinite(raster.image)])
    bound = float(np.quantile(size, _SHOWN_SHARE)) or NANOMETRE_M
    return -bound, bound


def deviation_map(
    x: FloatArray, y: FloatArray, deviation: FloatArray, *, unit: str, title: str,
    limits: Limits | None = None, quantity: str = "deviation",
) -> Figure:  # fmt: skip
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
    part: FigureBase, raster: Raster, unit: str, title: str, limits: Limits | None = None,
    quantity: str = "deviation",
) -> None:  # fmt: skip
    scale = UNITS_M[unit]
    # Fixed positions, so that maps side by side have equal size.
    axes, bar = part.add_axes(_MAP_PLACE), part.add_axes(_BAR_PLACE)
    style.quiet(axes)
    low, high = limits or symmetric_limits(raster)
    left, right, bottom, top = (edge / MILLIMETRE_M for edge in raster.extent)
    image = axes.imshow(
        raster.image / scale, origin="lower", extent=(left, right, bottom, top),
        cmap=style.MAP_COLOURS, vmin=low / scale, vmax=high / scale, interpolation="nearest",
    )  # fmt: skip
    if not 1 / _NARROW < (top - bottom) / (right - left) < _NARROW:
        axes.set_aspect("auto")  # a strip would be a line
        title = f"{title}, not to scale"
    axes.grid(False)
    for spine in axes.spines.values():
        spine.set_visible(False)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(5, integer=True))
    style.label(axes, x="x [mm]", y="y [mm]", title=title)
    below, above = np.nanmin(raster.image) < low, np.nanmax(raster.image) > high
    extend = {(0, 0): "neither", (1, 0): "min", (0, 1): "max"}.get((below, above), "both")
    scale_bar = axes.figure.colorbar(image, cax=bar, extend=extend, ticks=MaxNLocator(7))
    scale_bar.outline.set_visible(False)
    bar.tick_params(labelsize=style.TEXT_PT, colors=style.MUTED, labelcolor=style.INK, length=2)
    scale_bar.set_label(f"{quantity} [{unit}]", fontsize=style.TEXT_PT, color=style.INK)


def profile(
    above: Mapping[str, Profile], below: Profile, *, title: str, position: str, unit: str,
    height: str = "deviation", lower: tuple[str, str] = ("", style.AFTER),
    band: Profile | None = None,
) -> Figure:  # fmt: skip
    """Draw two profiles by their names in ``unit``, and below them another in nm.

    position, height: names of the axes, the horizontal one in mm
    lower: name and colour of the profile below;  band: its standard uncertainty, drawn as ±2u
    """
    made, (first, second) = style.figure(6.1, 3.6, rows=2, sharex=True)
    for (name, cut), colour in zip(above.items(), (style.BEFORE, style.AFTER), strict=True):
        _draw_profile(first, cut, UNITS_M[unit], color=colour, label=name)
    name, colour = lower
    _draw_profile(second, below, NANOMETRE_M, color=colour, label=name)
    if band is not None:
        bound = 2 * band.value / NANOMETRE_M
        second.fill_between(
            band.position / MILLIMETRE_M, -bound, bound, color=style.AFTER, alpha=0.18,
            linewidth=0, label="±U of a point, k = 2",
        )  # fmt: skip
    style.legend_above(first)
    if name:
        style.legend_above(second)
    style.label(first, y=f"{height} [{unit}]", title=title)
    style.label(second, x=f"{position} [mm]", y=f"{name or height} [nm]")
    return made


def _draw_profile(axes: Axes, drawn: Profile, scale: float, **look: Any) -> None:
    position, value = _with_gaps(drawn.position, drawn.value)
    axes.plot(position / MILLIMETRE_M, value / scale, linewidth=1.1, **look)


def _with_gaps(position: FloatArray, *values: FloatArray) -> list[FloatArray]:
    """Return positions and values with NaN where steps are far larger than the others.

    A line over places without points would show what nobody measured.
    """
    steps = np.diff(position)
    empty = np.flatnonzero(steps > _GAP * np.median(steps if len(steps) else 0.0)) + 1
    return [np.insert(v, empty, np.nan) for v in (position, *values)]


def dynamic_error(
    time: FloatArray, before: FloatArray, *, uncertainty: FloatArray | None = None
) -> Figure:
    """Draw the dynamic error over the scan, and the uncertainty of a height below it in nm.

    time: [s];  before: [m];  uncertainty: standard, drawn as ±2u [m]; each (n,)
    """
    shown = uncertainty is not None
    made, axes = style.figure(6.1, 3.7 if shown else 2.2, rows=1 + shown, sharex=True)
    upper, lower = axes[0], axes[-1]
    unit = unit_for(float(np.max(np.abs(before))))
    style.draw_envelope(upper, time, before / UNITS_M[unit], style.BEFORE)
    upper.axhline(0.0, color=style.MUTED, linewidth=0.6)
    style.label(upper, y=f"before [{unit}]", title="Dynamic error over the scan")
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


# Width of a profile's band relative to the aperture, and number of its segments across it.
_BAND_SHARE = 1 / 200
_SEGMENTS = 200


def surface_figures(cloud: CloudView, nominal: Surface | None) -> dict[str, bytes]:
    """Return PNG files of a cloud; without a nominal surface maps of height and error."""
    trace = dynamic_error(cloud.time, cloud.dynamic_error, uncertainty=cloud.uncertainty)
    made = {"dynamic_error": style.png(trace)}
    if nominal is None:
        height, error = cloud.height - cloud.height.min(), cloud.dynamic_error
        ends, above = (0.0, float(height.max()) or 1.0), "above the lowest point"
        maps: dict[str, tuple[Any, ...]] = {
            "height_map": (height, "µm", "Height", ends, above),
            "error_map": (error, "µm", "Dynamic error", None, "dynamic error"),
        }
    else:
        corrected, raw = levelled(cloud, nominal)
        made |= _profiles(cloud, {"raw": raw, "corrected": corrected})
        limits = symmetric_limits(rasterise(cloud.x, cloud.y, raw))
        unit = unit_for(limits[1])
        maps = {
            "raw_map": (raw, unit, "Uncorrected", limits, "deviation"),
            "corrected_map_same_scale":
                (corrected, unit, "Corrected, same scale", limits, "deviation"),
            "corrected_map": (corrected, "nm", "Corrected, enlarged", None, "deviation"),
        }  # fmt: skip
    for name, (values, unit, title, ends, quantity) in maps.items():
        look = {"unit": unit, "title": f"{title} [{unit}]", "limits": ends, "quantity": quantity}
        made[name] = style.png(deviation_map(cloud.x, cloud.y, values, **look))
    return made


def levelled(
    cloud: CloudView, nominal: Surface, *, tilt: bool = True
) -> tuple[FloatArray, FloatArray]:
    """Return corrected and uncorrected height minus the nominal surface, each (n,) [m].

    The mean over the area of each is zero. With ``tilt`` the tilt of the corrected points, the seat
    of the part on the machine, is removed from both, so that they differ by the dynamic error.
    """
    x, y = cloud.x, cloud.y
    away = form.deviation(x, y, cloud.height, nominal)
    corrected = form.level(x, y, away, tilt=tilt, weights=cloud.area)
    raw = form.level(x, y, corrected + cloud.dynamic_error, weights=cloud.area)
    return corrected, raw


_ANGLES = {"profile_x": 0.0, "profile_y": np.pi / 2, "profile_diagonal": np.pi / 4}
# Title, and name of the horizontal axis.
PROFILES = {
    "profile_x": ("Profile along x", "x"),
    "profile_y": ("Profile along y", "y"),
    "profile_diagonal": ("Profile at 45°", "distance along x = y"),
    "profile_radius": ("Mean over each ring", "radius"),
}


def _profiles(cloud: CloudView, deviations: dict[str, FloatArray]) -> dict[str, bytes]:
    made = {}
    for name, cut in profile_cuts(cloud, deviations).items():
        if len(cut["raw"].position):
            above = {"uncorrected": cut["raw"], "corrected": cut["corrected"]}
            unit = unit_for(float(np.max(np.abs(cut["raw"].value))))
            title, position = PROFILES[name]
            drawn = profile(above, cut["corrected"], title=title, position=position, unit=unit)
            made[name] = style.png(drawn)
    return made


def profile_cuts(
    cloud: CloudView, deviations: dict[str, FloatArray]
) -> dict[str, dict[str, Profile]]:
    """Return the profiles of each kind of deviation (n,) [m], by the names of the figures."""
    size = 2 * float(np.hypot(cloud.x, cloud.y).max())
    turns = abs(np.ptp(np.unwrap(np.arctan2(cloud.y, cloud.x)))) / (2 * np.pi)
    feed = float(np.ptp(np.hypot(cloud.x, cloud.y)) / turns) if turns >= 1 else 0.0
    # Segments of full turns average out the errors of other orders.
    spacing = feed * np.ceil(size / _SEGMENTS / feed) if feed else size / _SEGMENTS
    return cuts(cloud.x, cloud.y, deviations, size * _BAND_SHARE / 2, spacing, spacing)


def cuts(
    x: FloatArray, y: FloatArray, values: Mapping[str, FloatArray],
    half_width: float, spacing: float, rings: float,
) -> dict[str, dict[str, Profile]]:  # fmt: skip
    """Return profiles of ``values`` at x, y [m], each (n,), by the names of the figures.

    half_width, spacing: of the band along a line, and of its segments [m];  rings: width [m]
    """
    found = {
        name: {
            k: form.line_profile(x, y, v, angle=angle, half_width=half_width, spacing=spacing)
            for k, v in values.items()
        }
        for name, angle in _ANGLES.items()
    }
    radial = {k: form.radial_profile(x, y, v, spacing=rings) for k, v in values.items()}
    return {**found, "profile_radius": radial}


# Figures of a registered part, from the contents of ``form.json`` and ``curves.json``.

# Unit of spectral densities that is usual in optics: nm² mm² over 1/mm.
_AREAL_UNIT = NANOMETRE_M**2 * MILLIMETRE_M**2
# Densities below this share of the largest are numerical noise.
_LEAST_SHARE = 1e-9
# Lower end of an uncertainty band that reaches zero, relative to the least value, on a log axis.
_BELOW = 0.2
_WIDE, _HIGH = 6.1, 3.7
_BELOW_BARS = 0.2
_AREAL_PLACE, _AREAL_BAR_PLACE = (0.17, 0.125, 0.6, 0.78), (0.8, 0.125, 0.025, 0.78)
# Steps over the usual one that interrupt a curve.
_GAP = 4.0
# Unit and name of the horizontal axis, and title of each curve, by figure; the lines have one axis.
_LINE = (MILLIMETRE_M, "position on the line [mm]")
_CURVES = {
    "form_lines": {
        "x": (*_LINE, "Registered deviation along x"),
        "y": (*_LINE, "Registered deviation along y"),
        "diagonal": (*_LINE, "Registered deviation along x = y"),
    },
    "form_rings": {
        "radius": (MILLIMETRE_M, "radius [mm]", "Registered deviation over the radius"),
        "edge": (MILLIMETRE_M, "radius [mm]", "At the edge, outer tenth of the radius"),
        "angle": (DEGREE_RAD, "angle from x [°]", "Around, outer third of the radius"),
    },
}


def form_figures(form: Mapping[str, Any], curves: Mapping[str, Any]) -> dict[str, bytes]:
    """Return PNG files by the names of the page; parts that were not computed have none."""
    made = {"zernike_terms": zernike_terms(form["zernike"])}
    profiles: Mapping[str, Any] = curves.get("profiles") or {}
    for figure, kinds in _CURVES.items():
        if shown := [name for name in kinds if len(profiles.get(name, {}).get("position", ())) > 1]:
            drawn = [(profiles[name], kinds[name]) for name in shown]
            made[figure] = curve_panels(drawn, sharex=figure == "form_lines")
    if density := curves.get("psd"):
        made["psd_radial"] = radial_density(density["radial"])
        made["psd_direction"] = direction_density(density["azimuthal"])
        if "areal" in density:
            made["psd_areal"] = areal_density(density["areal"])
    return {name: style.png(figure) for name, figure in made.items()}


def zernike_terms(terms: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw ``terms``, each {n, m, value, uncertainty (k = 1)} [m], without piston and tilts."""
    shown = [t for t in terms if t["n"] > 1 and t["value"] is not None]
    made, (ax,) = style.figure(_WIDE, _HIGH)
    # Rotated numbers need more space below the axis.
    box = ax.get_position()
    ax.set_position((box.x0, _BELOW_BARS, box.width, box.y1 - _BELOW_BARS))
    values = np.array([t["value"] for t in shown]) / NANOMETRE_M
    spread = 2 * np.array([t["uncertainty"] or 0.0 for t in shown]) / NANOMETRE_M
    colours = np.where(np.abs(values) > spread, style.AFTER, style.FAINT)
    place = np.arange(len(shown))
    ax.bar(place, values, color=list(colours), width=0.75)
    ax.errorbar(place, values, spread, fmt="none", ecolor=style.INK, elinewidth=0.8, capsize=1.5)
    ax.axhline(0.0, color=style.MUTED, linewidth=0.6)
    ax.set_xticks(place, [f"{t['n']},{t['m']}" for t in shown], rotation=90)
    title = "Zernike terms of the deviation"
    style.label(ax, x="n,m", y="coefficient [nm]", title=title)
    return made


def curve_panels(
    curves: Sequence[tuple[Mapping[str, Any], tuple[float, str, str]]], *, sharex: bool
) -> Figure:
    """Draw deviations [nm] over their positions, with ±2u; one panel for each curve.

    curves: each with unit and name of its horizontal axis, and its title;  sharex: one axis for all
    """
    made, axes = style.figure(
        _WIDE, (1.4 if sharex else 1.7) * len(curves) + 0.4, rows=len(curves), sharex=sharex
    )
    for ax, (curve, (unit, along, title)) in zip(axes, curves, strict=True):
        _draw_curve(ax, curve, unit, NANOMETRE_M)
        named = {} if sharex and ax is not axes[-1] else {"x": along}
        style.label(ax, y="deviation [nm]", title=title, **named)
    return made


def radial_density(curve: Mapping[str, Any]) -> Figure:
    """Draw the density [nm² mm²] over radial frequency [1/mm], logarithmic, with ±2u."""
    made, (ax,) = style.figure(_WIDE, _HIGH)
    values = np.array(curve["value"], np.float64)
    least = float(np.min(values, where=values > 0, initial=np.max(values)))
    floor = max(_BELOW * least, _LEAST_SHARE * float(values.max()))
    _draw_curve(ax, curve, 1 / MILLIMETRE_M, _AREAL_UNIT, floor=floor)
    style.logarithmic(ax.xaxis, every=(1.0, 2.0, 5.0))
    style.logarithmic(ax.yaxis)
    title = "Power spectral density over frequency"
    style.label(ax, x="spatial frequency [1/mm]", y="density [nm² mm²]", title=title)
    return made


def direction_density(curve: Mapping[str, Any]) -> Figure:
    """Draw the mean square [nm²] per radian over the direction of waves [°], with ±2u."""
    made, (ax,) = style.figure(_WIDE, _HIGH)
    _draw_curve(ax, curve, DEGREE_RAD, NANOMETRE_M**2, floor=0.0)
    ax.set_xlim(0, 180)
    ax.set_xticks(range(0, 181, 30))
    title = "Power spectral density over direction"
    style.label(ax, x="direction from x [°]", y="mean square [nm²/rad]", title=title)
    return made


def areal_density(areal: Mapping[str, Any]) -> Figure:
    """Draw the areal density [nm² mm²] over both frequencies [1/mm], logarithmic colours."""
    x, y = (np.array(areal[name], np.float64) * MILLIMETRE_M for name in ("x", "y"))
    value = np.array(areal["value"], np.float64) / _AREAL_UNIT
    high = float(value.max()) or 1.0
    # The colour range covers nine tenths of the blocks.
    low = max(float(np.quantile(value, 0.1)), high * _LEAST_SHARE)
    made, (ax,) = style.figure(_WIDE, _HIGH)
    ax.grid(False)
    shown = ax.pcolormesh(
        x, y, np.maximum(value, low), norm=LogNorm(low, max(high, 2 * low)), cmap=style.MAP_COLOURS
    )
    ax.set_aspect("equal")
    ax.set_position(_AREAL_PLACE)
    bar = made.colorbar(shown, cax=made.add_axes(_AREAL_BAR_PLACE), format="%g")
    bar.minorticks_off()
    bar.ax.tick_params(labelsize=style.TEXT_PT)
    style.label(ax, x="f_x [1/mm]", y="f_y [1/mm]", title="Areal density [nm² mm²]")
    return made


def _draw_curve(
    axes: Axes, curve: Mapping[str, Any], along: float, unit: float, *, floor: float | None = None
) -> None:
    """Draw position, value and uncertainty (n,) of a curve in ``along`` and ``unit``, with ±2u.

    floor: lower limit of curve and band; None: they may be negative
    """
    position, value, spread = (
        np.array(curve[name], np.float64) for name in ("position", "value", "uncertainty")
    )
    low, high = (value - 2 * spread) / unit, (value + 2 * spread) / unit
    if floor is not None:
        low, value = np.maximum(low, floor / unit), np.where(value < floor, np.nan, value)
    place, low, value, high = _with_gaps(position / along, low, value, high)
    axes.fill_between(place, low, high, color=style.AFTER, alpha=0.25, linewidth=0)
    axes.plot(place, value / unit, color=style.AFTER, linewidth=1.0)
    axes.margins(x=0.01)
