"""Marks that a circle crosses every wavelength."""

import numpy as np
import pytest

from omsm_ros.core.surface.nominal import Flat
from omsm_ros.errors import ConfigurationError
from omsm_ros.twin.part import AzimuthalRipple


def test_waves_along_the_circle_have_their_length_and_size():
    surface = AzimuthalRipple(Flat(), 21.6e-3, wavelength=15e-6, rms=11e-9)
    angle = np.linspace(0, 150e-6 / 21.6e-3, 4000, endpoint=False)
    height = surface.height(21.6e-3 * np.cos(angle), 21.6e-3 * np.sin(angle))
    assert np.std(height) == pytest.approx(11e-9, rel=0.01)
    assert np.argmax(abs(np.fft.rfft(height))[1:]) + 1 == 10


def test_it_closes_on_itself():
    surface = AzimuthalRipple(Flat(), 21.6e-3, second=0.3)
    x = np.array([-21.6e-3, -21.6e-3])
    above, below = surface.height(x, np.array([1e-15, -1e-15]))
    assert above == pytest.approx(below, abs=1e-13)


def test_no_circle_has_no_radius():
    with pytest.raises(ConfigurationError, match="radius"):
        AzimuthalRipple(Flat(), 0.0)
