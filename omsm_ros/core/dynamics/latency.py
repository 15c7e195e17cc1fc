"""How much of a calibration's lag is latency of the probe, and how well is that known?

A structure that lags moves Z alone. A probe that is late saw an earlier place of the part,
so X and C must be delayed too. A step test sees the sum of both and cannot separate them;
scans of one part at several speeds or in both directions can.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from math import hypot, sqrt
from typing import TYPE_CHECKING, Any

from omsm_ros.errors import CalibrationError, ConfigurationError, OmsmError
from omsm_ros.quantities import LAG, SHARE, TIME_UNCERTAINTY, shown
from omsm_ros.readable import quantity

if TYPE_CHECKING:
    from omsm_ros.core.dynamics.calibration import Calibration

ENTRY = "latency"
UNRESOLVED, REVERSAL, SPEEDS, DECLARED = "unresolved", "reversal", "several speeds", "declared"
SOURCES = (UNRESOLVED, REVERSAL, SPEEDS, DECLARED)

# Standard uncertainties by which a delay may be longer than the lag that it is a part of.
_CLEARLY = 3.0
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

    Raises ConfigurationError for values that no probe has.
    """

    delay_s: float
    uncertainty_s: float | None
    beside_z_s: float
    share: float | None
    source: str
    reason: str

    def __post_init__(self) -> None:
        LAG.checked(self.delay_s, ConfigurationError, "latency")
        TIME_UNCERTAINTY.checked(self.beside_z_s, ConfigurationError, "latency beside Z")
        if self.uncertainty_s is not None:
            TIME_UNCERTAINTY.checked(self.uncertainty_s, ConfigurationError, "latency")
        if self.share is not None:
            SHARE.checked(self.share, ConfigurationError, "share of the latency")
        if self.source not in SOURCES:
            raise ConfigurationError(
                f"latency by {shown(self.source)}, expected one of {', '.join(SOURCES)}"
            )
        if not (isinstance(self.reason, str) and self.reason.strip()):
            raise ConfigurationError("a latency needs a reason: say where the figure comes from")

    @property
    def resolved(self) -> bool:
        """False if nothing separates latency from structure."""
        return self.source != UNRESOLVED

    @classmethod
    def of_entry(cls, entry: object) -> Latency:
        """Return the inverse of :meth:`entry`; raise CalibrationError if it is none."""
        names = {field.name for field in fields(cls)}
        if not isinstance(entry, Mapping) or set(entry) != names:
            raise CalibrationError(
                f"certificate: latency is {shown(entry)}, expected {', '.join(sorted(names))}; "
                "declare it again with 'omsm latency'"
            )
        try:
            return cls(**entry)
        except OmsmError as err:
            raise CalibrationError(f"certificate: {err}") from err

    def entry(self) -> dict[str, Any]:
        """Return the JSON values of ``certificate["latency"]``."""
        return asdict(self)


def latency_of(calibration: Calibration) -> Latency:
    """Return what ``calibration`` says of its latency; unresolved if it says nothing."""
    if ENTRY in calibration.certificate:
        return Latency.of_entry(calibration.certificate[ENTRY])
    return unresolved(calibration.dynamics.low_frequency_delay)


def unresolved(lag: float) -> Latency:
    """Return what is known without a test: any part of ``lag`` [s] may be latency.

    X and C are not delayed, for nothing says that they should be. The true delay lies anywhere
    between 0 and the lag, uniformly: its rms from zero is lag/√3.
    """
    spread = abs(lag) / sqrt(3.0)
    return Latency(
        delay_s=0.0,
        uncertainty_s=spread,
        beside_z_s=spread,
        share=None,
        source=UNRESOLVED,
        reason="a step test alone cannot separate latency of the probe from lag of the structure",
    )


def declared(lag: float, delay: float, uncertainty: float, reason: str) -> Latency:
    """Return a latency of ``delay`` ± ``uncertainty`` [s] of the whole ``lag`` [s] as stated.

    Raises ConfigurationError for a delay or uncertainty that no probe has, or without a reason.
    """
    return Latency(
        delay_s=delay,
        uncertainty_s=uncertainty,
        beside_z_s=uncertainty,
        share=share_of(delay, lag),
        source=DECLARED,
        reason=reason,
    )


def beyond_lag(calibration: Calibration, delay: float, uncertainty: float = 0.0) -> str | None:
    """Return what is wrong with a ``delay`` ± ``uncertainty`` [s] beyond the whole lag of Z.

    What is left of the lag would be a structure that moves before its slide.
    """
    lag, spread = (
        calibration.dynamics.low_frequency_delay,
        calibration.low_frequency_delay_uncertainty,
    )
    if delay <= max(lag, 0.0) + _CLEARLY * hypot(spread, uncertainty):
        return None
    return (
        f"a delay of the probe of {quantity(delay, 's')} is more than the whole lag of Z, "
        f"{quantity(lag, 's')} ± {quantity(spread, 's')}: give the probe's delay against the "
        "slides, in seconds"
    )


def share_of(delay: float, lag: float) -> float | None:
    """Return the part of ``lag`` [s] that ``delay`` [s] is, None if there is no lag."""
    return delay / lag if lag else None


def with_latency(calibration: Calibration, latency: Latency) -> Calibration:
    """Return ``calibration`` with a certificate that says ``latency``."""
    certificate = {**calibration.certificate, ENTRY: latency.entry()}
    return replace(calibration, certificate=certificate)
