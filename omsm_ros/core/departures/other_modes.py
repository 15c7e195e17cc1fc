"""How else could a light mode that became a pole look, and describe the record about as well?

Steps that follow each other evenly excite a comb of frequencies. A light mode between its teeth
shows at the teeth beside it only, so that several frequencies and dampings explain the residual
about equally well. The covariance at one of them knows nothing of the others: their spread,
weighted by likelihood, comes on top.
"""

from __future__ import annotations

import numpy as np

from omsm_ros.core.departures.hidden import omitted
from omsm_ros.core.departures.survey import Survey
from omsm_ros.core.departures.term import Term
from omsm_ros.core.dynamics.response_band import relative_response_jacobian, response_band
from omsm_ros.core.dynamics.transfer_function import ComplexArray
from omsm_ros.core.fitting.output_error import Fit
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.least_squares import least_squares

# Of the frequency found, as a logarithm; and the dampings, a factor of two apart.
_FREQUENCIES = np.linspace(-0.4, 0.4, 33)
_DAMPINGS = (0.01, 0.02, 0.04, 0.08, 0.16)
# Less likely than this against the best, they add nothing that matters.
_LEAST_LIKELY = 1e-3
# Where responses are compared, a few per cent apart.
_LINES = 150
_LOWEST_HZ = 0.1
# Times the mode's frequency; far above it nothing depends on which mode it is.
_HIGHEST = 10.0
# Of the largest variation: less is all alike.
_LITTLE = 0.02
# Directions of the coefficients weaker than this change no response by what matters.
_DIRECTIONS = 1e-6


def spread_of_modes(before: Survey, term: Term, fitted: Fit) -> FloatArray:
    """Return the covariance (p, p) of what other light modes than ``term`` would make of G.

    before: survey of the fit without the mode;  term: the mode as ``fitted`` has it
    """
    highest = 0.25 / before.problem.period
    tried: list[tuple[float, float]] = [(term.parameter, term.damping)]
    tried += [
        (term.parameter * float(np.exp(off)), damping)
        for damping in _DAMPINGS
        for off in _FREQUENCIES
        if term.parameter * np.exp(off) < highest
    ]
    before = before.thinned or before
    modes = before.departures.modes(tried)
    screened = before.screened(modes)
    likely = np.exp(0.5 * (screened - np.max(screened)))
    kept = np.flatnonzero(likely > _LEAST_LIKELY)
    lines = np.geomspace(_LOWEST_HZ, _HIGHEST * term.parameter, _LINES)
    lines = np.sort(np.append(lines, [frequency for frequency, _ in tried]))
    own = _change(before, modes.term(0), lines)
    rows = [
        np.sqrt(likely[i] / np.sum(likely[kept])) * (_change(before, modes.term(i), lines) - own)
        for i in kept.tolist()
    ]
    return _imitating(fitted, lines, np.asarray(rows))


def _imitating(fitted: Fit, lines: FloatArray, rows: ComplexArray) -> FloatArray:
    """Return the covariance (p, p) with which G varies at ``lines`` (k,) as by ``rows`` (m, k).

    Coefficients turn one mode into its neighbours, not into all of them: where ``rows`` are large
    the covariance is as large at least.
    """
    wanted = np.linalg.norm(rows, axis=0)
    # Where little varies, as little may come of it.
    weight = 1 / np.maximum(wanted, _LITTLE * np.max(wanted)) if np.any(wanted) else wanted
    jacobian = np.concatenate(
        weight[:, np.newaxis] * relative_response_jacobian(fitted.dynamics, lines)
    )
    shifts = np.column_stack(
        [
            least_squares(jacobian, np.concatenate([r.real, r.imag]), _DIRECTIONS)
            for r in weight * rows
        ]
    )
    covariance = np.asarray(shifts @ shifts.T)
    band = response_band(fitted.dynamics, covariance, lines)
    held = np.hypot(band.gain, band.phase)
    large = (wanted > 0.5 * np.max(wanted)) & (held > 0)
    factor = max(1.0, float(np.max(wanted[large] / held[large], initial=1.0)))
    return np.asarray(factor**2 * covariance)


def _change(before: Survey, term: Term, lines: FloatArray) -> ComplexArray:
    """Return the relative change (k,) of G at ``lines`` [Hz] by a mode in its best size."""
    size = before.space.score(term.columns).size
    ratio = 1j * lines / term.parameter
    mode = 1 / (1 + 2 * term.damping * ratio + ratio**2)
    real, imaginary = relative_response_jacobian(before.fitted.dynamics, lines) @ omitted(
        before, term.columns @ size
    )
    return np.asarray(size[0] * (mode - 1) + size[1] * ratio * mode - real - 1j * imaginary)
