"""Covariance of the model errors that the test could not detect, and what they cost on a scan.

A term that is not significant may still be there, up to the size at which it would have been
significant. The fitted coefficients then imitate a part of it, which shifts them. Its size is known
as N(estimate, uncertainty²), so its mean square is estimate² + uncertainty²: the shift of that
size is added to the covariance, unless the user declares a smaller prior.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from omsm_ros.core.calibration.certificate import Undetected, UndetectedEntry
from omsm_ros.core.calibration.intended_use import IntendedUse
from omsm_ros.core.estimation.output_error import Fit
from omsm_ros.core.model_errors.families import CREEP, MODE, ModelErrorTerm
from omsm_ros.core.model_errors.residual_diagnostics import ResidualDiagnostics
from omsm_ros.core.model_errors.undetected import (
    UNDETECTED,
    UndetectedTerm,
    alternative_mode_covariance,
    undetected_terms,
    with_slow_creep,
)
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import ConfigurationError
from omsm_ros.quantities import shown


def undetected_covariance(
    diagnostics: ResidualDiagnostics,
    settings: Mapping[str, object],
    drift: Sequence[slice],
    use: IntendedUse,
) -> tuple[list[FloatArray], Undetected]:
    """Return covariances (p, p) of undetected terms, and the terms for the certificate.

    drift: columns of the background that model a drift
    settings: may hold "priors", standard uncertainties by the name of a family; a term is taken
        no larger than its prior

    Raises ConfigurationError for a prior of another family, or that is no positive number.
    """
    priors = _priors(settings)
    terms = undetected_terms(diagnostics, drift, use)
    gain, slowest = max(
        ((_carried(t, priors) * t.above, t.parameter) for t in terms if t.family == CREEP),
        default=(0.0, 0.0),
    )
    found = Undetected(
        terms=tuple(_entry(term, priors) for term in terms),
        gain_u=gain,
        plateau_s=diagnostics.plateau,
        plateau_needed_s=slowest,
        slowest_creep_s=with_slow_creep(diagnostics).longest_time_constant,
        lowest_mode_hz=1 / diagnostics.plateau,
    )
    return [term.covariance(_carried(term, priors)) for term in terms], found


def alternative_modes(
    without: Sequence[ResidualDiagnostics], terms: Sequence[ModelErrorTerm], fitted: Fit
) -> list[FloatArray]:
    """Return covariances (p, p) of the alternatives of each lightly damped mode in ``terms``.

    without: survey of the fit before each of ``terms`` became a part of ``fitted``
    """
    return [
        alternative_mode_covariance(before, term, fitted)
        for before, term in zip(without, terms, strict=True)
        if term.family == MODE
    ]


def _priors(settings: Mapping[str, object]) -> dict[str, float]:
    stated = settings.get("priors", {})
    if not isinstance(stated, Mapping):
        raise ConfigurationError("identification.priors", value=repr(stated))
    for name, value in stated.items():
        if name not in UNDETECTED:
            known = ", ".join(map(repr, UNDETECTED))
            raise ConfigurationError(
                "identification.unknown_prior", family=shown(name), known=known
            )
        if isinstance(value, bool) or not isinstance(value, int | float) or not value > 0:
            raise ConfigurationError("identification.prior", family=name, value=repr(value))
    return {str(name): float(value) for name, value in stated.items()}


def _carried(term: UndetectedTerm, priors: Mapping[str, float]) -> float:
    return min(term.carried, priors.get(term.family, np.inf))


def _entry(term: UndetectedTerm, priors: Mapping[str, float]) -> UndetectedEntry:
    carried, missed = _carried(term, priors), term.effect * term.missed
    return UndetectedEntry(
        family=term.family,
        parameter=float(term.parameter),
        size=term.size,
        uncertainty=term.uncertainty,
        missed=term.missed if np.isfinite(term.missed) else None,
        carried=carried,
        prior=priors.get(term.family),
        effect_on_scan_m=term.effect * carried,
        missed_effect_on_scan_m=missed if np.isfinite(missed) else None,
    )
