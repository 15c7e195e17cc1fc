"""Figures of a comparison: profiles of both and of their difference, E_n of the terms."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from omsm_ros.core.comparison.agreement import COVERAGE_FACTOR, TermNumber
from omsm_ros.core.comparison.compare import Comparison
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.core.surface.deviation import Profile, line_profile, radial_profile
from omsm_ros.report.common import style
from omsm_ros.units import MICROMETRE_M, MILLIMETRE_M, NANOMETRE_M

# Of the aperture: the half width of a profile's band in places, and the places of a stretch.
_HALF_WIDTH_PLACES, _STRETCH_PLACES = 1.5, 1.5
_MOST_DIGITS = 5000
_LINES = {"profile_x": (0.0, "along x", "x"), "profile_y": (np.pi / 2, "along y", "y")}


def profiles(found: Comparison) -> dict[str, Figure]:
    """Draw the profiles along x and y through the middle, and the mean over rings, by name."""
    matched, agreement = found.matched, found.agreement
    side = matched.grid.dx
    x0, y0 = ((float(v.min()) + float(v.max())) / 2 for v in (matched.x, matched.y))
    x, y = matched.x - x0, matched.y - y0
    a, b = matched.without_fit(np.stack([matched.a, matched.b]))
    spread = None if agreement is None else agreement.uncertainty
    made = {}
    for name, (angle, title, position) in _LINES.items():

        def line(values: FloatArray, angle: float = angle) -> Profile:
            return line_profile(
                x, y, values, angle=angle,
                half_width=_HALF_WIDTH_PLACES * side, spacing=_STRETCH_PLACES * side,
            )  # fmt: skip

        cuts = [line(values) for values in (a, b, matched.difference)]
        band = None if spread is None else line(spread)
        if len(cuts[0].position):
            made[name] = _profile(cuts, band, f"Profile {title}", position)
    rings = [
        radial_profile(x, y, values, spacing=2 * side) for values in (a, b, matched.difference)
    ]
    if len(rings[0].position):
        made["profile_radius"] = _profile(rings, None, "Mean over each ring", "radius")
    return made


def _profile(cuts: Sequence[Profile], band: Profile | None, title: str, position: str) -> Figure:
    made, axes = style.figure(6.1, 3.6, rows=2, sharex=True)
    upper, lower = axes[:, 0]
    unit, name_of_unit = _unit(cuts[:2])
    for cut, colour, name in zip(cuts, (style.BEFORE, style.AFTER), "AB", strict=False):
        _line(upper, cut, unit, color=colour, label=name)
    _line(lower, cuts[2], NANOMETRE_M, color=style.TRUTH, label="A − B")
    if band is not None:
        bound = COVERAGE_FACTOR * band.value / NANOMETRE_M
        lower.fill_between(
            band.position / MILLIMETRE_M, -bound, bound, color=style.AFTER, alpha=0.18,
            linewidth=0, label="±U of a place, k = 2",
        )  # fmt: skip
    style.legend_above(upper)
    style.legend_above(lower)
    style.label(upper, y=f"height [{name_of_unit}]", title=title)
    style.label(lower, x=f"{position} [mm]", y="A − B [nm]")
    return made


def _unit(cuts: Sequence[Profile]) -> tuple[float, str]:
    """Return the unit in which their heights have no more than four digits, and its name."""
    largest = max(float(np.nanmax(np.abs(cut.value), initial=0.0)) for cut in cuts)
    units = ((NANOMETRE_M, "nm"), (MICROMETRE_M, "µm"), (MILLIMETRE_M, "mm"))
    return next((u for u in units if largest < _MOST_DIGITS * u[0]), units[-1])


def _line(axes: Axes, drawn: Profile, unit: float, **look: str) -> None:
    axes.plot(drawn.position / MILLIMETRE_M, drawn.value / unit, linewidth=1.1, **look)


def terms(numbers: Sequence[TermNumber]) -> Figure:
    """Draw E_n of the Zernike terms of the difference, the bounds at ±1."""
    made, axes = style.figure(6.1, 3.6)
    ax = axes[0, 0]
    values = np.array([term.e_n for term in numbers])
    colours = np.where(np.abs(values) > 1, style.BEFORE, style.AFTER)
    ax.bar(np.arange(len(values)), values, color=list(colours), width=0.75)
    for bound in (-1.0, 1.0):
        ax.axhline(bound, color=style.TRUTH, linewidth=0.9, linestyle=(0, (4, 2.5)))
    ax.axhline(0.0, color=style.MUTED, linewidth=0.6)
    names = [f"{term.n},{term.m}" for term in numbers]
    ax.set_xticks(np.arange(len(values)), names, rotation=90)
    reach = max(1.3, 1.1 * float(np.max(np.abs(values))))
    ax.set_ylim(-reach, reach)
    style.label(ax, x="n, m", y="E_n", title="Zernike terms of the difference")
    return made
