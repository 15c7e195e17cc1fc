"""From a cloud and a nominal surface to ``form.json``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from omsm_ros.core.form.analyse import Form, analyse_form
from omsm_ros.core.machine.surface_height import Surface
from omsm_ros.core.surface.placement import FREEDOMS, Aperture, Portion
from omsm_ros.errors import FileError
from omsm_ros.storage.cloud_file import CloudFile
from omsm_ros.storage.files import CLOUD

FORM = "form.json"
_PORTION = 131_072


def cloud_in(path: Path) -> Path:
    """Return the cloud that ``path`` is, or that lies in this folder of results."""
    cloud = path / CLOUD if path.is_dir() else path
    if not cloud.is_file():
        raise FileError(f"no cloud at {str(cloud)!r}; give one, or the folder of a measurement")
    return cloud


def judge_form(
    cloud: Path, surface: Surface, asked: Sequence[str], aperture: Aperture | None = None
) -> Form:
    """Register a cloud to its nominal ``surface`` and judge its form, in bounded memory.

    asked: freedoms of the fit, or "auto";  aperture: of the part, None for all points

    Raises DataError for points that do not fit, or do not determine a freedom that was asked for.
    """
    opened = CloudFile(cloud)

    def portions() -> Iterator[Portion]:
        for rows in opened.portions(_PORTION):
            x, y, height = (rows[name].astype(np.float64) for name in ("x", "y", "height"))
            yield Portion(x, y, height, np.empty((0, len(x))))

    return analyse_form(surface, portions, asked, aperture=aperture)


def form_facts(form: Form) -> dict[str, Any]:
    """Return the content of ``form.json``; lengths in metres, angles in radians."""
    found = form.registration
    placement = found.placement
    return {
        "pose": {
            name: {"value": placement.value(name), "uncertainty": found.uncertainty(name)}
            for name in FREEDOMS
        },
        "deviation": {name: figure.entry() for name, figure in form.deviation.items()},
        "zernike": _terms(form),
        "removed": {
            "fitted": list(found.freedoms.fitted),
            "not_determined": dict(found.freedoms.refused),
            "pose_uncertainty": {
                source: dict(zip(found.freedoms.fitted, map(float, shares), strict=True))
                for source, shares in found.from_source.items()
            },
            "not_evaluated": ["systematic sources of uncertainty"],
        },
        "aperture": {
            "radius": form.aperture.radius,
            "x": form.aperture.x,
            "y": form.aperture.y,
            "zernike": "each term is 1 at the rim; cos for m >= 0, sin for m < 0, from x to y",
        },
        "points": form.counts,
    }


def _terms(form: Form) -> list[dict[str, Any]]:
    fit = form.zernike
    known = [
        {"n": t.n, "m": t.m, "value": float(value), "uncertainty": float(spread)}
        for t, value, spread in zip(fit.terms, fit.coefficients, fit.uncertainty, strict=True)
    ]
    return known + [{"n": t.n, "m": t.m, "value": None, "uncertainty": None} for t in fit.left_out]
