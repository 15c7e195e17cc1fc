"""Where the parts of a step test contradict each other, the band holds what they differ by."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from omsm_ros.core.departures.contrasts import HALVES, SIZES, UP_DOWN, Contrast, contrasts
from omsm_ros.core.departures.survey import FALSE_ALARM, Survey
from omsm_ros.core.identification.covariance_terms import CovarianceTerm
from omsm_ros.core.identification.finding import Finding
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.readable import chance, percent, quantity

_REMEDY = {
    UP_DOWN: "look for what is loose or rubs, or is clamped on one side only",
    HALVES: "let the machine warm up and settle before the test",
    SIZES: "make steps as small as the deflections of a scan, and look for what is loose or rubs",
}


def consistency(survey: Survey) -> CovarianceTerm:
    """Return the term of parts that differ, and its finding; nothing is added where none do.

    The whole difference counts as a standard uncertainty: nothing says that a scan, which moves
    less than a step, lies between the two.
    """
    found = contrasts(survey)
    fitted = survey.fitted
    gain = np.concatenate([fitted.dynamics.numerator, np.zeros(len(fitted.dynamics.denominator))])
    lag = np.zeros_like(gain)
    lag[-1] = 1.0
    rows = [row for c in found if c.significant for row in (c.gain * gain, c.lag * lag)]
    return CovarianceTerm(_outer(rows, len(gain)), consistency_finding(found))


def _outer(rows: Sequence[FloatArray], size: int) -> FloatArray:
    stacked = np.asarray(rows).reshape(-1, size)
    return np.asarray(stacked.T @ stacked)


def consistency_finding(found: Sequence[Contrast]) -> Finding:
    """Reserve a test whose parts differ by more than chance."""
    return Finding(
        {"consistency": [_entry(contrast) for contrast in found]},
        {"consistency_p_least": FALSE_ALARM} if found else {},
        reservations=tuple(_words(contrast) for contrast in found if contrast.significant),
    )


def _entry(contrast: Contrast) -> dict[str, object]:
    known = {
        "gain_difference": contrast.gain,
        "gain_difference_uncertainty": contrast.gain_uncertainty,
        "lag_difference_s": contrast.lag,
        "lag_difference_uncertainty_s": contrast.lag_uncertainty,
    }
    finite = {name: value if np.isfinite(value) else None for name, value in known.items()}
    return {"parts": contrast.parts, **finite, "p": contrast.p}


def _words(contrast: Contrast) -> str:
    first, second = contrast.parts.split(" against ")
    return (
        f"{first} and {second} differ by {quantity(contrast.lag, 's', 2)} in lag and "
        f"{percent(contrast.gain)} in gain (by chance: {chance(contrast.p)}), and the band holds "
        f"that: {_REMEDY[contrast.parts]}, and repeat the test"
    )
