"""Does the record start while the machine still rings from an earlier motion?

The motion before the first sample is unknown, but its response since then is a sum of decays at
the poles of G. Fast ones are over before the first sample that counts. A lightly damped mode may
ring for a second, and a fit that takes its ringing for a response to the motion is biased.
"""

from __future__ import annotations

import numpy as np

from omsm_ros.core.fitting.output_error import Fit, Problem
from omsm_ros.least_squares import triangle

# χ² a column must explain to be taken: four sigma.
_CLEARLY_SHOWN = 16.0
# A decay by e to this power is over.
_OVER = 10.0
# Directions this much weaker than the strongest are rounding.
_SPANNED = 1e-6


def starts_ringing(
    problem: Problem, fitted: Fit, colour: float = 1.0, *, at_rest: bool = True
) -> bool:
    """Return whether decays at the poles of ``fitted`` reach into the samples that count.

    at_rest: the axis rests at the start; then the decays have to show clearly in the residual
    colour: power of the noise at low frequency over its mean, see ``information``
    """
    counted = np.flatnonzero(problem.used)
    if problem.fits_initial_condition or fitted.structure.poles == 0 or len(counted) == 0:
        return False
    first = float(counted[0]) * problem.period
    if float(np.min(-fitted.dynamics.poles().real)) * first > _OVER:
        return False
    if not at_rest:
        return True
    columns = problem.initial_condition_response(fitted)[problem.used]
    # The fit has already taken of a decay what the parameters of the model can imitate.
    known = problem.sensitivity(fitted)
    lengths = [np.sqrt(np.einsum("kq,kq->q", part, part)) for part in (columns, known)]
    scale = np.concatenate([*lengths, np.ones(1)])
    scale[scale == 0] = 1.0
    factor = triangle(columns, known, fitted.residual[:, np.newaxis]) / scale
    left, values, _ = np.linalg.svd(factor[:-1, :-1])
    spanned = left[:, values > _SPANNED * values[0]]
    explained = float(np.sum((spanned.T @ factor[:-1, -1]) ** 2))
    rest = fitted.sum_of_squares - explained
    size = spanned.shape[1] - known.shape[1]
    return bool(explained * fitted.samples > colour * _CLEARLY_SHOWN * max(size, 1) * rest)
