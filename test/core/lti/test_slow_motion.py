"""Lag and curvature of slow motion against differences of ln G."""

from __future__ import annotations

import numpy as np
import pytest

from omsm_ros.core.lti.transfer_function import TransferFunction, slow_motion_jacobian
from omsm_ros.twin.plant import PAPER_DYNAMICS

FAST = TransferFunction(np.array([1.0]), np.array([1.0, 2e-4]), 1e-4)


def lag_and_curvature(g: TransferFunction) -> np.ndarray:
    # Slow enough for the terms beyond s² to vanish, fast enough for digits to be left.
    # ln G = -L s + k s² - …: on s = jω the phase gives L, the gain k.
    omega = 10.0
    log = np.log(g.at(np.array([1j * omega])))[0]
    return np.array([-log.imag / omega, -log.real / omega**2])


LATE = TransferFunction(PAPER_DYNAMICS.numerator, PAPER_DYNAMICS.denominator, 1e-4)


@pytest.mark.parametrize("g", [LATE, FAST])
def test_the_jacobian_is_that_of_the_response(g: TransferFunction) -> None:
    parameters = np.concatenate([g.numerator, g.denominator[1:], [g.delay]])
    n = len(g.numerator)
    columns = []
    for k in range(1, len(parameters)):
        step = 1e-4 * max(abs(parameters[k]), 1e-9)
        ends = []
        for sign in (1, -1):
            p = parameters.copy()
            p[k] += sign * step
            ends.append(lag_and_curvature(TransferFunction(p[:n], np.append(1.0, p[n:-1]), p[-1])))
        columns.append((ends[0] - ends[1]) / (2 * step))
    # Each in parts of the whole lag and curvature, for a relative change of the parameter.
    scale = parameters[1:, np.newaxis] / lag_and_curvature(g)
    found = slow_motion_jacobian(g)[:, 1:].T
    np.testing.assert_allclose(found * scale, np.array(columns) * scale, rtol=1e-3, atol=1e-3)
