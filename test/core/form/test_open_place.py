"""Terms of a part with an undetermined pose, against the same form fitted at another place."""

import numpy as np
import pytest

from omsm_ros.core.form.analyse import analyse_form
from omsm_ros.core.registration.placement import PointBatch
from omsm_ros.core.surface.aperture import Aperture
from omsm_ros.core.surface.aspheres import Sphere
from omsm_ros.core.surface.nominal import ZernikeSurface
from omsm_ros.core.surface.posed import Sum

RADIUS = 12.7e-3


def terms_of(shift, *asked):
    """Terms of a sphere with astigmatism and coma, clamped beside the axis by ``shift`` [m]."""
    form = ZernikeSurface(RADIUS, (0, 0, 0, 0, 50e-9, 0, 0, 15e-9))
    part = Sum((Sphere(-0.1), form))
    r, angle = np.linspace(RADIUS, 0, 6000), np.linspace(0, 120 * np.pi, 6000)
    x, y = r * np.cos(angle), r * np.sin(angle)
    height = part.height(x - shift, y) + np.random.default_rng(1).normal(0, 1e-9, len(x))
    portion = PointBatch(x, y, height, np.empty((0, len(x))))
    found = analyse_form(Sphere(-0.1), lambda: [portion], asked, aperture=Aperture(RADIUS))
    return {(t.n, t.m): row for t, *row in zip(
        found.zernike.terms, found.zernike.coefficients, found.zernike.uncertainty, strict=True
    )}  # fmt: skip


@pytest.mark.soak
def test_terms_of_a_sphere_hold_what_a_shift_along_itself_makes_of_them():
    straight, shifted = terms_of(0.0, "auto"), terms_of(1e-3, "auto")
    named = terms_of(0.0, "piston", "tip", "tilt")
    # A lateral shift of coma gives astigmatism, by three times its share of the radius.
    change = abs(shifted[2, -2][0] - straight[2, -2][0])
    assert change > 10 * named[2, -2][1]
    assert 0.7 * change < straight[2, -2][1] < 2 * change
    for key in shifted:
        assert abs(shifted[key][0] - straight[key][0]) < 3 * shifted[key][1]
    # Turned by a degree, the astigmatism of 50 nm has sines of two degrees of it.
    assert straight[2, -2][1] > 50e-9 * np.sin(np.radians(2))
    assert named[2, -2][1] < 0.2e-9
