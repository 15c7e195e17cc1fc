"""Say which departures from a linear, steady response were found, and what to do at the machine.

A departure that was modelled is a reservation: its uncertainty is in the band and in the budget.
One that is significant and could not be modelled rejects the calibration, with its cause.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from omsm_ros.core.departures.families import (
    BACKLASH,
    CREEP,
    DRIFT,
    FRICTION,
    LINEARITY,
    MODE,
    PERIODIC,
    STIFFENING,
    VIBRATION,
)
from omsm_ros.core.departures.survey import FALSE_ALARM, Judged
from omsm_ros.core.departures.term import Term
from omsm_ros.core.dynamics.frequency_response import frequency_response
from omsm_ros.core.fitting.covariance import parameter_covariance
from omsm_ros.core.fitting.output_error import Fit, Problem
from omsm_ros.core.identification.departure_search import ModelledTerm, Searched
from omsm_ros.core.identification.finding import Finding
from omsm_ros.core.identification.residual_tests import response_agreement
from omsm_ros.readable import chance, plain, quantity

# No benign one of a hundred test records (noise, hum, drift, dropouts) comes above it.
_WORST_AGREEMENT = 2.5
# Resolves 1 Hz.
_AGREEMENT_SEGMENT_S = 1.0
# A response that is the mean of fewer is known to a third at best.
_LEAST_SEGMENTS = 8
# Share of its size that a departure costs on a scan, as a standard uncertainty: a sine its rms.
# Backlash and friction lag by their whole half widths together.
_ON_SCAN = {PERIODIC: 0.5**0.5, VIBRATION: 0.5**0.5}
_TURNING = (BACKLASH, FRICTION)
_REMEDY = {
    CREEP: "let the joints of probe and target settle, and rest longer on each plateau",
    MODE: "look for what the machine stands on or carries loosely",
    BACKLASH: "tighten the mount of the probe, or preload it",
    FRICTION: "look for cables and seals that drag on the moving part",
    STIFFENING: "make smaller steps, as large as the deflections of a scan",
    LINEARITY: "use less of the probe's range, or linearise the probe",
    PERIODIC: "make steps that are no multiple of that period",
    VIBRATION: "find what runs at this frequency, or isolate the machine from it",
    DRIFT: "let the machine warm up and its joints settle, and shield it",
}


def departures(searched: Searched) -> Finding:
    """Report the departures that were modelled, and those that could not be."""
    fit, problem = searched.model.chosen.fit, searched.prepared.problem
    beside, turning = _sizes(problem, fit, searched.beside)
    costs = [turning] + [
        _ON_SCAN.get(modelled.term.family, 0.0) * float(np.hypot(size, uncertainty))
        for modelled, (size, uncertainty) in zip(searched.beside, beside, strict=True)
    ]
    entries = [
        _entry(modelled.term, size, uncertainty)
        for modelled, (size, uncertainty) in zip(searched.beside, beside, strict=True)
    ]
    backlash = [
        2 * size
        for modelled, (size, _) in zip(searched.beside, beside, strict=True)
        if modelled.term.family == BACKLASH
    ]
    return Finding(
        {
            "departures": entries + [_entry(term, None, None) for term in searched.in_response],
            "motion_error_m": float(np.sqrt(np.sum(np.square(costs)))),
            "backlash_m": max(backlash, default=0.0),
        },
        {"false_alarm_p": FALSE_ALARM},
        reasons=tuple(_unmodelled(judged) for judged in searched.unmodelled),
        reservations=(
            *(
                f"{_words(modelled.term, size)}; it is modelled beside the response: "
                + _REMEDY[modelled.term.family]
                for modelled, (size, _) in zip(searched.beside, beside, strict=True)
            ),
            *(
                f"{_words(term, None)}; it is part of the response: {_REMEDY[term.family]}"
                for term in searched.in_response
            ),
        ),
    )


def _entry(term: Term, size: float | None, uncertainty: float | None) -> dict[str, object]:
    return {
        "family": term.family,
        "parameter": term.parameter,
        "size_m": size,
        "uncertainty_m": uncertainty,
        "modelled": "in the response" if size is None else "beside it",
    }


def _sizes(
    problem: Problem, fit: Fit, beside: Sequence[ModelledTerm]
) -> tuple[list[tuple[float, float]], float]:
    """Return each modelled term's size and standard uncertainty [m]; what turning costs [m].

    Backlash and friction look alike, and what one has too much the other has too little.
    """
    if not beside:
        return [], 0.0
    columns = problem.sensitivity(fit)
    covariance = parameter_covariance(problem, columns, fit.residual)
    first = columns.shape[1] - problem.background.shape[1]
    sides = np.zeros(problem.background.shape[1])
    found = []
    for modelled in beside:
        coefficients = fit.background[modelled.columns]
        part = slice(first + modelled.columns.start, first + modelled.columns.stop)
        spread = covariance[part, part]
        if modelled.term.family in _TURNING:
            # The further column is its unknown state at the start.
            coefficients, spread = coefficients[:1], spread[:1, :1]
            sides[modelled.columns.start] = 1.0
        if modelled.term.family == DRIFT:
            added = problem.background[:, modelled.columns] @ coefficients
            found.append((float(np.std(added)), float(np.sqrt(max(np.trace(spread), 0.0) / 2))))
            continue
        found.append(
            (float(np.linalg.norm(coefficients)), float(np.sqrt(max(np.trace(spread), 0.0))))
        )
    variance = max(float(sides @ covariance[first:, first:] @ sides), 0.0)
    return found, float(np.hypot(sides @ fit.background, np.sqrt(variance)))


def _words(term: Term, size: float | None) -> str:
    large = "" if size is None else f" of {quantity(size, 'm')}"
    half = quantity(size or 0.0, "m")
    length = quantity(term.parameter, "m")
    frequency = quantity(term.parameter, "Hz", 4)
    return {
        CREEP: "slow relaxation (creep) with a time constant of "
        + quantity(term.parameter, "s", 2),
        MODE: f"a light mode at {frequency}",
        BACKLASH: f"backlash of ±{half}",
        FRICTION: f"friction that drags by ±{half} and slides after {length}",
        STIFFENING: "a stiffness that grows with the deflection",
        LINEARITY: f"the probe's scale changes over its range, by{large[3:]} at its ends",
        PERIODIC: f"an error{large} periodic in {length} of travel",
        VIBRATION: f"vibration{large} at {frequency}",
        DRIFT: f"drift{large} rms during the test, or the beginning of a relaxation",
    }[term.family]


def _unmodelled(judged: Judged) -> str:
    size = float(np.linalg.norm(judged.score.size))
    by_chance = chance(float(np.exp(max(judged.log_p, -690))))
    return (
        f"the residual shows {_words(judged.term, size)} (by chance: {by_chance}) that no model "
        f"describes: {_REMEDY[judged.term.family]}, and repeat the test"
    )


def independence(p_value: float, scatter: float = 0.0) -> Finding:
    """Reject a residual that follows the rate of the motion, see ``residual_tests``.

    scatter: of the readings in time [s]: behind it the structure shows badly
    """
    reasons: tuple[str, ...] = ()
    if p_value < FALSE_ALARM:
        cause = (
            "the machine does not answer linearly, or differently each time; look for what is "
            "loose or rubs, and compare with smaller steps"
        )
        if scatter > 0:
            cause = (
                f"readings that scatter in time by {quantity(scatter, 's')} hide the response; "
                "latch encoder and probe by one trigger, and repeat the test"
            )
        reasons = (f"the residual follows the motion (by chance: {chance(p_value)}): {cause}",)
    return Finding({"independence_p": p_value}, {"independence_p_least": FALSE_ALARM}, reasons)


def agreement(problem: Problem, best: Fit, up_to: float) -> Finding:
    """Reject a response that one estimated without a model contradicts, 0 to ``up_to`` [Hz]."""
    residual = problem.on_grid(best.residual, 0.0)
    segment = min(round(_AGREEMENT_SEGMENT_S / problem.period), len(residual) // _LEAST_SEGMENTS)
    value = response_agreement(
        frequency_response(problem.input, residual, problem.period, max(segment, 16)), up_to
    )
    # It takes the residual for noise alike everywhere, which rounding without noise is not.
    if not np.isfinite(value) or problem.shared > 0:
        return Finding({"nonparametric_agreement": None})
    reasons: tuple[str, ...] = ()
    if value > _WORST_AGREEMENT:
        reasons = (
            "the response estimated without a model differs from the model by "
            f"{plain(value, 2)} times its variance, at most {_WORST_AGREEMENT:g} are chance: the "
            "model misses a part of "
            "the machine; make more steps of two heights, and look for what is loose",
        )
    return Finding(
        {"nonparametric_agreement": value}, {"agreement_greatest": _WORST_AGREEMENT}, reasons
    )
