"""Where on the part do its terms lie, if points tell badly how it was turned or shifted?

A sphere may be moved along itself, and its form goes along: terms in the frame that was found are
those of the part in its own only as far as such a move changes them. The same holds for a part
whose pose is known to tenths of a millimetre.
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
    """Return the fit with what the open place of the part may do to its terms.

    Of each freedom that no points determine, and of each error of the pose beside what that does
    to the deviations. In the first order: the slope of the smooth form times how far its places
    would move.
    """
    few = map_.every(_MOST_POINTS)
    slopes = (
        fit.coefficients @ along / fit.disc.radius
        for along in zernike_slopes(*fit.disc.scaled(few.x, few.y), fit.terms)
    )
    moves = np.concatenate([found.displaced(few.x, few.y), found.glides(few.x, few.y)])
    changes = -np.einsum("rin,in->rn", moves, np.stack(list(slopes)))
    made = fit_zernikes(
        few.x, few.y, few.deviation, fit.terms, fit.disc, weights=few.area, effects=changes
    )
    if made.terms != fit.terms:
        return fit
    effects = made.effects
    effects[:, : fit.effects.shape[1]] += fit.effects
    return replace(fit, effects=effects)
