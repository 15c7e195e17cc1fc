"""The terms of ISO 10110-5 for the form of an optic, from its deviation along the normal."""

from __future__ import annotations

import numpy as np

from omsm_ros.core.form.figures import DeviationMap, Figure
from omsm_ros.core.form.part_figures import extents_of_part, rms_of_part
from omsm_ros.core.form.removal import asymmetric, without_power
from omsm_ros.core.form.zernike_fit import ZernikeFit
from omsm_ros.core.surface.zernike_terms import Term


def optical_terms(map_: DeviationMap, fit: ZernikeFit) -> dict[str, Figure]:
    """Return sagitta deviation (A), irregularity (B), their rms (RMSi, RMSa), each [m].

    A is the extent of the power over the disc, twice its Zernike coefficient; B the extent of what
    is left without it, over 99.5 % of the area; RMSi its rms, and RMSa that of the part of it that
    is not the same all around. Deviations of the surface, not of a wave that is reflected by it.
    """
    irregular, uneven = without_power(map_, fit.disc), asymmetric(map_, fit.disc)
    return {
        "iso10110_A": _sagitta(fit),
        "iso10110_B": extents_of_part(irregular, fit.disc)[1],
        "iso10110_RMSi": rms_of_part(irregular),
        "iso10110_RMSa": rms_of_part(uneven),
    }


def _sagitta(fit: ZernikeFit) -> Figure:
    if Term(2, 0) not in fit.terms:
        return Figure(None, None)
    place = fit.terms.index(Term(2, 0))
    value, spread = fit.coefficients[place], fit.uncertainty[place]
    return Figure(float(2 * np.abs(value)), float(2 * spread))
