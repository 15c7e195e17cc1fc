"""What could hide in this very test, and how much would it cost on a scan?

A term that is not significant may still be there, up to the size at which it would have been
significant. The fitted coefficients then imitate a part of it, which shifts them. Its size is known
as N(estimate, uncertainty²), so its mean square is estimate² + uncertainty²: the shift of that
size is added to the covariance, unless the user declares a smaller prior.

A slow relaxation of size ε leaves G(0) = 1 and scales everything faster by 1 - ε. That is a
variance of the whole numerator; below ``valid_from`` the gain is one again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import polynomial
from scipy import stats

from omsm_ros.core.departures.families import CREEP, FASTEST_CREEP_S, MODE, STIFFENING
from omsm_ros.core.departures.survey import FALSE_ALARM, Judged, Survey
from omsm_ros.core.dynamics.response_band import (
    COVERAGE_FACTOR,
    ResponseLimits,
    relative_response_jacobian,
)
from omsm_ros.core.dynamics.transfer_function import TransferFunction
from omsm_ros.core.fitting.output_error import Fit
from omsm_ros.core.identification.covariance_terms import CovarianceTerm
from omsm_ros.core.identification.finding import Finding
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.errors import ConfigurationError
from omsm_ros.least_squares import least_squares
from omsm_ros.readable import percent, quantity

# Harmonics of the Z motion of the paper's scan (30 rpm over its mirror): frequency [Hz] and
# area-weighted rms [m]; the mean of each turn moves over minutes and counts as rest.
PAPER_SCAN = ((0.5, 22.3e-6), (1.0, 114.4e-6), (1.5, 4.4e-6))
# A test that alarms with probability α misses with 5 % what lies 1.645 σ above its limit.
_POWER = 1.645
# The families whose omission bends the response itself.
_BENDING = (MODE, STIFFENING)
# Decades of time between a structure's slowest motion and the length of a record.
_DECADES = 3.0
# What creeps within the record creeps on beyond it, about as much in each of three decades from
# none to all: a uniform distribution, whose standard deviation is 1/√3 of its end.
_UNSEEN = _DECADES / 3**0.5


# What drifts may be a relaxation of which the record shows the beginning.
_SLOWER_THAN_RECORD = 2.0


@dataclass(frozen=True, eq=False)
class HiddenTerm:
    """One family that could hide.

    size, uncertainty: of the most significant term of the family, in its unit
    missed: largest size that the test would have missed with 5 % probability
    shift: (p,) of the coefficients per unit, if the term is left out
    gain: (p,) change of the coefficients that scales the whole response by one
    above: relative error of the response at all frequencies above ``valid_from``, per unit
    effect: rms error on the paper's scan per unit [m]
    """

    family: str
    parameter: float
    size: float
    uncertainty: float
    missed: float
    shift: FloatArray
    gain: FloatArray
    above: float
    effect: float

    @property
    def carried(self) -> float:
        """Standard uncertainty of the size that is left out."""
        return float(np.hypot(self.size, self.uncertainty))

    def covariance(self, carried: float) -> FloatArray:
        """Return the coefficients' covariance (p, p) for a size known to ``carried``."""
        rows = carried * np.stack([self.shift, self.above * self.gain])
        return np.asarray(rows.T @ rows)


def hidden_terms(survey: Survey, drift: Sequence[slice] = ()) -> list[HiddenTerm]:
    """Return what could hide: the worst relaxation first, then the families that bend G.

    drift: columns of the background that model a drift
    """
    if drift:
        survey = replace(survey, slower=_SLOWER_THAN_RECORD)
    relaxations = [_hidden(survey, judged) for judged in survey.creep]
    if drift:
        other = without_drift(survey, drift).creep
        relaxations = [_smaller(*pair) for pair in zip(relaxations, other, strict=True)]
    known = [term for term in relaxations if np.isfinite(term.uncertainty)]
    found = [_worst(known, relaxation_found(survey.fitted.dynamics))] if known else []
    for name in _BENDING:
        judged = survey.best.get(name)
        if judged is None or not np.isfinite(judged.score.uncertainty):
            continue
        if _excited(survey, judged):
            found.append(_hidden(survey, judged))
    return found


def without_drift(survey: Survey, drift: Sequence[slice]) -> Survey:
    """Return ``survey`` with the drift that was modelled taken for noise of the readings.

    Columns of any size let a drift of a micrometre undo a relaxation of as much. One that
    wanders by nanometres cannot, and as noise it is no larger than it was found to be.
    """
    fitted, problem = survey.fitted, survey.problem
    gone = np.zeros(problem.background.shape[1], np.bool_)
    for columns in drift:
        gone[columns] = True
    drifted = problem.background[:, gone] @ fitted.background[gone]
    noisy = fitted.residual + drifted[problem.used]
    return Survey(
        replace(problem, background=problem.background[:, ~gone]),
        replace(fitted, background=fitted.background[~gone], residual=noisy),
        survey.steps,
        slower=survey.slower,
    )


def _smaller(term: HiddenTerm, other: Judged) -> HiddenTerm:
    """Return the relaxation ``term`` as ``other`` has it, where that leaves less of it open."""
    size, uncertainty = float(other.score.size[0]), other.score.uncertainty
    if not np.hypot(size, uncertainty) < term.carried:
        return term
    return replace(term, size=size, uncertainty=uncertainty, missed=_missed(other))


def _worst(relaxations: list[HiddenTerm], found: float) -> HiddenTerm:
    """Return the relaxation that would cost most, no larger than is likely where one was found.

    found: size of what is in the model already. Creep of joints and of piezos goes about
    evenly with the logarithm of time; what lies in the other decades of the record is not
    more than a few times what was found, and a larger one only the model's own imitates.
    """
    if found > 0:
        limit = _DECADES * found
        relaxations = [
            replace(term, size=min(term.size, limit), uncertainty=min(term.uncertainty, limit))
            for term in relaxations
        ]
    worst = max(relaxations, key=lambda term: term.effect * term.carried)
    slower = _UNSEEN * found
    if worst.above > 0 and worst.carried * worst.above < slower:
        worst = replace(worst, size=0.0, uncertainty=slower / worst.above)
    return worst


def relaxation_found(dynamics: TransferFunction) -> float:
    """Return the share of G(0) that comes with real poles slower than a structure's [1]."""
    poles = dynamics.poles()
    found = 0.0
    for index, pole in enumerate(poles):
        if pole.imag == 0 and -pole.real * FASTEST_CREEP_S < 1:
            others = np.delete(poles, index)
            share = polynomial.polyval(pole, dynamics.numerator) / np.prod(1 - pole / others)
            found += abs(float(np.real(share)))
    return found


def _excited(survey: Survey, judged: Judged) -> bool:
    """Return False for a mode slower than the steps follow each other: they hardly excite it."""
    return judged.term.family != MODE or judged.term.parameter * survey.plateau >= 1


def hidden_covariance(
    survey: Survey,
    settings: Mapping[str, object],
    limits: ResponseLimits,
    drift: Sequence[slice] = (),
) -> list[CovarianceTerm]:
    """Return the terms of the covariance, each with its entry for the certificate.

    limits: of the 95 % band, within which a response is trusted
    drift: columns of the background that model a drift
    settings: with "priors", an object of standard uncertainties by the name of a family, a
        term is taken no larger than its prior

    Raises ConfigurationError for a prior that is no positive number.
    """
    priors = _priors(settings)
    terms = hidden_terms(survey, drift)
    entries = [_entry(term, priors) for term in terms]
    covariance = [term.covariance(_carried(term, priors)) for term in terms]
    open_gain = max((_carried(t, priors) * t.above for t in terms), default=0.0)
    slow = max((t.parameter for t in terms if t.family == CREEP), default=0.0)
    finding = gain_above_rest(open_gain, slow, survey.plateau, limits.gain)
    finding = replace(
        finding,
        entries={
            **finding.entries,
            "could_hide": entries,
            "hidden_mostly": _mostly(terms, priors),
            "plateau_s": survey.plateau,
            "assumed": _assumptions(survey),
        },
    )
    return [CovarianceTerm(c) for c in covariance] + [
        CovarianceTerm(np.zeros((_size(survey.fitted),) * 2), finding)
    ]


def gain_above_rest(size: float, time_constant: float, plateau: float, limit: float) -> Finding:
    """Reject a test that leaves the gain of what moves too open against that at rest.

    size: standard uncertainty of it, relative, from a relaxation of ``time_constant`` [s]
    plateau: time from edge to edge [s];  limit: of the 95 % band, relative
    """
    entries = {"gain_above_rest_u": size, "plateau_that_would_tell_s": time_constant}
    if COVERAGE_FACTOR * size <= limit:
        return Finding(entries)
    wide, allowed = percent(COVERAGE_FACTOR * size), percent(limit)
    return Finding(
        entries,
        reasons=(
            f"drift or creep leaves the gain of what moves open by {wide} against that at "
            f"rest, at most {allowed} are allowed: "
            + _plateau_that_would_tell(time_constant, plateau),
        ),
    )


def _plateau_that_would_tell(time_constant: float, plateau: float) -> str:
    slow, rest = quantity(time_constant, "s", 2), quantity(plateau, "s", 2)
    if time_constant <= plateau:
        return (
            f"in this motion a relaxation of {slow} looks like static gain; move "
            f"in steps that rest {slow} or longer (omsm plan steps --dwell)"
        )
    return (
        f"a relaxation of {slow} does not show on plateaus of {rest}; let "
        f"the machine settle and rest {slow} on each plateau (omsm plan steps "
        "--dwell)"
    )


def _size(fitted: Fit) -> int:
    return len(fitted.dynamics.numerator) + len(fitted.dynamics.denominator)


def _priors(settings: Mapping[str, object]) -> dict[str, float]:
    stated = settings.get("priors", {})
    if not isinstance(stated, Mapping):
        raise ConfigurationError(f"settings: priors is {stated!r}, expected an object")
    for name, value in stated.items():
        if isinstance(value, bool) or not isinstance(value, int | float) or not value > 0:
            raise ConfigurationError(
                f"settings: the prior of {name!r} is {value!r}, expected a positive number"
            )
    return {str(name): float(value) for name, value in stated.items()}


def _carried(term: HiddenTerm, priors: Mapping[str, float]) -> float:
    return min(term.carried, priors.get(term.family, np.inf))


def _entry(term: HiddenTerm, priors: Mapping[str, float]) -> dict[str, object]:
    carried = _carried(term, priors)
    return {
        "family": term.family,
        "parameter": term.parameter,
        "size": term.size,
        "uncertainty": term.uncertainty,
        "missed": term.missed,
        "carried": carried,
        "prior": priors.get(term.family),
        "effect_on_scan_m": term.effect * carried,
        "missed_effect_on_scan_m": term.effect * term.missed,
    }


def _mostly(terms: Sequence[HiddenTerm], priors: Mapping[str, float]) -> str:
    """Return the words for what costs most of what could hide; empty where nothing could."""
    if not terms:
        return ""
    worst = max(terms, key=lambda term: term.effect * _carried(term, priors))
    return {
        CREEP: f"a slow relaxation (creep) of {worst.parameter:.3g} s",
        MODE: f"a light mode at {worst.parameter:.3g} Hz",
    }.get(worst.family, "a stiffness that grows with the deflection")


def _assumptions(survey: Survey) -> list[str]:
    slowest = survey.slowest_creep
    return [
        f"no relaxation slower than {quantity(slowest, 's')}, the length of the record",
        f"no mode below {quantity(1 / survey.plateau, 'Hz', 2)}, the rate of the steps",
    ]


def _hidden(survey: Survey, judged: Judged) -> HiddenTerm:
    fitted, term, score = survey.fitted, judged.term, judged.score
    shift = omitted(survey, term.columns[:, 0])
    frequency, rms = np.array(PAPER_SCAN).T
    imitated = _relative(fitted, frequency, shift)
    remaining = imitated - _departure(term.family, term.parameter, term.damping, frequency)
    above = float(np.max(np.abs(remaining))) if term.family == CREEP else 0.0
    return HiddenTerm(
        term.family,
        term.parameter,
        float(score.size[0]),
        score.uncertainty,
        _missed(judged),
        np.zeros_like(shift) if term.family == CREEP else shift,
        np.concatenate([fitted.dynamics.numerator, np.zeros(len(fitted.dynamics.denominator))]),
        above,
        float(np.sqrt(np.sum((np.abs(remaining) * rms) ** 2))),
    )


def _missed(judged: Judged) -> float:
    """Return the largest size that the test would have missed with 5 % probability."""
    degrees = max(judged.score.degrees, 1)
    limit = np.sqrt(stats.chi2.isf(FALSE_ALARM / judged.term.trials, degrees))
    return float(limit + _POWER) * judged.score.uncertainty


def _departure(family: str, parameter: float, damping: float, frequency: FloatArray) -> FloatArray:
    """Return the complex departure of G, relative, at ``frequency`` (k,) [Hz], per unit, (k,)."""
    s = 2j * np.pi * frequency
    if family == CREEP:
        return np.asarray(-s * parameter / (1 + s * parameter))
    if family == MODE:
        s = s / (2 * np.pi * parameter)
        return np.asarray(1 / (1 + 2 * damping * s + s * s) - 1)
    return np.zeros(len(frequency), np.complex128)


def _relative(fitted: Fit, frequency: FloatArray, shift: FloatArray) -> FloatArray:
    real, imaginary = relative_response_jacobian(fitted.dynamics, frequency) @ shift
    return np.asarray(real + 1j * imaginary)


def omitted(survey: Survey, column: FloatArray) -> FloatArray:
    """Return the shift (p,) of G's coefficients if a term that adds ``column`` (n,) is omitted."""
    fitted, problem = survey.fitted, survey.problem
    columns = problem.sensitivity(fitted)
    solved = least_squares(columns, column[problem.used], 1e-9)
    size = fitted.structure.size
    return np.asarray(fitted.scaled.coefficient_jacobian(fitted.nonlinear) @ solved[:size])
