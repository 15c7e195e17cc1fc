"""Figures of a spectrum where there is nothing to draw."""

import warnings

import numpy as np

from omsm_ros.core.ripple.density import density
from omsm_ros.report import style
from omsm_ros.report.spectrum import motion


def test_an_axis_that_stands_still_is_drawn_without_a_word():
    """Z of a scan of a flat has zero density, and no warning is printed."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        still = density(np.zeros(1000), 1e-3)
        for valid_up_to in (62.0, None):
            assert style.png(motion([("flat", still)], valid_up_to)).startswith(b"\x89PNG")
        moved = density(np.sin(0.1 * np.arange(1000)), 1e-3)
        made = motion([("flat", still), ("part", moved)], 62.0)
        assert style.png(made).startswith(b"\x89PNG")
    assert len(made.axes[0].lines) == 1
