"""Peak to valley of a part with a local defect, against the defect itself; plain numpy."""

import numpy as np
import pytest

from omsm_ros.core.form.deviation_map import DeviationMap
from omsm_ros.core.form.part_figures import extents_of_part
from omsm_ros.core.surface.aperture import Aperture

R, NOISE = 12.7e-3, 10e-9
X, Y = (v.ravel() for v in np.meshgrid(*[np.linspace(-R, R, 200)] * 2))
INSIDE = np.hypot(X, Y) <= R
X, Y = X[INSIDE], Y[INSIDE]
FORMS = {
    "smooth": 0 * X,
    "groove": -60e-9 * (np.abs(0.6 * X + 0.8 * Y - 2e-3) < 0.25e-3),
    "pip": 150e-9 * np.exp(-(((X - 1e-3) / 0.4e-3) ** 2) - (Y / 0.4e-3) ** 2),
    "scratch": -150e-9 * ((np.abs(X - 3e-3) < 0.1e-3) & (np.abs(Y) < 4e-3)),
    "rolled edge": -400e-9 * np.clip((np.hypot(X, Y) - 0.9 * R) / (0.1 * R), 0, None) ** 3,
}


@pytest.mark.parametrize("name", FORMS)
def test_the_whole_peak_to_valley_contains_local_defects(name):
    form = 20e-9 * (X**2 - Y**2) / R**2 + FORMS[name]
    held = 0
    for seed in range(4):
        noise = np.random.default_rng(seed).normal(0, NOISE, len(X))
        map_ = DeviationMap(x=X, y=Y, deviation=form + noise, area=np.ones(len(X)),
                            effects=np.empty((0, len(X))), noise=NOISE)  # fmt: skip
        whole, _ = extents_of_part(map_, Aperture(R))
        held += abs(whole.value - np.ptp(form)) <= 2 * whole.uncertainty
        assert whole.value + 2 * whole.uncertainty > 0.9 * np.ptp(form)
        assert whole.value > 0.8 * np.ptp(form)
    assert held >= 3
