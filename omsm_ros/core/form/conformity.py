"""Does the part hold its tolerance? (ISO 14253-1)

What is measured holds a tolerance for certain only if it does so with its expanded uncertainty
added, and fails it for certain only with that taken off; between the two nobody can tell.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from omsm_ros.core.form.figures import Figure

HOLDS, FAILS, OPEN = "holds", "fails", "cannot tell"
COVERAGE_FACTOR = 2.0


@dataclass(frozen=True)
class Conformity:
    """verdict: HOLDS, FAILS or OPEN;  value, expanded (k = 2), tolerance: [m]

    expanded: None if the uncertainty was not evaluated
    """

    verdict: str
    value: float
    expanded: float | None
    tolerance: float

    def entry(self) -> dict[str, Any]:
        """Return the JSON values for result files."""
        return asdict(self)


def conformity(figure: Figure, tolerance: float) -> Conformity | None:
    """Return whether ``figure`` is at most ``tolerance`` [m]; None for a figure without a value."""
    if figure.value is None:
        return None
    if figure.uncertainty is None:
        return Conformity(OPEN, figure.value, None, tolerance)
    expanded = COVERAGE_FACTOR * figure.uncertainty
    verdict = OPEN
    if figure.value + expanded <= tolerance:
        verdict = HOLDS
    elif figure.value - expanded > tolerance:
        verdict = FAILS
    return Conformity(verdict, figure.value, expanded, tolerance)
