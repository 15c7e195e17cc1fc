"""A relaxation, or a light mode, as poles of a response."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from omsm_ros.core.departures.families import CREEP
from omsm_ros.core.departures.term import Term
from omsm_ros.core.dynamics.transfer_function import ComplexArray
from omsm_ros.core.fitting.model_structure import Scaled, Structure
from omsm_ros.core.fitting.order_choice import MAX_POLES
from omsm_ros.core.fitting.output_error import Fit, Problem, fit
from omsm_ros.core.samples.blocks import FloatArray


def poles_of(term: Term) -> ComplexArray:
    """Return the poles [rad/s] of a relaxation, (1,), or of a mode, (2,)."""
    if term.family == CREEP:
        return np.array([-1 / term.parameter], np.complex128)
    omega = 2 * np.pi * term.parameter
    upper = omega * (-term.damping + 1j * np.sqrt(1 - term.damping**2))
    return np.array([upper, np.conj(upper)], np.complex128)


def as_fitted(term: Term, fitted: Fit) -> Term:
    """Return ``term`` with the time constant [s] or frequency [Hz] of the pole that it became."""
    poles = fitted.dynamics.poles()
    near = np.abs(np.log(poles / poles_of(term)[0]))
    pole = poles[int(np.argmin(near))]
    parameter = 1 / abs(pole) if term.family == CREEP else abs(pole) / (2 * np.pi)
    return replace(term, parameter=float(parameter), damping=float(-pole.real / abs(pole)))


def with_poles(
    problem: Problem, base: Fit, new: ComplexArray, starts: Sequence[float]
) -> Fit | None:
    """Return the fit of ``base`` and ``new`` poles [rad/s], started at multiples of them.

    None where they would be more than can be fitted.
    """
    zeros, delay = base.structure.zeros + len(new), base.structure.delay
    larger = Structure(base.structure.poles + len(new), zeros, delay)
    if larger.poles > MAX_POLES:
        return None
    scaled = Scaled(larger, problem.rate)
    late = float(base.nonlinear[-1]) if delay else 0.0
    own = base.dynamics.poles()

    def started(faster: float) -> FloatArray:
        poles = np.concatenate([own, faster * new]) / problem.rate
        return scaled.nonlinear_of(np.asarray(poles, np.complex128), late)

    return fit(problem, larger, [started(faster) for faster in starts])
