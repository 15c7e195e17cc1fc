"""The next cut: path of the nose in closed form, and what the last cut did."""

import numpy as np
import pytest

from omsm_ros.core.form.compensation import Compensation, CutSurface, check_last_cut, cut_path
from omsm_ros.core.kinematics.planner import plan_path
from omsm_ros.errors import ConfigurationError, DataError


class Sphere:
    """Hollow, of radius ``r`` [m], its lowest point at the origin."""

    def __init__(self, r):
        self.r = r

    def height(self, x, y):
        return self.r - np.sqrt(self.r**2 - np.asarray(x) ** 2 - np.asarray(y) ** 2)


class Bowl(Sphere):
    """A paraboloid of the same curvature at its origin, without a rim."""

    def height(self, x, y):
        return (np.asarray(x) ** 2 + np.asarray(y) ** 2) / (2 * self.r)


def test_the_nose_in_a_hollow_sphere_runs_on_a_smaller_sphere():
    path, duration = cut_path(Sphere(50e-3), 5e-3, 1e-4, 60.0, 2e-3)
    time = np.linspace(0, duration, 5001)
    x, z, c = path(time)
    assert duration == pytest.approx(50.0)
    assert c[-1] == pytest.approx(100 * np.pi)
    np.testing.assert_allclose(x, 5e-3 - 1e-4 * time, atol=1e-15)
    tip = 50e-3 - np.sqrt(48e-3**2 - x**2) - 2e-3
    np.testing.assert_allclose(z, tip, atol=1e-11)


def test_a_nose_that_does_not_fit_is_refused():
    path, duration = cut_path(Bowl(5e-3), 4e-3, 1e-4, 60.0, 9e-3)
    with pytest.raises(ConfigurationError):
        path(np.linspace(0, duration, 50))


def test_the_program_of_the_cut_keeps_its_path():
    path, _ = cut_path(Sphere(50e-3), 5e-3, 1e-4, 60.0, 2e-3)
    assert plan_path(path, 3.0, 1e-3, 1e-8).error < 1e-8


X = np.linspace(-1e-3, 1e-3, 21)
ASKED = 100e-9 * np.outer(np.sin(3e3 * X), np.cos(2e3 * X))


def measured(deviation, noise=2e-9):
    return Compensation(X, X, -deviation, np.full(deviation.shape, noise), 4e-4, 0.0, 0.0)


@pytest.mark.parametrize("share", [0.8, 1.0, 1.2])
def test_a_cut_that_did_what_was_asked_is_followed_by_the_next(share):
    left = -ASKED + share * ASKED + 30e-9  # a shift of the whole part is no form
    assert check_last_cut(measured(left), ASKED) == pytest.approx(share, abs=0.02)


@pytest.mark.parametrize("share", [-1.0, 0.0, 2.5])
def test_a_reversed_a_missing_and_a_doubled_cut_are_refused(share):
    with pytest.raises(DataError) as refused:
        check_last_cut(measured(-ASKED + share * ASKED), ASKED)
    assert refused.value.values["share"] == pytest.approx(share, abs=0.05)


def test_offsets_below_their_uncertainty_say_nothing_of_the_sign():
    assert check_last_cut(measured(-2 * ASKED, noise=1e-7), ASKED) is None


def test_beyond_what_was_measured_the_nearest_offset_holds():
    offset = np.where(np.hypot(*np.meshgrid(X, X)) < 0.8e-3, 50e-9, np.nan)
    surface = CutSurface(Sphere(50e-3), X, X, offset)
    at = np.array([0.0, 0.5e-3, 0.95e-3, 2e-3])
    np.testing.assert_allclose(surface.height(at, 0 * at), Sphere(50e-3).height(at, 0) + 50e-9)
