"""From a cloud and a nominal surface to ``form.json``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from omsm_ros.core.form.analyse import Form
from omsm_ros.core.form.conformity import conformity
from omsm_ros.core.machine.surface_height import Surface
from omsm_ros.core.registration.freedoms import MOVES
from omsm_ros.core.registration.placement import FREEDOMS, Aperture
from omsm_ros.core.surface.deviation import unlike
from omsm_ros.jobs.measured_portions import Measurement
from omsm_ros.storage.files import (
    CLOUD,
    CURVES,
    DEVIATION,
    FORM,
    SUMMARY,
    save_json,
)
from omsm_ros.storage.maps.vertex_file import write_ply
from omsm_ros.storage.summary_file import read_summary

# Of the areal density each way: a picture of it, in 70 kB.
_MOST_BLOCKS = 64
_NO_SYSTEMATIC = "systematic errors of the measurement: only noise, form and pose are in here"


def judge_form(
    measured: Measurement,
    surface: Surface,
    out: Path,
    asked: Sequence[str],
    aperture: Aperture | None = None,
    filters: tuple[float | None, float | None] = (None, None),
    tolerance: float | None = None,
) -> dict[str, Any]:
    """Register a measurement to its nominal ``surface``; return what ``form.json`` says of it.

    Writes into ``out`` form.json, curves.json (profiles and power spectral densities) and
    deviation.ply: deviation along the normal over the part's x and y.

    asked: freedoms of the fit, or "auto";  aperture: of the part, None for all points
    filters: wavelengths of the S- and the L-filter [m], None for what the points allow
    tolerance: of the peak to valley of 99.5 % [m], if there is one

    Raises DataError for points that do not fit, or do not determine a freedom that was asked for.
    """
    form = measured.form(surface, asked, aperture, filters)
    facts = form_facts(form, measured, surface)
    if tolerance is not None:
        found = conformity(form.deviation["robust_peak_to_valley"], tolerance)
        facts["conformity"] = found.entry() if found else None
    save_json(out / FORM, facts)
    save_json(out / CURVES, _curves(form))
    write_ply(out / DEVIATION, _deviations(form))
    return facts


def draw_form(measured: Path, out: Path) -> None:
    """Write the page of a form that :func:`judge_form` has left in ``out``.

    measured: what it is of; what a summary beside it says of the measurement is on the page
    """
    # Here, because drawing takes longer to load than many a form to judge.
    from omsm_ros.jobs.publish import publish_form

    folder = measured if measured.is_dir() else measured.parent
    beside = folder / SUMMARY if measured.is_dir() or measured.name == CLOUD else None
    summary = read_summary(beside) if beside and beside.is_file() else None
    publish_form(out, f"Form of {measured.resolve().name}", summary)


def _deviations(form: Form) -> np.ndarray[Any, np.dtype[np.void]]:
    table = np.empty(len(form.map), [(name, "<f8") for name in "xyz"])
    table["x"], table["y"], table["z"] = form.map.x, form.map.y, form.map.deviation
    return table


def form_facts(form: Form, measured: Measurement, nominal: Surface) -> dict[str, Any]:
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
            "held": dict(found.freedoms.held),
            "pose_uncertainty": {
                source: dict(zip(found.freedoms.fitted, map(float, shares), strict=True))
                for source, shares in found.from_source.items()
            },
            "not_evaluated": [] if measured.systematic else [_NO_SYSTEMATIC],
            "notes": [
                *measured.notes,
                *_unlike(form, nominal),
                *_advice(form),
            ],
        },
        "aperture": {
            "radius": form.aperture.radius,
            "x": form.aperture.x,
            "y": form.aperture.y,
            "s_filter": form.bands.s_filter,
            "l_filter": form.bands.l_filter,
            "bands": {name: list(ends) for name, ends in form.bands.rms_bands.items()},
            "zernike": "each term is 1 at the rim; cos for m >= 0, sin for m < 0, from x to y",
        },
        "points": _counts(form, measured.missing),
    }


def _unlike(form: Form, nominal: Surface) -> list[str]:
    x, y = form.map.x, form.map.y
    return unlike(x, y, nominal.height(x, y) + form.map.deviation, nominal)


def _counts(form: Form, missing: int) -> dict[str, int]:
    """Return every point by what became of it, and those that never had a height."""
    added = {name: form.counts[name] + missing for name in ("read", "not_finite")}
    return form.counts | added


def _advice(form: Form) -> list[str]:
    """Return what would say more, where a move leaves less of the form than it is sure of."""
    freedoms, rms = form.registration.freedoms, form.deviation["rms"]
    fitted = [n for n in freedoms.fitted if n in MOVES]
    if rms.uncertainty is None or rms.value is None or rms.value >= 2 * rms.uncertainty:
        fitted = []
    advice = [
        f"a move along {' and '.join(fitted)} looks like form here, and was fitted, so that little "
        "is known of form that looks so; the figures of the best fit hold all the same; if the "
        "part was not moved since it was cut, hold it: --fit piston,tip,tilt"
    ] * bool(fitted)
    if freedoms.held:
        others = ",".join(n for n in freedoms.fitted if n not in freedoms.held)
        advice.append(
            f"{' and '.join(freedoms.held)} held as in the nominal pose, for form looks like a "
            "move there; how far the part may be off all the same is in every uncertainty but "
            "those of the best fit, which no move changes; if it "
            f"is known to sit within a micrometre, name what to fit: --fit {others}"
        )
    return advice


def _curves(form: Form) -> dict[str, Any]:
    density = form.density
    x, y, areal = density.coarse(_MOST_BLOCKS)
    return {
        "profiles": {name: curve.entry() for name, curve in form.profiles.items()},
        "psd": {
            "radial": density.radial.entry(),
            "azimuthal": density.azimuthal.entry(),
            "areal": {"x": x.tolist(), "y": y.tolist(), "value": areal.tolist()},
            "mean_square": density.mean_square,
            "band": list(density.band),
            "mean_square_in_band": density.mean_square_in_band,
            "normalisation": "two-sided areal density [m^4] over frequency [1/m], in blocks; its "
            "sum times the area of a block, and the integral of that over direction [m^2/rad], are "
            "mean_square [m^2]; the integral of 2 pi f times the radial one is that in the band",
        },
    }


def _terms(form: Form) -> list[dict[str, Any]]:
    fit = form.zernike
    known = [
        {"n": t.n, "m": t.m, "value": float(value), "uncertainty": float(spread)}
        for t, value, spread in zip(fit.terms, fit.coefficients, fit.uncertainty, strict=True)
    ]
    return known + [{"n": t.n, "m": t.m, "value": None, "uncertainty": None} for t in fit.left_out]
