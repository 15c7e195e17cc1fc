"""Figures of a registered part, from the contents of ``form.json`` and ``curves.json``."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.report import style
from omsm_ros.units import DEGREE_RAD, MILLIMETRE_M, NANOMETRE_M

# Unit of spectral densities that is usual in optics: nm² mm² over 1/mm.
_AREAL_UNIT = NANOMETRE_M**2 * MILLIMETRE_M**2
# Densities below this share of the largest are numerical noise.
_LEAST_SHARE = 1e-9
# Lower end of an uncertainty band that reaches zero, relative to the least value, on a log axis.
_BELOW = 0.2
_FULL_WIDTH, _HIGH = 6.1, 3.7
_BELOW_BARS = 0.2
_AREAL_PLACE, _BAR_PLACE = (0.17, 0.125, 0.6, 0.78), (0.8, 0.125, 0.025, 0.78)
# Positions of a curve that is drawn, and steps over the usual one that interrupt it.
_LEAST_DRAWN, _GAP = 2, 4.0
_LINES = {"x": "along x", "y": "along y", "diagonal": "along x = y"}


def form_figures(form: Mapping[str, Any], curves: Mapping[str, Any]) -> dict[str, bytes]:
    """Return PNG files by the names of the page; parts that were not computed have none."""
    made = {"zernike_terms": zernike_terms(form["zernike"])}
    profiles: Mapping[str, Any] = curves.get("profiles") or {}
    if lines := {name: profiles[name] for name in _LINES if _drawable(profiles.get(name))}:
        made["form_lines"] = line_profiles(lines)
    if rings := {
        name: profiles[name]
        for name in ("radius", "edge", "angle")
        if _drawable(profiles.get(name))
    }:
        made["form_rings"] = ring_profiles(rings)
    if density := curves.get("psd"):
        made["psd_radial"] = radial_density(density["radial"])
        made["psd_direction"] = direction_density(density["azimuthal"])
        if "areal" in density:
            made["psd_areal"] = areal_density(density["areal"])
    return {name: style.png(figure) for name, figure in made.items()}


def _drawable(curve: Mapping[str, Any] | None) -> bool:
    return curve is not None and len(curve["position"]) >= _LEAST_DRAWN


def zernike_terms(terms: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw ``terms``, each {n, m, value, uncertainty (k = 1)} [m], without piston and tilts."""
    shown = [t for t in terms if t["n"] > 1 and t["value"] is not None]
    made, axes = style.figure(_FULL_WIDTH, _HIGH)
    ax = axes[0, 0]
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


def line_profiles(lines: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Draw deviations [nm] over the position [mm] on each line, with ±2u; one panel per line."""
    made, axes = style.figure(_FULL_WIDTH, 1.9 * len(lines) + 0.4, rows=len(lines), sharex=True)
    for ax, (name, curve) in zip(axes[:, 0], lines.items(), strict=True):
        _draw(ax, curve, MILLIMETRE_M, NANOMETRE_M)
        style.label(ax, y="[nm]", title=f"Registered deviation {_LINES[name]}")
    style.label(axes[-1, 0], x="position on the line [mm]")
    return made


def ring_profiles(rings: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Draw deviations [nm] over the radius [mm], mean of each ring, and the angle [°], with ±2u."""
    made, axes = style.figure(_FULL_WIDTH, 2.7 * len(rings) + 0.4, rows=len(rings))
    kinds = {
        "radius": (MILLIMETRE_M, "radius [mm]", "Registered deviation over the radius"),
        "edge": (MILLIMETRE_M, "radius [mm]", "At the edge, outer tenth of the radius"),
        "angle": (DEGREE_RAD, "angle from x [°]", "Around, outer third of the radius"),
    }
    for ax, (name, curve) in zip(axes[:, 0], rings.items(), strict=True):
        unit, x, title = kinds[name]
        _draw(ax, curve, unit, NANOMETRE_M)
        style.label(ax, x=x, y="[nm]", title=title)
    return made


def radial_density(curve: Mapping[str, Any]) -> Figure:
    """Draw the density [nm² mm²] over radial frequency [1/mm], logarithmic, with ±2u."""
    made, axes = style.figure(_FULL_WIDTH, _HIGH)
    ax = axes[0, 0]
    values = np.array(curve["value"], np.float64)
    floor = max(_BELOW * float(values.min()), _LEAST_SHARE * float(values.max()))
    _draw(ax, curve, 1 / MILLIMETRE_M, _AREAL_UNIT, floor=floor)
    style.logarithmic(ax.xaxis, every=(1.0, 2.0, 5.0))
    style.logarithmic(ax.yaxis)
    style.label(
        ax,
        x="spatial frequency [1/mm]",
        y="density [nm² mm²]",
        title="Power spectral density over frequency",
    )
    return made


def direction_density(curve: Mapping[str, Any]) -> Figure:
    """Draw the mean square [nm²] per radian over the direction of waves [°], with ±2u."""
    made, axes = style.figure(_FULL_WIDTH, _HIGH)
    ax = axes[0, 0]
    _draw(ax, curve, DEGREE_RAD, NANOMETRE_M**2, floor=0.0)
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
    made, axes = style.figure(_FULL_WIDTH, _HIGH)
    ax = axes[0, 0]
    ax.grid(False)
    shown = ax.pcolormesh(
        x, y, np.maximum(value, low), norm=LogNorm(low, max(high, 2 * low)), cmap=style.MAP_COLOURS
    )
    ax.set_aspect("equal")
    ax.set_position(_AREAL_PLACE)
    bar = made.colorbar(shown, cax=made.add_axes(_BAR_PLACE))
    bar.ax.tick_params(labelsize=style.TEXT_PT)
    style.label(ax, x="f_x [1/mm]", y="f_y [1/mm]", title="Areal density [nm² mm²]")
    return made


def _draw(
    axes: Axes, curve: Mapping[str, Any], along: float, unit: float, *, floor: float | None = None
) -> None:
    """Draw a curve in units of ``along`` and ``unit`` with a band of ±2u.

    floor: lower limit of the band; None: it may be negative
    """
    position, value, spread = (
        np.array(curve[name], np.float64) for name in ("position", "value", "uncertainty")
    )
    low, high = (value - 2 * spread) / unit, (value + 2 * spread) / unit
    if floor is not None:
        low = np.maximum(low, floor / unit)
    # A line over places without points would show what nobody measured.
    gaps = np.diff(position)
    empty = np.flatnonzero(gaps > _GAP * np.median(gaps)) + 1
    place: FloatArray = np.insert(position / along, empty, np.nan)
    low, value, high = (np.insert(v, empty, np.nan) for v in (low, value, high))
    axes.fill_between(place, low, high, color=style.AFTER, alpha=0.25, linewidth=0)
    axes.plot(place, value / unit, color=style.AFTER, linewidth=1.0)
    axes.margins(x=0.01)
