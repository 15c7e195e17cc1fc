"""Is the identified response that of two masses? The entry ``two_mass`` of a certificate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict

import numpy as np

from omsm_ros.core.dynamics.masses_and_springs import FITTED, TwoMassFit, fit_two_mass, oscillations
from omsm_ros.core.dynamics.transfer_function import TransferFunction
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.errors import ConfigurationError
from omsm_ros.quantities import MASS

# The setting without which masses, springs and dampers are known only per mass of the table.
TABLE_MASS_SETTING = "table_mass_kg"
# Evenly over the band; a covariance of seven coefficients has no more directions than that.
_LINES = 40
# Root of χ² per degree of freedom, of which there are one or two: beyond this, which chance
# exceeds three times in a thousand at most, it is another machine.
_GREATEST_MISFIT = 3.0
# A mass known worse than this, relative, is not known; its stated uncertainty is linearised.
_GREATEST_UNCERTAINTY = 0.5


def table_mass(settings: Mapping[str, object]) -> float | None:
    """Return the moving mass of the table [kg] among the settings, or None if it is not there.

    Raises ConfigurationError unless it is the mass of a table.
    """
    value = settings.get(TABLE_MASS_SETTING)
    if value is None:
        return None
    return float(MASS.checked(value, ConfigurationError, f"setting {TABLE_MASS_SETTING!r}"))


def two_mass_entry(
    dynamics: TransferFunction, covariance: FloatArray, up_to: float, mass: float | None
) -> dict[str, object] | None:
    """Return the two-mass model that agrees with ``dynamics`` to ``up_to`` [Hz]; None without one.

    mass: of the table [kg]; None when it is not known: then m1 is 1, and the others are per
        mass of the table

    Eq. 7 is tried first (the probe on the second mass), then the driven mass itself.
    """
    if not up_to > 0 or len(oscillations(dynamics)) < 2:
        return None
    lines = np.linspace(up_to / _LINES, up_to, _LINES)
    for collocated in (False, True):
        fitted = fit_two_mass(
            dynamics,
            covariance,
            table_mass=1.0 if mass is None else mass,
            collocated=collocated,
            frequencies=lines,
        )
        if _believable(fitted):
            return {
                TABLE_MASS_SETTING: mass,
                "model": asdict(fitted.model),
                "relative_uncertainty": dict(zip(FITTED, fitted.uncertainty.tolist(), strict=True)),
                "misfit": fitted.misfit,
                "collocated": collocated,
            }
    return None


def _believable(fitted: TwoMassFit) -> bool:
    known = bool(np.all(fitted.uncertainty < _GREATEST_UNCERTAINTY))
    return fitted.misfit < _GREATEST_MISFIT and known
