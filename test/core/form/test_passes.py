"""Passes of paths with a known number of turns and lines."""

import numpy as np
import pytest

from omsm_ros.core.form.zernike_fit import passes

RANDOM = np.random.default_rng(5)


@pytest.mark.parametrize("start", [0.0, 1.0, 4.0])
@pytest.mark.parametrize("inwards", [True, False])
def test_turns_of_a_spiral(start, inwards):
    radius, angle = np.linspace(1, 0.3, 20_000), start + np.linspace(0, 80 * np.pi, 20_000)
    found = passes(*((radius if inwards else radius[::-1]) * [np.cos(angle), np.sin(angle)]))
    assert found[0] == 0
    np.testing.assert_allclose(np.diff(found), 500, atol=20)
    assert len(found) == pytest.approx(40, abs=1)


@pytest.mark.parametrize("there_and_back", [True, False])
def test_lines_of_a_raster_whose_axes_jitter(there_and_back):
    along, line = np.tile(np.linspace(-1, 1, 200), 60), np.repeat(np.linspace(-1, 1, 60), 200)
    if there_and_back:
        along = np.where(np.arange(len(along)) // 200 % 2, -along, along)
    x, y = along + RANDOM.normal(0, 0.01, len(along)), line + RANDOM.normal(0, 0.01, len(along))
    lines = 2 if there_and_back else 1
    for found in (passes(x, y), passes(y, x)):
        np.testing.assert_allclose(np.diff(found), 200 * lines, atol=10)


def test_points_in_no_order_and_a_single_line_have_none():
    assert passes(*RANDOM.uniform(-1, 1, (2, 5000))) is None
    assert passes(np.linspace(-1, 1, 5000), np.zeros(5000)) is None
    assert passes(np.zeros(5000), np.zeros(5000)) is None
    angle = np.linspace(0, 10 * np.pi, 5000)
    assert passes(angle * np.cos(angle), angle * np.sin(angle)) is None, "five turns are too few"
