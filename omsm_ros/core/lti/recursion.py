"""How does a digital filter run over a stream that is already moving when it begins?

The first samples are taken as the end of a motion of constant acceleration that has gone
on for ever; the filter's state is the one such a motion leaves. What remains is the
response to the difference between the true past and that polynomial.
"""

from __future__ import annotations

from functools import cache
from math import comb

import numpy as np

from omsm_ros.core.lti.discretisation import DigitalFilter
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.linear_algebra import sosfilt

# Position, velocity, acceleration.
POLYNOMIAL_DEGREE = 2
START_SAMPLES = 12
"""Samples from which the past of a motion is taken: a parabola through twelve has 0.74 of one
sample's noise at its end, through five 0.94, and a motion has hardly bent meanwhile."""


def past_motion(first: FloatArray) -> FloatArray:
    """Fit a parabola to ``first`` (k,), k >= 3, over its index: ascending coefficients (3,).

    Least squares about the middle sample, where the fit is best conditioned, then shifted.
    """
    middle = (len(first) - 1) / 2
    index = np.arange(len(first)) - middle
    weights = np.linalg.pinv(np.vander(index, POLYNOMIAL_DEGREE + 1, increasing=True))
    start = first[0]
    # A sum of products with a fixed length, unlike a BLAS call, has one order of additions.
    centred = (weights * (first - start)).sum(axis=1)
    shifted = np.array(
        [
            sum(centred[j] * comb(j, k) * (-middle) ** (j - k) for j in range(k, len(centred)))
            for k in range(len(centred))
        ]
    )
    shifted[0] += start
    return shifted


def past_stationary(first: FloatArray) -> FloatArray:
    """Return the coefficient (1,) of a rest where :func:`past_motion` has its first sample.

    For a filter that remembers a minute: a parabola through some samples is, so far back,
    metres of travel.
    """
    return past_motion(first)[:1]


class Recursion:
    """A digital filter with its state; ``run`` may cut the stream anywhere."""

    def __init__(self, digital: DigitalFilter) -> None:
        self._sections = digital.sections
        self._state = np.zeros((len(digital.sections), 2))

    def start(self, motion: FloatArray) -> None:
        """Take the state that the polynomial ``motion`` (ascending, of the index) has left.

        The next sample to run is that of index 0.
        """
        for state, section in zip(self._state, self._sections, strict=True):
            out = _polynomial_response(section, motion)
            # Direct form II transposed: y = b0 x + s1; s1' = b1 x - a1 y + s2.
            b0, b1, _, _, a1, _ = section
            state[0] = out[0] - b0 * motion[0]
            state[1] = out.sum() - b0 * motion.sum() - b1 * motion[0] + a1 * out[0]
            motion = out

    def run(self, samples: FloatArray, out: FloatArray | None = None) -> FloatArray:
        """Return the response (n,) to ``samples`` (n,), bit-identical however the stream is cut.

        out: where it is written, see :func:`omsm_ros.linear_algebra.sosfilt`
        """
        return sosfilt(self._sections, samples, self._state, out)


def through(digital: DigitalFilter, z: FloatArray) -> FloatArray:
    """Return the response (n,) of ``digital`` to ``z`` (n,), which comes out of a steady motion."""
    recursion = Recursion(digital)
    recursion.start(past_motion(z[:START_SAMPLES]))
    return recursion.run(z)


def _polynomial_response(section: FloatArray, motion: FloatArray) -> FloatArray:
    """Return the polynomial with which a section (6,) answers an everlasting one, ``motion``."""
    powers = _shifts(len(motion))
    forward = sum(b * power for b, power in zip(section[:3], powers, strict=True))
    if not section[4:].any():  # a delay, of which a long one has hundreds
        return np.asarray(forward @ motion, np.float64)
    backward = sum(a * power for a, power in zip(section[3:], powers, strict=True))
    return np.asarray(np.linalg.solve(backward, forward @ motion), np.float64)


@cache
def _shifts(degree: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the matrices (degree, degree) that delay a polynomial by 0, 1 and 2 samples."""
    # q(k) -> q(k - 1) is a triangular matrix acting on the coefficients of q.
    shift = np.array(
        [
            [comb(j, i) * (-1.0) ** (j - i) if j >= i else 0.0 for j in range(degree)]
            for i in range(degree)
        ]
    )
    return np.eye(degree), shift, shift @ shift
