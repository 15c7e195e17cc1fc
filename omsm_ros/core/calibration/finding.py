"""Findings: what a check says of a calibration, as a code with values."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from omsm_ros.errors import CalibrationError, text_of

REJECTS, RESERVATION, WARNING, NOTE = "rejects", "reservation", "warning", "note"
SEVERITIES = (REJECTS, RESERVATION, WARNING, NOTE)

TEXT = "calibration.text"
"""Code of a finding that was stored as a sentence, in files of version 1."""


@dataclass(frozen=True)
class Finding:
    """One statement about a calibration.

    code: ``room.subject``, the key of its sentence in :mod:`omsm_ros.messages`
    severity: "rejects", "reservation" (covered by the model or by a wider band), "warning" or
        "note"
    values: JSON values that the sentence names, SI;  limits: what they are compared with

    ``str(finding)`` is the sentence. Raises CalibrationError for another severity.
    """

    code: str
    severity: str
    values: Mapping[str, object] = field(default_factory=dict)
    limits: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.severity not in SEVERITIES:
            raise CalibrationError(
                "calibration.severity", severity=self.severity, known=", ".join(SEVERITIES)
            )

    def __str__(self) -> str:
        return text_of(self.code, {**self.limits, **self.values})


def of_severity(findings: Iterable[Finding], severity: str) -> tuple[Finding, ...]:
    """Return those of ``findings`` that have ``severity``, in their order."""
    return tuple(finding for finding in findings if finding.severity == severity)
