"""Latency of the probe: the part of a calibration's lag by which X, Y, B and C are delayed.

A structure that lags moves Z alone. A probe that is late reads the part where it was before, so
the other axes must be delayed too. A step test measures the sum of both and cannot separate them;
scans of one part at several speeds or in both directions can.
"""

from dataclasses import asdict, dataclass
from math import sqrt

from omsm_ros.errors import ConfigurationError, text_of
from omsm_ros.quantities import LAG, SHARE, TIME_UNCERTAINTY, shown

UNRESOLVED, REVERSAL, SPEEDS, DECLARED = "unresolved", "reversal", "several speeds", "declared"
SOURCES = (UNRESOLVED, REVERSAL, SPEEDS, DECLARED)


@dataclass(frozen=True, slots=True, kw_only=True)
class Latency:
    """The part of the lag by which X, Y, B and C are delayed.

    delay_s: of the probe against the slides;  uncertainty_s: of it, k = 1, None if unknown
    unshared_s: standard uncertainty of the delay that the lag of Z does not share; only this part
        changes a height where Z follows the surface
    share: of the whole lag [1], None where it is not known or there is no lag
    source: one of ``SOURCES``;  reason: where the figure comes from, required but for UNRESOLVED

    Raises ConfigurationError for values that no probe has.
    """

    delay_s: float
    uncertainty_s: float | None = None
    unshared_s: float
    share: float | None = None
    source: str
    reason: str = ""

    def __post_init__(self) -> None:
        LAG.checked(self.delay_s, ConfigurationError, "latency")
        TIME_UNCERTAINTY.checked(self.unshared_s, ConfigurationError, "latency unshared with Z")
        if self.uncertainty_s is not None:
            TIME_UNCERTAINTY.checked(self.uncertainty_s, ConfigurationError, "latency")
        if self.share is not None:
            SHARE.checked(self.share, ConfigurationError, "share of the latency")
        if self.source not in SOURCES:
            raise ConfigurationError(
                "calibration.latency_source", source=shown(self.source), known=", ".join(SOURCES)
            )
        if self.resolved and not (isinstance(self.reason, str) and self.reason.strip()):
            raise ConfigurationError("calibration.latency_reason")

    @property
    def resolved(self) -> bool:
        """Whether something separates the latency from the lag of the structure."""
        return self.source != UNRESOLVED


def latency_summary(latency: Latency) -> dict[str, object]:
    """Return ``latency`` as JSON values for a summary, its reason as a sentence."""
    reason = latency.reason or text_of("calibration.latency_unresolved", {})
    return {**asdict(latency), "reason": reason}


def unresolved_latency(lag: float) -> Latency:
    """Return the latency where no test separates it: any part of ``lag`` [s] may be latency.

    X and C are not delayed, for nothing says that they should be. The true delay is distributed
    uniformly between 0 and the lag: its rms from zero is lag/√3.
    """
    spread = abs(lag) / sqrt(3.0)
    return Latency(delay_s=0.0, uncertainty_s=spread, unshared_s=spread, source=UNRESOLVED)


def declared_latency(lag: float, delay: float, uncertainty: float, reason: str) -> Latency:
    """Return a latency of ``delay`` ± ``uncertainty`` [s] of the whole ``lag`` [s], as stated.

    Raises ConfigurationError for a delay or uncertainty that no probe has, or without a reason.
    """
    return Latency(
        delay_s=delay,
        uncertainty_s=uncertainty,
        unshared_s=uncertainty,
        share=latency_share_of(delay, lag),
        source=DECLARED,
        reason=reason,
    )


def latency_share_of(delay: float, lag: float) -> float | None:
    """Return ``delay`` over ``lag`` [s], None if there is no lag."""
    return delay / lag if lag else None
