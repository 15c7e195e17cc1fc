"""Where on the part do its terms lie, if no points tell how it was turned or shifted along itself?

A sphere may be moved along itself, and its form goes along: terms in the frame that was found are
those of the part in its own only as far as such a move changes them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from omsm_ros.core.form.figures import DeviationMap
from omsm_ros.core.form.zernike_fit import ZernikeFit, fit_zernikes
from omsm_ros.core.registration.pose_budget import Registration
from omsm_ros.core.surface.zernike_terms import zernike_slopes

# Polynomials less one order, moved by millimetres: a hundred points for each term tell them.
_MOST_POINTS = 4_000


def with_open_place(fit: ZernikeFit, map_: DeviationMap, found: Registration) -> ZernikeFit:
    """Return the fit with what each freedom that no points determine may do to its terms.

    In the first order: the slope of the smooth form times how far its places would move.
    """
    if not found.dragged:
        return fit
    few = map_.every(_MOST_POINTS)
    along_x, along_y = (
        fit.coefficients @ slopes / fit.disc.radius
        for slopes in zernike_slopes(*fit.disc.scaled(few.x, few.y), fit.terms)
    )
    moves = found.glides(few.x, few.y)
    changes = -(moves[:, 0] * along_x + moves[:, 1] * along_y)
    made = fit_zernikes(
        few.x, few.y, few.deviation, fit.terms, fit.disc, weights=few.area, effects=changes
    )
    if made.terms != fit.terms:
        return fit
    return replace(fit, effects=np.concatenate([fit.effects, made.effects], axis=1))
