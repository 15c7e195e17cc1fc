"""The page of a running scan: one file, nothing fetched, drawn by the script of the maps."""

from __future__ import annotations

from importlib import resources

import matplotlib
import numpy as np

from omsm_ros.report.common import style
from omsm_ros.report.common.template import fill
from omsm_ros.report.maps.surface_map import policy_of, script

_COLOURS = 128


def render(title: str) -> str:
    """Return the page as HTML; it opens a socket to where it came from."""
    colours = matplotlib.colormaps[style.MAP_COLOURS](np.linspace(0, 1, _COLOURS))[:, :3]
    palette = "".join(f"{round(255 * part):02x}" for row in colours for part in row)
    folder = resources.files("omsm_ros.report") / "templates"
    drawing = script() + (folder / "live.js").read_text(encoding="utf-8")
    return fill(
        "live.html",
        title=title,
        script=drawing,
        script_policy=policy_of(drawing),
        palette=palette,
        missing=style.MISSING.lstrip("#"),
    )
