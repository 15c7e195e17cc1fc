"""Which points count at a pose."""

import numpy as np
import pytest

from omsm_ros.core.registration.placement import Placement, PointBatch, inside_aperture, placed
from omsm_ros.core.surface.aperture import Aperture
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.errors import DataError


@pytest.mark.parametrize(("level", "aperture"), [(np.nan, None), (0.0, Aperture(1e-6, 1.0))])
def test_a_pose_at_which_the_points_miss_the_part_is_refused(level, aperture):
    """The refinement may arrive there: heights that wrapped by metres left it without a point."""
    x, y = np.random.default_rng(1).uniform(-0.01, 0.01, (2, 1000))
    points = PointBatch(x, y, np.full(len(x), level), np.empty((0, len(x))))
    with pytest.raises(DataError, match="0 points lie on the nominal surface, expected 200"):
        inside_aperture(placed(PAPER_MIRROR, Placement(), points), aperture)
