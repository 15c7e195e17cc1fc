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
from omsm_ros.core.registration.placement import Aperture
from omsm_ros.core.samples.blocks import FloatArray
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
    return {
        "iso10110_A": _sagitta(map_, fit),
        "iso10110_B": extents_of_part(irregular, fit.disc)[1],
        "iso10110_C": extents_of_part(_symmetric(map_, fit.disc), fit.disc)[1],
        "iso10110_RMSt": rms_of_part(without_tilt(map_, fit.disc)),
        "iso10110_RMSi": rms_of_part(irregular),
        "iso10110_RMSa": rms_of_part(uneven),
    }


def _symmetric(map_: DeviationMap, disc: Aperture) -> DeviationMap:
    """Return the part of the irregularity that is the same all around.

    It has no noise of single points: what they do to its few terms is in its effects.
    """
    of_noise = replace(map_, effects=np.concatenate([map_.effects, _shaken(map_, disc)]), noise=0.0)
    irregular, uneven = without_power(of_noise, disc), asymmetric(of_noise, disc)
    return replace(
        irregular,
        deviation=irregular.deviation - uneven.deviation,
        effects=irregular.effects - uneven.effects,
    )


def _shaken(map_: DeviationMap, disc: Aperture) -> FloatArray:
    """Return independent effects (k, n) [m] of the noise of points on the symmetric terms."""
    columns = zernike_values(*disc.scaled(map_.x, map_.y), SYMMETRIC)
    weighted = columns * map_.area
    solve = np.linalg.pinv(weighted @ columns.T, rcond=1e-12, hermitian=True)
    covariance = map_.noise**2 * solve @ (weighted @ weighted.T) @ solve
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))).T @ columns, np.float64)


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
    # Of heights that are metres off, rounding is all that is left of it.
    uncertainty = float(2 * np.sqrt(variance)) if variance >= 0 else None
    return Figure(float(2 * np.abs(shares @ fit.coefficients)), uncertainty)
