"""What one check of an identification found: values, their limits, and words for a reader."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Finding:
    """Entries of the certificate, and what they mean for the verdict.

    entries: JSON values by their names in the certificate
    limits: what the entries are compared with, so that a reader can repeat the verdict
    reasons: why the calibration must not be used;  warnings: what a user has to know
    reservations: what departs from a steady linear response, and is held by model or band
    """

    entries: Mapping[str, object] = field(default_factory=dict)
    limits: Mapping[str, float] = field(default_factory=dict)
    reasons: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    reservations: tuple[str, ...] = ()
