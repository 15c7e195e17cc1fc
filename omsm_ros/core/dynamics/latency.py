"""How much of a calibration's lag is latency of the probe, and how well is that known?

A structure that lags moves Z alone. A probe that is late saw an earlier place of the part,
so X and C must be delayed too. A step test sees the sum of both and cannot tell them apart;
scans of one part at several speeds or in both directions can.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.errors import ConfigurationError
from omsm_ros.quantities import LAG, TIME_UNCERTAINTY

ENTRY = "latency"
UNRESOLVED, REVERSAL, SPEEDS, DECLARED = "unresolved", "reversal", "several speeds", "declared"
SOURCES = (UNRESOLVED, REVERSAL, SPEEDS, DECLARED)

REMEDY = (
    "scan the part at two spindle speeds and run 'omsm selfcal', or in both directions and run "
    "'omsm reversal', or declare it with 'omsm latency'"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Latency:
    """The part of the lag by which X, Y, B and C are delayed.

    delay_s: of the probe against the slides;  uncertainty_s: of it, k = 1, None if unknown
    share: of the whole lag [1], None where it is not known or there is no lag
    beside_z_s: standard uncertainty of the delay that the lag of Z does not share; it alone
        moves a height where Z follows the surface
    source: one of ``SOURCES``;  reason: in words
    """

    delay_s: float
    uncertainty_s: float | None
    beside_z_s: float
    share: float | None
    source: str
    reason: str

    @property
    def resolved(self) -> bool:
        """False if nothing tells latency from structure."""
        return self.source != UNRESOLVED

    def entry(self) -> dict[str, Any]:
        """For ``certificate["latency"]``: JSON values."""
        return asdict(self)


def latency_of(calibration: Calibration) -> Latency:
    """Return what ``calibration`` says of its latency; unresolved if it says nothing."""
    entry = calibration.certificate.get(ENTRY)
    if isinstance(entry, Mapping):
        return Latency(**entry)
    lag = calibration.dynamics.low_frequency_delay
    if calibration.settings.get("lag_is_latency", False):
        # Calibrations of before 0.2 had this setting in place of the entry.
        spread = calibration.low_frequency_delay_uncertainty
        return declared(lag, lag, spread, "setting lag_is_latency")
    return unresolved(lag)


def unresolved(lag: float) -> Latency:
    """Return what is known without a test: any part of ``lag`` [s] may be latency.

    X and C are not delayed, for nothing says that they should be. The true delay lies anywhere
    between 0 and the lag, uniformly: its rms from zero is lag/√3.
    """
    return Latency(
        delay_s=0.0,
        uncertainty_s=abs(lag) / np.sqrt(3.0),
        beside_z_s=abs(lag) / np.sqrt(3.0),
        share=None,
        source=UNRESOLVED,
        reason="a step test alone cannot tell latency of the probe from lag of the structure",
    )


def declared(lag: float, delay: float, uncertainty: float, reason: str) -> Latency:
    """Return a latency of ``delay`` ± ``uncertainty`` [s] of the whole ``lag`` [s] as stated.

    Raises ConfigurationError for a delay or uncertainty that no probe has, or without a reason.
    """
    LAG.checked(delay, ConfigurationError, "latency")
    TIME_UNCERTAINTY.checked(uncertainty, ConfigurationError, "uncertainty of the latency")
    if not reason.strip():
        raise ConfigurationError(
            "a declared latency needs a reason: say where the figure comes from"
        )
    return Latency(
        delay_s=delay,
        uncertainty_s=uncertainty,
        beside_z_s=uncertainty,
        share=share_of(delay, lag),
        source=DECLARED,
        reason=reason,
    )


def share_of(delay: float, lag: float) -> float | None:
    """Return the part of ``lag`` [s] that ``delay`` [s] is, None if there is no lag."""
    return delay / lag if lag else None


def with_latency(calibration: Calibration, latency: Latency) -> Calibration:
    """Return ``calibration`` with a certificate that says ``latency``."""
    certificate = {**calibration.certificate, ENTRY: latency.entry()}
    return replace(calibration, certificate=certificate)
