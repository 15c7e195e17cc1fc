"""Common style of all figures, with colours for all colour vision, without global state."""

import io
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import XAxis, YAxis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import printable

# Blue and vermillion of Okabe and Ito differ in hue and lightness for all colour vision.
BEFORE = "#D55E00"
AFTER = "#0072B2"
TRUTH = "#1F2933"
INK = "#1F2933"
MUTED = "#66727F"
FAINT = "#D9DEE3"
MISSING = "#ECEFF2"
# Diverging about zero, its middle unlike the grey of missing pixels, for all colour vision.
MAP_COLOURS = "RdYlBu_r"

# Margins of the axes [inch]: a layout computed for each figure would take longer than drawing.
_LEFT_IN, _RIGHT_IN, _BOTTOM_IN, _TOP_IN = 0.78, 0.14, 0.46, 0.34
_BETWEEN_ROWS_IN, _BETWEEN_SHARED_ROWS_IN = 0.78, 0.32
_NAME_LEFT_OF_AXES_IN = 0.58

TEXT_PT = 8.5
TITLE_PT = 10.0
FIGURE_DPI = 180
# Level 3 takes half the time of the default 6, and files are a tenth larger.
FAST_PNG = {"compress_level": 3}


def empty(width: float, height: float) -> Figure:
    """Return a figure of ``width`` × ``height`` [inch] without a window."""
    made = Figure(figsize=(width, height), facecolor="white")
    FigureCanvasAgg(made)
    return made


def figure(width: float, height: float, rows: int = 1, **options: Any) -> tuple[Figure, list[Axes]]:
    """Return a figure of ``width`` × ``height`` [inch] and its axes, one below the other.

    options: of matplotlib's ``subplots``, such as ``sharex`` and ``height_ratios``
    """
    made = empty(width, height)
    between = _BETWEEN_SHARED_ROWS_IN if options.get("sharex") else _BETWEEN_ROWS_IN
    high = (height - _BOTTOM_IN - _TOP_IN - (rows - 1) * between) / rows
    axes_width = width - _LEFT_IN - _RIGHT_IN
    places = {
        "left": _LEFT_IN / width, "right": 1 - _RIGHT_IN / width, "hspace": between / high,
        "bottom": _BOTTOM_IN / height, "top": 1 - _TOP_IN / height,
    }  # fmt: skip
    axes = [*made.subplots(rows, squeeze=False, gridspec_kw=places, **options)[:, 0]]
    for one in axes:
        quiet(one)
        one.yaxis.set_label_coords(-_NAME_LEFT_OF_AXES_IN / axes_width, 0.5)
    return made, axes


def quiet(axes: Axes) -> None:
    """Make axes thin and grey, with a faint grid behind the data."""
    axes.tick_params(labelsize=TEXT_PT, colors=MUTED, labelcolor=INK, length=3, width=0.7)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(MUTED)
        spine.set_linewidth(0.7)
    # No common offset, and a common factor left of the title, which it would cover.
    axes.ticklabel_format(axis="y", useOffset=False)
    axes.yaxis.get_offset_text().set(horizontalalignment="right", fontsize=TEXT_PT)
    axes.grid(True, color=FAINT, linewidth=0.6)
    axes.set_axisbelow(True)


def logarithmic(axis: XAxis | YAxis, *, every: Sequence[float] = (1.0,)) -> None:
    """Make an axis logarithmic, with numbers 0.1, 1, 10.

    every: multiples of each power of ten that get a tick and a number

    Numbers such as 10⁻¹ would need matplotlib's mathtext, which takes longer to load than the
    figure to draw.
    """
    scale = axis.axes.set_xscale if isinstance(axis, XAxis) else axis.axes.set_yscale
    scale("log", nonpositive="clip")
    axis.set_major_locator(LogLocator(subs=every))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())


def label(axes: Axes, *, x: str = "", y: str = "", title: str = "") -> None:
    """Label the axes, with their units, and put a title on the left; what is empty stays."""
    if x:
        axes.set_xlabel(x, fontsize=TEXT_PT, color=INK)
    if y:
        axes.set_ylabel(y, fontsize=TEXT_PT, color=INK)
    if title:
        # With a stated place nothing is measured to find one.
        look = {"fontsize": TITLE_PT, "color": INK, "fontweight": "bold"}
        axes.set_title(title, loc="left", y=1.0, pad=6.0, **look)


def legend_above(axes: Axes) -> None:
    """Put a legend on the line of the title, where it covers no data."""
    entries = len(axes.get_legend_handles_labels()[0])
    legend(axes, loc="lower right", bbox_to_anchor=(1.0, 0.99), ncols=entries, columnspacing=1.4)


def legend(axes: Axes, **options: Any) -> None:
    """Put a legend without a frame around it."""
    look: dict[str, Any] = {
        "fontsize": TEXT_PT, "labelcolor": INK, "framealpha": 0.85, "edgecolor": "none",
        "handlelength": 1.8, "borderpad": 0.2,
    }  # fmt: skip
    axes.legend(**look, **options)


Envelope = tuple[FloatArray, FloatArray, FloatArray]


def envelope(time: FloatArray, value: FloatArray, columns: int = 900) -> Envelope:
    """Return time, least and largest value of each of ``columns`` stretches: no spike is lost."""
    cuts = np.linspace(0, len(value), min(columns, len(value)), endpoint=False)
    starts = np.unique(cuts.astype(np.int64))
    return time[starts], np.minimum.reduceat(value, starts), np.maximum.reduceat(value, starts)


def draw_envelope(
    axes: Axes, time: FloatArray, value: FloatArray, colour: str, **look: Any
) -> None:
    """Draw the values that are finite as their :func:`envelope` over ``time``."""
    known = np.isfinite(value)
    at, low, high = envelope(time[known], value[known])
    axes.fill_between(at, low, high, color=colour, **{"linewidth": 0.6, **look})
    axes.margins(x=0.01)


# Ratio of the ends of a logarithmic axis below which powers of ten alone are too few numbers.
_NARROW = 30.0


class Panel(NamedTuple):
    """One panel of a figure: curves (x, y) by name; ``log``: logarithmic axes, "", "x" or "xy"."""

    title: str
    x: str
    y: str
    curves: Mapping[str, tuple[FloatArray, FloatArray]]
    log: str = ""


def panels(*shown: Panel) -> Figure:
    """Draw panels one below the other."""
    made, axes = figure(9.2, 2.5 * len(shown) + 0.3, len(shown))
    for ax, panel in zip(axes, shown, strict=True):
        for (name, (x, y)), colour in zip(
            panel.curves.items(), (BEFORE, AFTER, TRUTH, MUTED), strict=False
        ):
            ax.plot(x, y, linewidth=0.8, color=colour, label=name)
        for k, name in enumerate(panel.log):
            values = np.concatenate([curve[k] for curve in panel.curves.values()])
            narrow = np.max(values) < _NARROW * np.min(values)
            axis = getattr(ax, f"{name}axis")
            logarithmic(axis, every=(1.0, 2.0, 5.0) if narrow else (1.0,))
        label(ax, x=panel.x, y=panel.y, title=panel.title)
        if len(panel.curves) > 1:
            legend_above(ax)
    return made


def named(name: str) -> str:
    """Return a name from outside as a figure can draw it: as it is written, no mathematics."""
    return printable(name).replace("$", r"\$")


def png(made: Figure, dpi: int = FIGURE_DPI) -> bytes:
    """Return the figure as a PNG file, the same bytes for the same figure."""
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        # Names may be in any script: what the font does not have is drawn as a box.
        warnings.filterwarnings("ignore", "Glyph .* missing from", UserWarning)
        made.savefig(
            buffer, format="png", dpi=dpi, metadata={"Software": None}, pil_kwargs=dict(FAST_PNG)
        )
    return buffer.getvalue()
