"""Digital filters over a stream that is already moving when it begins.

The initial state is that after an infinite motion of constant acceleration that ends in the first
samples. The remaining error is the response to the difference between the true past and this
polynomial.
"""

from functools import cache

import numpy as np
import scipy  # whose parts are loaded when they are used

from omsm_ros.core.lti.discretisation import DigitalFilter
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.linear_algebra import sosfilt

# Position, velocity, acceleration.
POLYNOMIAL_DEGREE = 2
START_SAMPLES = 12
"""Samples that give the past motion. The end of a parabola through twelve samples has 0.74 of the
noise of one sample, through five 0.94, and a motion is still a parabola over twelve samples."""


def past_motion(first: FloatArray, degree: int = POLYNOMIAL_DEGREE) -> FloatArray:
    """Return ascending coefficients of the parabola through ``first`` (k,), k >= 3.

    It is fitted over the index about the middle sample, where it is best conditioned, then shifted.
    degree: of the result (degree + 1,), which is cut there; 0 is a standstill at the first sample
    """
    middle = (len(first) - 1) / 2
    index = np.arange(len(first)) - middle
    weights = np.linalg.pinv(np.vander(index, POLYNOMIAL_DEGREE + 1, increasing=True))
    start = first[0]
    # A sum of products instead of a BLAS call, because its order of additions is fixed.
    centred = (weights * (first - start)).sum(axis=1)
    place, rate, bend = centred
    place = place - middle * rate + middle**2 * bend
    return np.array([start + place, rate - 2 * middle * bend, bend])[: degree + 1]


class Recursion:
    """A digital filter with its state, run over a stream block by block."""

    def __init__(self, digital: DigitalFilter) -> None:
        self._sections = digital.sections
        self._state = np.zeros((len(digital.sections), 2))

    def start(self, motion: FloatArray) -> None:
        """Set the state after the polynomial ``motion`` (ascending, of the index).

        The next sample has index 0.
        """
        for state, section in zip(self._state, self._sections, strict=True):
            powers = _shifts(len(motion))
            out = sum(b * power for b, power in zip(section[:3], powers, strict=True)) @ motion
            if section[4:].any():  # no pure delay; long ones have hundreds of sections
                backward = sum(a * power for a, power in zip(section[3:], powers, strict=True))
                out = np.linalg.solve(backward, out)
            # Direct form II transposed: y = b0 x + s1; s1' = b1 x - a1 y + s2.
            b0, b1, _, _, a1, _ = section
            state[0] = out[0] - b0 * motion[0]
            state[1] = out.sum() - b0 * motion.sum() - b1 * motion[0] + a1 * out[0]
            motion = out

    def run(self, samples: FloatArray, out: FloatArray | None = None) -> FloatArray:
        """Return the response (n,) to ``samples`` (n,), bit-identical for any division into blocks.

        out: array for the result, see :func:`omsm_ros.linear_algebra.sosfilt`
        """
        return sosfilt(self._sections, samples, self._state, out)


def through(digital: DigitalFilter, z: FloatArray) -> FloatArray:
    """Return the response (n,) of ``digital`` to ``z`` (n,), started by its first samples."""
    recursion = Recursion(digital)
    recursion.start(past_motion(z[:START_SAMPLES]))
    return recursion.run(z)


@cache
def _shifts(degree: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the matrices (degree, degree) that delay a polynomial by 0, 1 and 2 samples."""
    # q(k) -> q(k - 1) is a triangular matrix acting on the coefficients of q.
    shift = np.asarray(scipy.linalg.invpascal(degree, "upper"), np.float64)
    return np.eye(degree), shift, shift @ shift
