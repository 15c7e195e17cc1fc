"""The pose of least squares, from which the fit beside form begins."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from omsm_ros.core.machine.surface_height import Surface
from omsm_ros.core.registration.form_model import LEAST_LIMIT_M
from omsm_ros.core.registration.freedoms import widest
from omsm_ros.core.registration.placement import (
    LEAST_POINTS,
    Aperture,
    Placement,
    Portion,
    freedom_columns,
    placed,
    usable,
)
from omsm_ros.core.samples import scatter
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.errors import DataError

# With the refinement that follows it took 12 to 36 on spheres and off-axis paraboloids with form.
_MOST_TURNS = 30
# A pose stands when its last step moved no point by more than this share of their spread.
SHARE_OF_SPREAD, _SETTLED_M = 1e-2, 1e-10


def coarse_placement(
    surface: Surface,
    chosen: Portion,
    names: Sequence[str],
    aperture: Aperture | None,
    at: Placement,
) -> Placement:
    """Return the placement of least squares, points far from the others left out."""
    for turn in range(_MOST_TURNS):
        points = usable(placed(surface, at, chosen), aperture)
        if turn and len(points.x):
            middle = points.deviation - np.median(points.deviation)
            # Generous: what is left here is still the pose.
            points = points.part(np.abs(middle) <= max(8 * scatter.spread(middle), LEAST_LIMIT_M))
        if len(points.x) < LEAST_POINTS:
            break
        columns = -freedom_columns(at, points, names)
        scale = np.sqrt(np.mean(columns**2, axis=1))
        columns /= scale[:, np.newaxis]
        step = _bounded_step(
            columns,
            points.deviation,
            np.array([at.value(n) for n in names]) * scale,
            [widest(n) for n in names] * scale,
        )
        at = at.moved(names, step / scale)
        # The refinement that follows converges from far more.
        settled = max(SHARE_OF_SPREAD * scatter.spread(points.deviation), _SETTLED_M)
        # Of all freedoms together: what x does a tilt may undo.
        moved = float(np.sqrt(np.mean((step @ columns) ** 2)))
        if turn > 1 and moved < settled:
            return at
    raise DataError(
        "the points do not settle on the nominal surface; check its parameters, the sign of its "
        "radii and the units of the cloud, or fit fewer freedoms"
    )


def _bounded_step(
    columns: FloatArray, deviation: FloatArray, at: FloatArray, widest_: FloatArray
) -> FloatArray:
    """Return the step (p,) along ``columns`` (p, n) that explains ``deviation`` (n,) best.

    What no step explains, the form, is of one kind over the whole part, and says nothing of a
    freedom that does less than it: such a one stays within what a part may be off by.

    at: where the freedoms stand;  widest_: how far they may be off;  both (p,) as steps are
    """
    free = np.linalg.lstsq(columns.T, deviation, rcond=1e-12)[0]
    form = float(np.sqrt(np.mean((deviation - free @ columns) ** 2)))
    weight = np.sqrt(len(deviation)) * form / widest_
    rows = np.concatenate([columns.T, np.diag(weight)])
    found = np.linalg.lstsq(rows, np.concatenate([deviation, -weight * at]), rcond=1e-12)
    return np.asarray(found[0], np.float64)
