"""Positions of the axis in steps too coarse for the probe: what no response explains of them.

A position rounded to steps q is wrong by up to half a step, evenly: q / √12 rms (Widrow and
Kollár 2008, ch. 4). The probe saw the true motion, so through the response G that error, with
the mean of \\|G\\|² over all frequencies, is left where the axis moves. Other errors of the probe
would be looked for in it in vain, and for long.
"""

from __future__ import annotations

import numpy as np

from omsm_ros.core.fitting.model_structure import Structure
from omsm_ros.core.fitting.output_error import Fit, fit
from omsm_ros.core.fitting.preparation import Prepared
from omsm_ros.core.fitting.reading_steps import reading_step
from omsm_ros.core.fitting.starting_points import StartingPoints
from omsm_ros.core.fitting.steps import sample_noise
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.errors import IdentificationError
from omsm_ros.readable import quantity

# A lag and its roll-off: enough to see a residual of the size of a step.
_PLAIN = Structure(2, 1, True)
# Of what evenly spread errors leave. They are not spread evenly where plateaus are whole steps
# (a fifth was seen) or near them all on one side (2.8 was).
_AS_ROUNDING = (0.1, 5.0)
# Of the variance of the noise: where a step has more rms error than the noise, it left 0.4 and more
# in two seeds of eight steps. Those tests were rejected for other reasons, but for the finest step,
# of 1.1 times the noise, which was accepted with reservations.
_SEEN = 0.25
# A planned motion may lie on steps too, but a ramp of it advances evenly, except where it begins
# and ends: at less than a fifth of ten samples. Of a rounded one 0.4 to 1 was seen.
_UNEVEN = 0.3
_FREQUENCIES = 2000


def check_axis_steps(prepared: Prepared) -> None:
    """Raise IdentificationError where steps of the axis' positions hide the response.

    That is where their error is larger than the noise of the probe, and what a plain response
    leaves is as large as it. What is larger or smaller is none of theirs.
    """
    problem = prepared.problem
    positions = problem.input[problem.used]
    step, noise = reading_step(positions), sample_noise(problem.output[problem.used])
    if step**2 / 12 <= noise**2 or not _advances_unevenly(positions, step):
        return
    lag = fit(problem, Structure(0, 0, True), [np.array([0.1])])
    plain = fit(problem, _PLAIN, StartingPoints(problem, lag).of(_PLAIN, [lag]))
    moving = prepared.steps.moving[problem.used]
    left = float(np.mean(plain.residual[moving] ** 2)) - noise**2 if np.any(moving) else 0.0
    low, high = (part * _left_by_rounding(plain, step, problem.period) for part in _AS_ROUNDING)
    if left > _SEEN * noise**2 and low < left < high:
        raise IdentificationError(
            f"the positions of the axis come in steps of {quantity(step, 'm')}; where it moves "
            f"that leaves {quantity(float(np.sqrt(left)), 'm')} (rms) that no response explains, "
            f"beside {quantity(noise, 'm')} of noise: record the encoder in finer steps, and write "
            "its positions with all their digits"
        )


def _advances_unevenly(positions: FloatArray, step: float) -> bool:
    """Return True if the speed changes at many of the samples where the axis moves."""
    advance = np.diff(positions)
    moves = (np.abs(advance[:-1]) > step / 2) | (np.abs(advance[1:]) > step / 2)
    changes = np.abs(np.diff(advance)) > step / 2
    return bool(np.sum(changes & moves) > _UNEVEN * np.sum(moves))


def _left_by_rounding(fitted: Fit, step: float, period: float) -> float:
    """Return the variance [m²] of evenly spread errors of ``step`` [m] through ``fitted``."""
    lines = np.linspace(0, 0.5 / period, _FREQUENCIES)
    passed = float(np.mean(np.abs(fitted.dynamics.response(lines)) ** 2))
    return fitted.gain**2 * passed * step**2 / 12
