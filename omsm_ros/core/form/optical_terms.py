"""The terms of ISO 10110-5 for the form of an optic, from its deviation along the normal."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from omsm_ros.core.form.figures import DeviationMap, Figure
from omsm_ros.core.form.part_figures import extents_of_part, rms_of_part
from omsm_ros.core.form.removal import (
    POWER,
    SYMMETRIC,
    asymmetric,
    without_power,
    without_tilt,
)
from omsm_ros.core.form.zernike_fit import CHUNK, ZernikeFit
from omsm_ros.core.surface.zernike_terms import Term, zernike_values


def optical_terms(map_: DeviationMap, fit: ZernikeFit) -> dict[str, Figure]:
    """Return sagitta deviation (A), irregularity (B), its symmetric part (C), and rms, each [m].

    A is the extent over the disc of the power that fits best beside piston and tilts alone; B the
    extent of what is left without them, over 99.5 % of the area; C that of the part of it that is
    the same all around. RMSt is the rms without piston and tilts, RMSi without power too, and RMSa
    that of what is not the same all around. Deviations of the surface, not of a wave that is
    reflected by it.
    """
    irregular, uneven = without_power(map_, fit.disc), asymmetric(map_, fit.disc)
    symmetric = replace(
        irregular,
        deviation=irregular.deviation - uneven.deviation,
        effects=irregular.effects - uneven.effects,
        # A few terms of all points: what they leave of the noise of one is next to nothing.
        noise=map_.noise * float(np.sqrt(len(SYMMETRIC) / len(map_))),
    )
    return {
        "iso10110_A": _sagitta(map_, fit),
        "iso10110_B": extents_of_part(irregular, fit.disc)[1],
        "iso10110_C": extents_of_part(symmetric, fit.disc)[1],
        "iso10110_RMSt": rms_of_part(without_tilt(map_, fit.disc)),
        "iso10110_RMSi": rms_of_part(irregular),
        "iso10110_RMSa": rms_of_part(uneven),
    }


def _sagitta(map_: DeviationMap, fit: ZernikeFit) -> Figure:
    """Return twice the power that fits best beside piston and tilts, over the area.

    On a whole disc that is the term of the fit. On a strip or a ring the terms of a fit share what
    a sphere alone would take, and are extrapolated to where nobody measured. What the fit leaves
    has no power, so that a sum of its terms is the power with all that is uncertain of it.
    """
    if Term(2, 0) not in fit.terms:
        return Figure(None, None)
    places = [fit.terms.index(term) for term in POWER]
    gram, right = np.zeros((len(POWER), len(POWER))), np.zeros((len(POWER), len(fit.terms)))
    for begin in range(0, len(map_), CHUNK):
        chunk = slice(begin, begin + CHUNK)
        columns = zernike_values(*fit.disc.scaled(map_.x[chunk], map_.y[chunk]), fit.terms)
        chosen = columns[places] * map_.area[chunk]
        right += chosen @ columns.T
        gram += chosen @ columns[places].T
    shares = np.linalg.solve(gram, right)[POWER.index(Term(2, 0))]
    variance = shares @ fit.covariance @ shares + np.sum(np.square(shares @ fit.effects))
    return Figure(float(2 * np.abs(shares @ fit.coefficients)), float(2 * np.sqrt(variance)))
