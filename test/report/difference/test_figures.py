"""Heights of any size are drawn in a readable unit."""

import numpy as np
import pytest

from omsm_ros.core.comparison.compare import compare_measurements_of_part
from omsm_ros.core.comparison.stated_errors import ComparedMeasurement
from omsm_ros.core.surface.measured_points import MeasuredPoints
from omsm_ros.report.difference import profiles


@pytest.mark.parametrize(
    ("size", "unit", "largest"), [(2e-7, "nm", 200), (1e-3, "µm", 1000), (2e-2, "mm", 20)]
)
def test_heights_have_at_most_four_digits(size, unit, largest):
    x, y = (v.ravel() for v in np.meshgrid(*2 * [np.linspace(-1, 1, 41)]))
    points = MeasuredPoints(x=x * 5e-3, y=y * 5e-3, height=size * x**3)
    found = compare_measurements_of_part(
        *(ComparedMeasurement(name=n, points=points, common=1e-9) for n in "ab")
    )
    upper, lower = profiles(found)["profile_x"].axes
    assert upper.get_ylabel() == f"height [{unit}]"
    assert lower.get_ylabel() == "A − B [nm]"
    drawn = np.concatenate([line.get_ydata() for line in upper.get_lines()])
    # Less the tilt that was fitted.
    assert 0.1 * largest < np.nanmax(np.abs(drawn)) < largest
