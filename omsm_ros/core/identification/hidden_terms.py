"""What could hide in this very test, and how much would it cost on a scan?

A term that is not significant may still be there, up to the size at which it would have been
significant. The fitted coefficients then imitate a part of it, which shifts them. Its size is known
as N(estimate, uncertainty²), so its mean square is estimate² + uncertainty²: the shift of that
size is added to the covariance, unless the user declares a smaller prior.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from omsm_ros.core.departures.families import CREEP, MODE
from omsm_ros.core.departures.hidden import HIDING, HiddenTerm, hidden_terms, with_slower_creep
from omsm_ros.core.departures.other_modes import spread_of_modes
from omsm_ros.core.departures.survey import Survey
from omsm_ros.core.departures.term import Term
from omsm_ros.core.dynamics.response_band import COVERAGE_FACTOR, ResponseLimits
from omsm_ros.core.fitting.output_error import Fit
from omsm_ros.core.identification.covariance_terms import CovarianceTerm
from omsm_ros.core.identification.finding import Finding
from omsm_ros.errors import ConfigurationError
from omsm_ros.quantities import shown
from omsm_ros.readable import number, percent, quantity


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

    Raises ConfigurationError for a prior of another family, or that is no positive number.
    """
    priors = _priors(settings)
    terms = hidden_terms(survey, drift)
    entries = [_entry(term, priors) for term in terms]
    covariance = [term.covariance(_carried(term, priors)) for term in terms]
    open_gain, slow = max(
        ((_carried(t, priors) * t.above, t.parameter) for t in terms if t.family == CREEP),
        default=(0.0, 0.0),
    )
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


def other_modes(
    without: Sequence[Survey], terms: Sequence[Term], fitted: Fit
) -> list[CovarianceTerm]:
    """Return the terms of what each light mode among ``terms`` may be instead.

    without: survey of the fit before each of ``terms`` became a part of ``fitted``
    """
    return [
        CovarianceTerm(spread_of_modes(before, term, fitted))
        for before, term in zip(without, terms, strict=True)
        if term.family == MODE
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
        if name not in HIDING:
            raise ConfigurationError(
                f"settings: the prior of {shown(name)} is unknown, expected one of "
                f"{', '.join(map(repr, HIDING))}"
            )
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
        "missed": number(term.missed),
        "carried": carried,
        "prior": priors.get(term.family),
        "effect_on_scan_m": term.effect * carried,
        "missed_effect_on_scan_m": number(term.effect * term.missed),
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
    slowest = with_slower_creep(survey).slowest_creep
    return [
        f"no relaxation slower than {quantity(slowest, 's')}",
        f"no mode below {quantity(1 / survey.plateau, 'Hz', 2)}, the rate of the steps",
    ]
